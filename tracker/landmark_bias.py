"""What the landmarker errs by as a face turns and moves, taken out of its points.

The network draws each face towards the usual one: nods come out a seventh to a quarter too small, whoever nods. So what
its points err by goes with what they show. How, was learned from pictures of people drawn by lot whose truth is known
(tools/build_landmark_bias.py), as a linear map. Of a face filmed from the front only what changes within a clip is put
right: what a person's points err by throughout is part of where they lie on a head. One filmed from aside, from above
or from below all the time errs by more than that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracker.energy import LID_PAIRS, LIP_PAIRS, TOGETHER
from tracker.similarity import similarity
from tracker.track import F32, F64

ASSET = Path(__file__).parent / "assets" / "landmark_bias.npz"
# What was not seen when the map was learned errs as the farthest that was.
FARTHEST_TURN = (0.45, 0.3)  # rad, yaw and nod
FARTHEST_SCORE = 3.0  # standard deviations
# rad: by what lies beyond, a face that is usually turned farther than this errs throughout.
USUAL_TURN = 0.1
# What two lips or lids err by apart from each other counts in full from this opening on, and the less the narrower it
# is read: not at all where they touch, so that shut ones stay as far apart as the clip's others.
OPEN_M = 0.004


@dataclass(frozen=True)
class LandmarkBias:
    """A map from how a face looks in its L landmarks [L] i32 to what each of the 478 errs by.

    steady: [L] bool, those of the rigid upper face, and mean: [L, 3] m, all of them on the mean head, head axes.
    modes: [K, L, 3] 1/m, whose products with a face's shape, less what goes with its turn, of_turn: [2, K] per rad, are
    its scores: of sd 1 about a person's mean.
    rate: [2 + K, 478, 2] m per rad of yaw and of nod and per score, x right and y down in the picture of a face held
    upright; 0 for the contour's points that slide, which have no place on the head.
    """

    landmarks: NDArray[np.int32]
    steady: NDArray[np.bool_]
    mean: F32
    modes: F32
    of_turn: F32
    rate: F32

    def seen(self, points: NDArray[np.floating]) -> tuple[F64, F64, F64, F64]:
        """How the faces with the points [n, 478, 3] px stand in the picture, and their shapes.

        Returns turns [n, 2] rad (yaw to the subject's left and nod upwards, of the way from the head to the camera),
        shapes [n, L, 3] m in head axes, scales [n] px/m, and a face's right and down in the picture [n, 2, 2].
        """
        face = points[:, self.landmarks].astype(np.float64)
        upper = face[:, self.steady]
        scale, rotation, _ = similarity(self.mean[self.steady].astype(np.float64), upper)
        shapes = (face - upper.mean(1, keepdims=True)) @ rotation / scale[:, None, None]
        x, y, z = -rotation[:, 2].T
        down = -rotation[:, :2, 1] / np.linalg.norm(rotation[:, :2, 1], axis=1, keepdims=True)
        right = np.stack([down[:, 1], -down[:, 0]], axis=1)
        turns = np.stack([np.arctan2(x, z), np.arctan2(y, z)], axis=1)
        return turns, shapes, scale, np.stack([right, down], axis=1)

    def features(self, points: NDArray[np.floating]) -> tuple[F64, F64, F64]:
        """[n, 2 + K] turns, rad, and scores of faces; their scales and axes as `seen` has them."""
        turns, shapes, scale, axes = self.seen(points)
        scores = np.tensordot(shapes, self.modes, axes=((1, 2), (1, 2))) - turns @ self.of_turn
        return np.concatenate([turns, scores], axis=1), scale, axes

    def taken_out(self, points: F32, usable: NDArray[np.bool_]) -> F32:
        """The points [n, 478, 3] px of a clip, NaN where there is no face, less what they err by.

        usable: [n], frames of the person meant. What their points err by when the face is as it usually is in them
        (the median), but faces the camera to within USUAL_TURN, stays.
        """
        out = points.copy()
        known = np.flatnonzero(np.ptp(points[:, self.landmarks, :2], axis=1).min(axis=1) > 0)
        if not usable[known].any():
            return out
        parts = np.array_split(known, range(TOGETHER, len(known), TOGETHER))
        looks = [self.features(points[rows]) for rows in parts]
        usual = np.median(np.concatenate([look[0] for look in looks])[usable[known]], axis=0)
        usual[:2] = np.clip(usual[:2], -USUAL_TURN, USUAL_TURN)
        farthest = np.array([*FARTHEST_TURN, *[FARTHEST_SCORE] * len(self.modes)])
        for rows, (features, scale, axes) in zip(parts, looks):
            departure = np.clip(features - usual, -farthest, farthest)
            errors = np.tensordot(departure, self.rate, axes=1) @ axes * scale[:, None, None]
            errors = _less_where_shut(errors, points[rows, :, :2], OPEN_M * scale)
            out[rows, :, :2] -= errors.astype(np.float32)
        return out


def _less_where_shut(errors: F64, points: F32, wide: F64) -> F64:
    """The errors [n, 478, 2] px of points [n, 478, 2] px; lips and lids err alike where they touch. wide: [n] px."""
    upper, lower = np.array([*LIP_PAIRS, *LID_PAIRS]).T
    apart = np.linalg.norm(points[:, upper] - points[:, lower], axis=2)
    shut = np.clip(1 - apart / wide[:, None], 0, 1)[..., None]
    together = shut * (errors[:, upper] - errors[:, lower]) / 2
    errors[:, upper] -= together
    errors[:, lower] += together
    return errors


@cache
def landmark_bias() -> LandmarkBias:
    """As learned."""
    with np.load(ASSET, allow_pickle=False) as file:
        return LandmarkBias(**file)
