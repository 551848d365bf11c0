"""What sound does not decide: blinks, brows, gaze, and the head's own movement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from personalize.talkers.noise import RATE, bump, smooth_noise
from personalize.talkers.style import Style
from personalize.talkers.visemes import VOWELS, Phone

F64 = NDArray[np.float64]

BLINK_PEAK = 0.85
ACCENT_SHARE = 0.22  # of vowels that brows and head accent


def accents(phones: Sequence[Phone], times: F64, loudness: F64, random: np.random.Generator) -> F64:
    """[S] 0..1: soft bumps at some of the louder vowels."""
    curve = np.zeros_like(times)
    for phone in phones:
        if phone.name in VOWELS:
            centre = 0.5 * (phone.start + phone.end) + 0.04 * random.standard_normal()
            chance = 2 * ACCENT_SHARE * np.interp(centre, times, loudness)
            height, drawn = random.uniform(0.3, 1.0), random.random()
            if drawn < chance:
                rise, fall = random.uniform(0.12, 0.25), random.uniform(0.25, 0.5)
                curve = np.maximum(curve, height * bump(times, centre, rise, fall))
    return curve


def blinks(times: F64, style: Style, random: np.random.Generator) -> F64:
    """[S] eyeBlink weight: quick down, slower up, at irregular times; now and then half or double."""
    curve = np.zeros_like(times)
    moment = random.uniform(0.5, style.blink_gap_s)
    while moment < times[-1]:
        peak = BLINK_PEAK * (1.0 if random.random() < 0.85 else random.uniform(0.4, 0.7))
        down, up = random.uniform(0.08, 0.11), random.uniform(0.14, 0.22)
        curve = np.maximum(curve, peak * bump(times, moment, down, up))
        double = random.random() < 0.12
        moment += 0.35 if double else 0.8 + random.exponential(style.blink_gap_s - 0.8)
    return curve


def brows(times: F64, accent: F64, style: Style, random: np.random.Generator) -> dict[str, F64]:
    """[S] weights of the brows and of the lids that follow them."""
    slow = smooth_noise(random, len(times), 2.0, 3)
    raised = style.brows * (0.30 * accent + 0.09 * np.maximum(slow[:, 0], 0))
    lowered = style.brows * 0.16 * np.maximum(slow[:, 1] - 0.3, 0) * (1 - accent)
    tilt = 0.25 * np.tanh(slow[:, 2])
    return {
        "browInnerUp": raised,
        "browOuterUpLeft": 0.7 * raised * (1 + tilt),
        "browOuterUpRight": 0.7 * raised * (1 - tilt),
        "browDownLeft": lowered * (1 + tilt),
        "browDownRight": lowered * (1 - tilt),
        "eyeWideLeft": 0.25 * raised,
        "eyeWideRight": 0.25 * raised,
    }


def gaze(times: F64, random: np.random.Generator) -> F64:
    """[S, 2] where the eyes look against the camera, rad: (to the subject's left, up); jumps, then holds."""
    targets = np.zeros((len(times), 2))
    moment = 0.0
    while moment < times[-1]:
        away = random.random() < 0.35
        target = random.normal(0, (0.12, 0.06)) if away else random.normal(0, (0.02, 0.015))
        targets[times >= moment] = target
        moment += random.uniform(0.3, 1.0) if away else random.uniform(0.6, 2.5)
    return gaussian_filter1d(targets, 0.012 * RATE, axis=0)


def head_angles(times: F64, accent: F64, style: Style, random: np.random.Generator) -> F64:
    """[S, 3] yaw (to the subject's left), pitch (up), roll (to the subject's right shoulder), rad.

    Wide enough turns that a camera can be estimated from them; nods on accents.
    """
    slow, quick = smooth_noise(random, len(times), 1.8, 3), smooth_noise(random, len(times), 0.6, 3)
    degrees = slow * (9.5, 3.5, 2.5) + quick * (1.5, 0.9, 0.8)
    degrees[:, 1] -= 4.0 * gaussian_filter1d(accent, 0.05 * RATE)
    degrees[:, 0] = 17.0 * np.tanh(degrees[:, 0] / 17.0)
    return np.radians(style.head * degrees)
