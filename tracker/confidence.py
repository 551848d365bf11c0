"""How far each frame of a fit can be trusted, 0..1."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracker.track import F32, F64

TOLERATED = 1.5  # residuals up to this many times the clip's median cost nothing


def confidence(
    error: F64, visible: F64, presence: NDArray[np.floating], good: NDArray[np.int64], total: int
) -> F32:
    """[T] 0..1, 0 where nothing was measured.

    error: [n, L] distance of fitted and observed landmarks, in any unit proportional to the face.
    visible: [n, L]. presence: [n], the landmarker's. good: [n] the measured frames of `total`.
    A frame loses confidence by a residual above the clip's own median, by one that jumps from its
    neighbours', by a hidden side, and by presence.
    """
    residual = (error * visible).sum(1) / visible.sum(1)
    typical = max(float(np.median(residual)), 1e-9)
    before, after = np.roll(residual, 1), np.roll(residual, -1)
    before[0], after[-1] = residual[0], residual[-1]
    jump = np.maximum(residual - np.maximum(before, after), 0.0) / typical
    excess = np.maximum(residual / typical - TOLERATED, 0.0)
    seen = np.clip(visible.mean(1) / 0.6, 0.0, 1.0)
    out = np.zeros(total, np.float32)
    out[good] = presence * np.exp(-excess - jump) * seen
    return np.clip(out, 0.0, 1.0)
