"""Smooth random curves, sampled at one fixed rate so that a seed means the same motion at any frame rate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

F64 = NDArray[np.float64]

RATE = 100.0  # samples a second of every curve made here


def clock(duration: float) -> F64:
    """Times [S] s of the curves' samples, from 0 to past `duration` s."""
    return np.arange(int(np.ceil(duration * RATE)) + 2) / RATE


def smooth_noise(random: np.random.Generator, count: int, scale_s: float, columns: int = 1) -> F64:
    """[count, columns] Gaussian curves of unit variance that change over about `scale_s` s."""
    margin = int(4 * scale_s * RATE)
    white = random.standard_normal((count + 2 * margin, columns))
    smooth = gaussian_filter1d(white, scale_s * RATE / 2, axis=0)[margin : margin + count]
    # A Gaussian kernel of this width leaves the variance 1 / (2 sqrt(pi) sigma).
    return smooth * np.sqrt(2 * np.sqrt(np.pi) * scale_s * RATE / 2)


def bump(times: F64, centre: float, rise_s: float, fall_s: float) -> F64:
    """A smooth rise to 1 at `centre` and a smooth fall, raised cosines of these lengths."""
    ramp = np.where(times < centre, (centre - times) / rise_s, (times - centre) / fall_s)
    return 0.5 + 0.5 * np.cos(np.pi * np.clip(ramp, 0, 1))


def at_times(curve: F64, times: F64) -> F64:
    """Curves [S, C] interpolated at other times [N] s -> [N, C]."""
    grid = np.arange(len(curve)) / RATE
    return np.stack([np.interp(times, grid, column) for column in curve.T], axis=1)
