"""The frames from which a clip's identity is solved: at rest and not, as unlike each other as the clip has them.

Spread in time alone they would show what is common again and again, and a turn of a second in a minute not at all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from tracker.feature_tracks import turning
from tracker.landmark_indices import LEFT_EYE_OUTER, RIGHT_EYE_OUTER
from tracker.track import F64

KEY_FRAMES = 48
# Of a short clip so many at least, and no more than one of so many frames: neighbours show the same.
FEW, APART = 16, 3
REST_SHARE = 0.5  # of the key frames: frames at rest, which tell the neutral face

Frames = NDArray[np.int64]


def key_frames(observed: F64, px_per_m: F64, count: int = KEY_FRAMES) -> tuple[Frames, Frames]:
    """Frames at rest (mouth closed, little motion) spread over poses, and others, over poses and expressions.

    `count` at most, fewer of a short clip, REST_SHARE of them at rest. observed: [n, 478, 2] px.
    """
    n = len(observed)
    opening = np.linalg.norm(observed[:, 13] - observed[:, 14], axis=-1) / px_per_m
    lips = (observed[:, [61, 291, 13, 14]] - observed[:, [1]]) / px_per_m[:, None, None]
    speed = np.zeros(n)
    speed[1:] = np.linalg.norm(np.diff(lips, axis=0), axis=-1).max(1)
    quiet = np.sort(np.argsort(opening + speed, kind="stable")[: max(1, n // 5)])
    pose, features = _looks(observed, px_per_m)
    count = min(n, count, max(FEW, n // APART))
    usual = np.linalg.norm(pose[quiet] - np.median(pose[quiet], axis=0), axis=1).argmin()
    rest = farthest(pose, quiet[[usual]], quiet, max(1, int(count * REST_SHARE)))
    return np.sort(rest), np.sort(farthest(features, rest, np.arange(n), count)[len(rest) :])


def _looks(observed: F64, px_per_m: F64) -> tuple[F64, F64]:
    """What tells the pose, [n, 2] m: the nose's tip against the eyes; and with how mouth and lids stand, [n, 5] m.

    The median of three frames: one frame's slip of the landmarker is no pose of its own.
    """
    eyes = np.linalg.norm(observed[:, LEFT_EYE_OUTER] - observed[:, RIGHT_EYE_OUTER], axis=-1)
    apart = np.linalg.norm(observed[:, [13, 61, 159, 386]] - observed[:, [14, 291, 145, 374]], axis=-1)
    nose = turning(observed) * eyes[:, None]
    features = np.column_stack([nose, apart[:, :2], apart[:, 2:].mean(1)]) / px_per_m[:, None]
    features = median_filter(features, (3, 1), mode="nearest")
    return features[:, :2], features


def farthest(points: F64, chosen: Frames, among: Frames, count: int) -> Frames:
    """`chosen` and further rows `among` points [n, F], each the farthest from those before, until there are `count`.

    Gonzalez 1985. Ends early where all that is left looks like one chosen already.
    """
    distance = np.linalg.norm(points[among, None] - points[chosen], axis=-1).min(1)
    found = list(chosen)
    while len(found) < count and distance.max() > 0:
        found.append(among[np.argmax(distance)])
        distance = np.minimum(distance, np.linalg.norm(points[among] - points[found[-1]], axis=-1))
    return np.array(found)
