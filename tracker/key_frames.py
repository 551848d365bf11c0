"""The frames from which a clip's identity is solved: at rest and not, as unlike each other as the clip has them.

Spread in time alone they would show what is common again and again, and a turn of a second in a minute not at all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from tracker.feature_tracks import turned_as_usual, turning
from tracker.landmark_indices import LEFT_EYE_OUTER, RIGHT_EYE_OUTER
from tracker.track import F64

KEY_FRAMES = 48
# Of a short clip so many at least, and no more than one of so many frames: neighbours show the same.
FEW, APART = 16, 3
REST_SHARE = 0.5  # of the key frames: frames at rest, which tell the neutral face

USUAL_M = 0.001  # by which a mouth at rest is wider or narrower than usual where it counts half
ROUNDS = 8  # of telling how wide a mouth at rest usually is, of the frames in which it is so

Frames = NDArray[np.int64]


@dataclass(frozen=True)
class KeyFrames:
    """Rows of the frames at rest (mouth closed, little motion), spread over poses, and others, over expressions too.

    ease: [len(rest)] 0..1, how far the mouth is as wide as it usually is at rest: shut lips may smile, or be pursed.
    """

    rest: Frames
    other: Frames
    ease: F64

    @property
    def rows(self) -> Frames:
        """All of them, those at rest first."""
        return np.concatenate([self.rest, self.other])

    def of(self, rows: Frames) -> KeyFrames:
        """They are rows of `rows`."""
        return replace(self, rest=rows[self.rest], other=rows[self.other])

    def among(self, rows: Frames) -> KeyFrames:
        """Those that are among `rows`."""
        rest, other = np.isin(self.rest, rows), np.isin(self.other, rows)
        return KeyFrames(self.rest[rest], self.other[other], self.ease[rest])


def key_frames(observed: F64, px_per_m: F64, count: int = KEY_FRAMES) -> KeyFrames:
    """`count` frames at most, fewer of a short clip, REST_SHARE of them at rest. observed: [n, 478, 2] px, n > 0.

    None of them is turned much farther aside than it is usual.
    """
    usual = turned_as_usual(observed)
    return _key_frames(observed[usual], px_per_m[usual], count).of(usual)


def _key_frames(observed: F64, px_per_m: F64, count: int) -> KeyFrames:
    n = len(observed)
    opening = np.linalg.norm(observed[:, 13] - observed[:, 14], axis=-1) / px_per_m
    lips = (observed[:, [61, 291, 13, 14]] - observed[:, [1]]) / px_per_m[:, None, None]
    speed = np.zeros(n)
    speed[1:] = np.linalg.norm(np.diff(lips, axis=0), axis=-1).max(1)
    quiet = np.sort(np.argsort(opening + speed, kind="stable")[: max(1, n // 5)])
    pose, features = _looks(observed, px_per_m)
    count = min(n, count, max(FEW, n // APART))
    usual = np.linalg.norm(pose[quiet] - np.median(pose[quiet], axis=0), axis=1).argmin()
    rest = np.sort(farthest(pose, quiet[[usual]], quiet, max(1, int(count * REST_SHARE))))
    other = np.sort(farthest(features, rest, np.arange(n), count)[len(rest) :])
    width = np.linalg.norm(observed[:, 61] - observed[:, 291], axis=-1) / px_per_m
    return KeyFrames(rest, other, _ease(width, pose, quiet)[rest])


def _ease(width: F64, pose: F64, quiet: Frames) -> F64:
    """[n] 0..1, how near mouths of `width` [n] m are to what is usual in the frames `quiet` under that pose [n, 2] m.

    A parabola over the pose: turned aside, a mouth looks narrower.
    """
    apart = (pose - pose[quiet].mean(0)) / max(float(pose[quiet].std()), 1e-6)
    terms = np.column_stack([np.ones(len(pose)), apart, apart**2, apart.prod(1)])
    share = np.ones(len(quiet))
    for _ in range(ROUNDS):
        known = share[:, None] * terms[quiet]
        usual = terms @ np.linalg.lstsq(known, share * width[quiet], rcond=None)[0]
        away = (width - usual)[quiet]
        share = 1 / np.hypot(1, away / max(1.4826 * float(np.median(np.abs(away))), 1e-6))
    return np.asarray(1 / (1 + ((width - usual) / USUAL_M) ** 2))


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
