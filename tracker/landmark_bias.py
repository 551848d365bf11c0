"""What the landmarker errs by as a face turns and moves, taken out of its points.

The network draws each face towards the usual one: nods come out a fifth too small, whoever nods. So what its points err
by goes with what they show. How, was learned from pictures of people drawn by lot whose truth is known
(tools/build_landmark_bias.py), as a linear map. Only what changes within a clip is put right: what a person's points
err by throughout is part of where they lie on a head.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracker.energy import LID_PAIRS, LIP_PAIRS
from tracker.similarity import similarity
from tracker.track import F32, F64

ASSET = Path(__file__).parent / "assets" / "landmark_bias.npz"
FARTHEST_TURN = 0.5  # rad; what was not seen when the map was learned errs as the farthest that was
FARTHEST_SCORE = 3.0  # standard deviations
# An opening between lips or lids that is read wider errs as the map tells; skin that touches cannot come nearer.
OPEN_M = 0.004
TOGETHER = 1000  # frames, to bound memory


@dataclass(frozen=True)
class LandmarkBias:
    """A map from how a face looks in its L landmarks [L] i32 to what each of the 478 errs by.

    steady: [L] bool, those of the rigid upper face, and mean: [L, 3] m, all of them on the mean head, head axes.
    modes: [K, L, 3] 1/m, whose products with a face's departure from its usual shape are its scores, of sd 1.
    rate: [2 + K, 478, 2] m per rad of yaw and of nod and per score, x right and y down in the picture of a face held
    upright; 0 for landmarks that lie on no skin.
    """

    landmarks: NDArray[np.int32]
    steady: NDArray[np.bool_]
    mean: F32
    modes: F32
    rate: F32

    def seen(self, points: NDArray[np.floating]) -> tuple[F64, F64, F64, F64]:
        """How the faces with the points [n, 478, 3] px stand in the picture, and their shapes.

        Returns turns [n, 2] rad (yaw to the subject's left and nod upwards, of the way from the head to the camera),
        shapes [n, L, 3] m in head axes, scales [n] px/m, and a face's right and down in the picture [n, 2, 2].
        """
        all_points = points[:, self.landmarks].astype(np.float64)
        points = all_points[:, self.steady]
        mean = np.broadcast_to(self.mean[self.steady].astype(np.float64), points.shape)
        scale, rotation, _ = similarity(mean, points)
        shapes = (all_points - points.mean(1, keepdims=True)) @ rotation / scale[:, None, None]
        x, y, z = -rotation[:, 2].T
        down = -rotation[:, :2, 1] / np.linalg.norm(rotation[:, :2, 1], axis=1, keepdims=True)
        right = np.stack([down[:, 1], -down[:, 0]], axis=1)
        turns = np.stack([np.arctan2(x, z), np.arctan2(y, z)], axis=1)
        return turns, shapes, scale, np.stack([right, down], axis=1)

    def taken_out(self, points: F32, usable: NDArray[np.bool_]) -> F32:
        """The points [n, 478, 3] px of a clip, NaN where there is no face, less what they err by.

        usable: [n], frames of the person meant. What their points err by when the face is as it usually is in them
        (the median) stays.
        """
        out = points.copy()
        known = np.flatnonzero(np.isfinite(points).all(axis=(1, 2)))
        if not usable[known].any():
            return out
        parts = np.array_split(known, range(TOGETHER, len(known), TOGETHER))
        features = np.concatenate([self._features(points[rows]) for rows in parts])
        features -= np.median(features[usable[known]], axis=0)
        limit = np.repeat([FARTHEST_TURN, FARTHEST_SCORE], [2, len(self.modes)])
        features = np.clip(features, -limit, limit)
        for rows in parts:
            mine = features[np.searchsorted(known, rows)]
            out[rows, :, :2] -= self._errors(points[rows], mine).astype(np.float32)
        return out

    def _features(self, points: NDArray[np.floating]) -> F64:
        """[n, 2 + K] turns, rad, and scores of faces."""
        turns, shapes, _, _ = self.seen(points)
        return np.concatenate([turns, np.tensordot(shapes, self.modes, axes=((1, 2), (1, 2)))], axis=1)

    def _errors(self, points: NDArray[np.floating], features: F64) -> F64:
        """[n, 478, 2] px that the points err by, told by the features' departures [n, 2 + K] from the usual."""
        _, _, scale, axes = self.seen(points)
        errors = np.tensordot(features, self.rate, axes=1) @ axes * scale[:, None, None]
        upper, lower = np.array([*LIP_PAIRS, *LID_PAIRS]).T
        apart = np.linalg.norm(points[:, upper, :2] - points[:, lower, :2], axis=2)
        shut = np.clip(1 - apart / (OPEN_M * scale[:, None]), 0, 1)[..., None]
        together = shut * (errors[:, upper] - errors[:, lower]) / 2
        errors[:, upper] -= together
        errors[:, lower] += together
        return errors


@cache
def landmark_bias() -> LandmarkBias:
    """As learned."""
    with np.load(ASSET, allow_pickle=False) as file:
        return LandmarkBias(**file)
