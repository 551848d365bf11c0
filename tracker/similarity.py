"""The similarity between two sets of points that belong to each other."""

from __future__ import annotations

import numpy as np

from tracker.track import F64


def similarity(source: F64, target: F64, scaled: bool = True) -> tuple[F64, F64, F64]:
    """Scale [..], rotation [.., 3, 3] and shift [.., 3] with target = scale * rotation source + shift.

    source, target: [.., n, 3], which may be one for all. In the least squares, and never a mirror image (Umeyama 1991).
    scaled: else of scale 1.
    """
    a, b = (points - points.mean(-2, keepdims=True) for points in (source, target))
    u, size, vt = np.linalg.svd(np.swapaxes(b, -1, -2) @ a)
    sign = np.ones_like(size)
    sign[..., 2] = np.linalg.det(u @ vt)
    rotation = (u * sign[..., None, :]) @ vt
    scale = (size * sign).sum(-1) / (a**2).sum((-2, -1)) if scaled else np.ones(size.shape[:-1])
    moved = (rotation @ source.mean(-2)[..., None])[..., 0]
    return scale, rotation, target.mean(-2) - scale[..., None] * moved
