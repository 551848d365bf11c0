"""Phones to the movement of the mouth: dominance blending after Cohen and Massaro, and lip contact on top."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from personalize.talkers.noise import RATE, bump, smooth_noise
from personalize.talkers.style import Style
from personalize.talkers.visemes import BILABIALS, CHANNELS, SILENCE, VISEMES, Phone, Viseme

F64 = NDArray[np.float64]

LEAD_S = 0.03  # lips move ahead of the sound they make
TIMING_SD_S = 0.012
REACH_S = 0.035  # how far a phone's shape reaches beyond the phone
SMOOTHING_S = 0.018  # the mouth's inertia
SHORTEST_SEAL_S = 0.05  # longer than a frame at 25 fps, so that every closure is seen
GLIDE_PLACES = (0.28, 0.82)  # where in a diphthong its two ends are reached

_INDEX = {name: index for index, name in enumerate(CHANNELS)}
_ROUNDING = [_INDEX[name] for name in ("mouthFunnel", "mouthPucker")]
_SPREAD = [_INDEX[name] for name in ("mouthStretch", "mouthSmile", "mouthLowerDown", "mouthUpperUp")]


def mouth_channels(
    phones: Sequence[Phone], times: F64, style: Style, loudness: F64, random: np.random.Generator
) -> F64:
    """Speech channels [S, C] (visemes.CHANNELS, 0..1) at `times` [S] s, spaced 1 / RATE.

    loudness: [S] 0..1. Each instance of a phone is made a little differently, drawn from `random`.
    """
    centres, widths, visemes = _pieces(phones, style, random)
    targets = np.array([[viseme.targets.get(name, 0.0) for name in CHANNELS] for viseme in visemes])
    firm = np.array([[v.firm if name in v.targets else v.soft for name in CHANNELS] for v in visemes])
    together = 1 + style.variation * random.standard_normal((len(visemes), 1))
    alone = 1 + 0.6 * style.variation * random.standard_normal(targets.shape)
    targets = targets * np.clip(together * alone, 0.3, 1.8)

    kernel = np.exp(-((np.abs(times[:, None] - centres) / widths) ** 1.6)) + 1e-9
    channels = (kernel @ (firm * targets)) / (kernel @ firm)
    channels = gaussian_filter1d(channels, SMOOTHING_S * RATE / style.sharpness, axis=0)

    gains = np.full(len(CHANNELS), style.amplitude)
    gains[_INDEX["jawOpen"]] *= style.jaw
    gains[_ROUNDING] *= style.rounding
    gains[_SPREAD] *= style.spread
    mood = 0.14 * smooth_noise(random, len(times), 2.5)
    drift = 0.10 * smooth_noise(random, len(times), 1.2, len(CHANNELS))
    channels *= gains * np.exp(mood + drift)
    channels[:, _INDEX["jawOpen"]] *= 0.7 + 0.5 * loudness
    channels[:, _INDEX["seal"]] = seal(phones, times)
    return np.clip(channels, 0, 1)


def _pieces(
    phones: Sequence[Phone], style: Style, random: np.random.Generator
) -> tuple[F64, F64, list[Viseme]]:
    """Centres [P] s, widths [P] s and visemes of all phones, glides in two pieces."""
    centres, widths, visemes = [], [], []
    for phone in phones:
        parts = VISEMES[phone.name]
        length = phone.end - phone.start
        for place, viseme in zip(GLIDE_PLACES if len(parts) == 2 else (0.5,), parts):
            jitter = 0.0 if phone.name == SILENCE else TIMING_SD_S * random.standard_normal()
            centres.append(phone.start + place * length - LEAD_S + jitter)
            widths.append(0.5 * length / len(parts) + REACH_S / style.sharpness)
            visemes.append(viseme)
    return np.array(centres), np.array(widths), visemes


def seal(phones: Sequence[Phone], times: F64) -> F64:
    """[S] 0..1: 1 while a bilabial holds the lips shut."""
    shut = np.zeros_like(times)
    for phone in phones:
        if phone.name in BILABIALS:
            start = phone.start
            # The last quarter of a stop is its burst.
            end = max(phone.end - 0.25 * (phone.end - phone.start), start + SHORTEST_SEAL_S)
            hold = np.where(times < start, bump(times, start, 0.10, 1), bump(times, end, 1, 0.09))
            shut = np.maximum(shut, np.where((times >= start) & (times <= end), 1.0, hold))
    return shut
