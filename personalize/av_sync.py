"""How late the sound of a clip is, from the opening of the mouth and the loudness of speech.

Both rise and fall with the syllables. Their changes at syllable rate are correlated at every lag within a second;
speech in sync peaks at 0 to 15 ms in recordings of three speakers, so that no natural lag is subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from personalize.sound import SPEECH_RATE

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

STEP_S = 0.01  # of the grid on which both curves are compared
RATE = round(1 / STEP_S)
MAX_LAG = 100  # grid steps
SPEECH_HZ = (300.0, 3500.0)  # formants: loud with an open mouth, unlike hum and hiss
SYLLABLES_HZ = (2.0, 8.0)
FLOOR = 0.05  # of the envelope's rms: quieter differences are noise
LONGEST_GAP_S = 0.15  # between two usable pictures of one stretch
SHORTEST_STRETCH_S = 1.0
PEAK_WIDTH = 12  # grid steps around the peak that belong to it, about half a syllable
# What makes an estimate sure; MIN_CORRELATION is for 20 s of a face, LEAST_CORRELATION for however long. Of four
# speakers' clips of 20 s, each with the sound of another, of another time or reversed (752 pairs), about one passes;
# with their own sound three of the four do.
MIN_CORRELATION, LEAST_CORRELATION = 0.3, 0.2
MIN_RATIO, MIN_DEVIATIONS, HALVES_AGREE_S = 1.4, 3.5, 0.05
SMALLEST_S = 0.06  # offsets below are within what the natural lag varies by between people and sounds


@dataclass(frozen=True)
class AvOffset:
    """An estimate of how late the sound is against the picture (negative: early).

    sure: whether it is worth correcting: clear, alike in both halves of the clip, and larger than SMALLEST_S.
    """

    offset_s: float
    sure: bool


def estimate_av_offset(
    times: NDArray[np.floating],
    opening: NDArray[np.floating],
    usable: Bool,
    audio: NDArray[np.floating],
    start_s: float,
) -> AvOffset:
    """Estimate the lag of the sound behind the picture within a second.

    times: [T] s, rising. opening: [T] of the mouth, any unit; only read where `usable` [T] is set. audio: mono [S] at
    16 kHz, its first sample at `start_s` on the clock of `times`. Silence or too little of a face: 0, not sure.
    """
    curve, known, origin_s = _opening_curve(np.asarray(times, np.float64), opening, usable)
    if not known.any():
        return AvOffset(0.0, False)
    loudness = _loudness(
        np.asarray(audio, np.float64), start_s, origin_s - MAX_LAG * STEP_S, len(curve) + 2 * MAX_LAG
    )
    if not loudness.any():
        return AvOffset(0.0, False)
    values = _correlations(curve, known, loudness)
    best = int(values.argmax())
    elsewhere = np.delete(values, slice(max(0, best - PEAK_WIDTH), best + PEAK_WIDTH + 1))
    deviations = float(values[best] / max(float(np.sqrt((elsewhere**2).mean())), 1e-9))
    ratio = float(values[best] / max(float(elsewhere.max()), 1e-9))
    first_half = np.cumsum(known) * 2 <= known.sum()
    halves = [_lag_s(_correlations(curve, known & half, loudness)) for half in (first_half, ~first_half)]
    offset_s = _lag_s(values)
    # Chance peaks shrink with the root of the time.
    least = max(LEAST_CORRELATION, MIN_CORRELATION * (20.0 / (known.sum() * STEP_S)) ** 0.5)
    clear = values[best] >= least and ratio >= MIN_RATIO and deviations >= MIN_DEVIATIONS
    agree = max(abs(half - offset_s) for half in halves) <= HALVES_AGREE_S
    # A peak at the end of the range may be the flank of one outside it.
    inside = abs(best - MAX_LAG) < MAX_LAG - 2
    return AvOffset(offset_s, bool(clear and agree and inside and abs(offset_s) > SMALLEST_S))


def _opening_curve(times: F64, opening: NDArray[np.floating], usable: Bool) -> tuple[F64, Bool, float]:
    """Syllables in the opening: (curve [N] on the grid, where it is known [N], time s of the first grid point)."""
    index = np.flatnonzero(usable & np.isfinite(opening))
    if not len(index):
        return np.zeros(0), np.zeros(0, bool), 0.0
    origin_s = float(times[index[0]])
    count = int((times[index[-1]] - origin_s) / STEP_S) + 1
    curve, known = np.zeros(count), np.zeros(count, bool)
    for stretch in np.split(index, np.flatnonzero(np.diff(times[index]) > LONGEST_GAP_S) + 1):
        first, last = np.round((times[stretch[[0, -1]]] - origin_s) / STEP_S).astype(int)
        rows = slice(int(first), min(int(last) + 1, count))
        if (last - first) * STEP_S < SHORTEST_STRETCH_S:
            continue
        at = origin_s + np.arange(rows.start, rows.stop) * STEP_S
        curve[rows] = _syllables(np.interp(at, times[stretch], opening[stretch]))
        known[rows] = True
    return curve, known, origin_s


def _loudness(audio: F64, start_s: float, first_s: float, count: int) -> F64:
    """Syllables in the logarithm of the speech band's envelope, [count] on the grid from `first_s`; 0 without sound."""
    block = round(SPEECH_RATE * STEP_S)
    blocks = len(audio) // block
    if blocks < RATE * SHORTEST_STRETCH_S or not audio.any():
        return np.zeros(count)
    band = sosfiltfilt(butter(2, SPEECH_HZ, "bandpass", fs=SPEECH_RATE, output="sos"), audio)
    envelope = np.sqrt((band[: blocks * block].reshape(blocks, block) ** 2).mean(1))
    level = float(np.sqrt((envelope**2).mean()))
    if level < 1e-6:
        return np.zeros(count)
    curve = _syllables(np.log(envelope / level + FLOOR))
    centres = start_s + (np.arange(blocks) + 0.5) * STEP_S
    at = first_s + np.arange(count) * STEP_S
    return np.asarray(np.interp(at, centres, curve, left=0.0, right=0.0), np.float64)


def _syllables(values: F64) -> F64:
    """The part of a curve [N] on the grid that changes at the rate of syllables."""
    filtered = sosfiltfilt(butter(2, SYLLABLES_HZ, "bandpass", fs=RATE, output="sos"), values)
    return np.asarray(filtered, np.float64)


def _correlations(curve: F64, known: Bool, loudness: F64) -> F64:
    """Correlation of curve [N] where `known` with loudness [N + 2 MAX_LAG], at lags -MAX_LAG..MAX_LAG."""

    def correlation(mouth: F64, voice: F64) -> F64:
        mouth = np.where(known, mouth, 0.0)
        energy = np.correlate(voice**2, known.astype(np.float64), "valid") * (mouth @ mouth)
        return np.asarray(
            np.correlate(voice, mouth, "valid") / np.sqrt(np.maximum(energy, 1e-12)), np.float64
        )

    # Speeds too: they sharpen the peak against slow changes that both have by chance.
    return (correlation(curve, loudness) + correlation(np.gradient(curve), np.gradient(loudness))) / 2


def _lag_s(values: F64) -> float:
    """Lag of the highest of the correlations, s, between grid points by a parabola."""
    best = int(values.argmax())
    shift = 0.0
    if 0 < best < len(values) - 1:
        before, top, after = values[best - 1 : best + 2]
        shift = float((before - after) / (2 * min(before - 2 * top + after, -1e-12)))
    return (best - MAX_LAG + shift) * STEP_S
