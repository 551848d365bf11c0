"""Feature tracks on the rigid upper face: corners followed from frame to frame, never from one shot to another."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.landmark_indices import LEFT_EYE, LEFT_EYE_OUTER, RIGHT_EYE, RIGHT_EYE_OUTER, UPPER_FACE
from tracker.track import F32, Landmarks

SPACING_S = 0.12  # between the frames that are followed: about every third at 25 fps
WINDOW = 25  # followed frames, 3 s: the unit in which a long clip is thinned
MAX_FRAMES = 400
MIN_PRESENCE = 0.5
CORNERS = 250
REPLENISH = 5  # followed frames between searches for new corners
EYE_DISTANCE = (
    120.0  # px between the outer eye corners, at most: a larger face is followed in a smaller picture
)
FORWARD_BACKWARD = 0.3  # px, a track that does not come back to within it ends
MIN_LENGTH = 5  # observations of a track that is kept

Frame = tuple[float, NDArray[np.uint8]]


@dataclass(frozen=True)
class FeatureTracks:
    """What was followed. frames: [M] i4, ascending. window: [M] i4, tracks live within one window.

    observations: [O, 4] f4 (frame, track, x px, y px), by frame; tracks are numbered 0..Q-1.
    """

    frames: NDArray[np.int32]
    window: NDArray[np.int32]
    observations: F32


def choose_frames(
    landmarks: Landmarks, usable: NDArray[np.bool_], segments: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Frames to follow and the window of each, both [M]: of a long clip, the parts in which the head turns most.

    usable: [T] bool. segments: [T], number of the uninterrupted shot.
    """
    good = usable & (landmarks.presence >= MIN_PRESENCE)
    interval = float(np.median(np.diff(landmarks.time))) if len(landmarks.time) > 1 else SPACING_S
    step = max(1, round(SPACING_S / max(interval, 1e-3)))
    starts = np.flatnonzero(np.diff(np.where(good, segments, -1), prepend=-2))
    runs = [run[::step] for run in np.split(np.arange(len(good)), starts[1:]) if good[run].all()]
    windows = [run[i : i + WINDOW] for run in runs for i in range(0, len(run), WINDOW)]
    windows = [window for window in windows if len(window) >= MIN_LENGTH]
    turn = [np.ptp(turning(landmarks.points[window]), axis=0).max() for window in windows]
    kept: list[int] = []
    for i in np.argsort(turn)[::-1]:
        if sum(len(windows[k]) for k in kept) + len(windows[i]) <= MAX_FRAMES:
            kept.append(int(i))
    empty = np.zeros(0, np.int32)
    if not kept:
        return empty, empty
    chosen = [windows[i] for i in sorted(kept)]
    frames = np.concatenate(chosen).astype(np.int32)
    # Neighbours in one shot are one window: tracks live on.
    gap = np.diff(frames) != step
    apart = gap | (np.diff(segments[frames]) != 0)
    return frames, np.concatenate([[0], np.cumsum(apart)]).astype(np.int32)


def turning(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """[n, 2] where the nose tip lies against the eyes, in eye distances: grows with the turn of the head."""
    right, left = points[:, RIGHT_EYE_OUTER, :2], points[:, LEFT_EYE_OUTER, :2]
    across = left - right
    down = np.stack([-across[:, 1], across[:, 0]], axis=1)
    nose = points[:, 1, :2] - (left + right) / 2
    size = (across**2).sum(1, keepdims=True)
    return np.stack([(nose * across).sum(1), (nose * down).sum(1)], axis=1) / size


def track_features(
    frames: Iterable[Frame],
    landmarks: Landmarks,
    usable: NDArray[np.bool_],
    segments: NDArray[np.int32],
    progress: Callable[[int, int], None] | None = None,
) -> FeatureTracks:
    """Follows about CORNERS corners of the rigid upper face through the clip.

    frames: (time s, rgb [H, W, 3] u8), as many as the landmarks. usable: [T] bool. segments: [T], number of the
    uninterrupted shot.
    """
    chosen, window = choose_frames(landmarks, usable, segments)
    total = len(landmarks.time)
    eyes = landmarks.points[chosen][:, [RIGHT_EYE_OUTER, LEFT_EYE_OUTER], :2]
    distance = float(np.median(np.linalg.norm(eyes[:, 0] - eyes[:, 1], axis=-1))) if len(chosen) else 1.0
    follower = _Follower(min(1.0, EYE_DISTANCE / distance))
    place = {int(frame): i for i, frame in enumerate(chosen)}
    rows = []
    for index, (_, rgb) in enumerate(frames):
        if progress is not None:
            progress(index + 1, total)
        if index not in place:
            continue
        i = place[index]
        if i == 0 or window[i] != window[i - 1]:
            follower.reset()
        tracks, xy = follower.next(rgb, landmarks.points[index, :, :2])
        rows.append(np.column_stack([np.full(len(tracks), index), tracks, xy]))
    observations = _long_tracks(np.concatenate(rows) if rows else np.zeros((0, 4)))
    return FeatureTracks(chosen, window, observations)


def _long_tracks(observations: NDArray[np.float64]) -> F32:
    """The observations of tracks of at least MIN_LENGTH, renumbered without gaps."""
    numbers = observations[:, 1].astype(np.int64)
    keep = np.bincount(numbers, minlength=1)[numbers] >= MIN_LENGTH
    kept = observations[keep]
    kept[:, 1] = np.unique(kept[:, 1], return_inverse=True)[1]
    return kept.astype(np.float32)


class _Follower:
    """Corners and where they are, in a picture scaled by `scale`."""

    def __init__(self, scale: float) -> None:
        self._scale = scale
        self._next_number = 0
        self.reset()

    def reset(self) -> None:
        """Drops all tracks."""
        self._gray: NDArray[np.uint8] | None = None
        self._face = np.zeros((0, 2), np.float32)
        self._xy = np.zeros((0, 2), np.float32)
        self._numbers = np.zeros(0, np.int64)
        self._age = 0

    def next(self, rgb: NDArray[np.uint8], points: F32) -> tuple[NDArray[np.int64], F32]:
        """Numbers [n] and places [n, 2] px of the corners seen in this picture; points: landmarks [478, 2] px."""
        gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if self._scale < 1:
            gray = cv2.resize(gray, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA)
        scale = np.array(gray.shape[::-1]) / np.array(rgb.shape[1::-1])
        face = ((points + 0.5) * scale - 0.5).astype(np.float32)
        region = upper_face_mask(face, gray.shape)
        if self._gray is not None and len(self._xy):
            self._follow(gray, face, region)
        if self._age % REPLENISH == 0:
            self._replenish(gray, region, face)
        self._gray, self._face, self._age = gray, face, self._age + 1
        return self._numbers.copy(), ((self._xy + 0.5) / scale - 0.5).astype(np.float32)

    def _follow(self, gray: NDArray[np.uint8], face: F32, region: NDArray[np.uint8]) -> None:
        rigid = list(UPPER_FACE)
        motion, _ = cv2.estimateAffinePartial2D(self._face[rigid], face[rigid])
        guess = self._xy if motion is None else self._xy @ motion[:, :2].T + motion[:, 2]
        forward, found = _flow(self._gray, gray, self._xy, guess)
        back, returned = _flow(gray, self._gray, forward, self._xy)
        x, y = np.clip(forward.round().astype(int), 0, np.array(gray.shape[::-1]) - 1).T
        error = np.linalg.norm(back - self._xy, axis=1)
        keep = found & returned & (error < FORWARD_BACKWARD) & (region[y, x] > 0)
        self._xy, self._numbers = forward[keep], self._numbers[keep]

    def _replenish(self, gray: NDArray[np.uint8], region: NDArray[np.uint8], face: F32) -> None:
        wanted = CORNERS - len(self._xy)
        if wanted <= 0:
            return
        # Evenly over the region: as many corners as fit at this distance.
        apart = max(2.0, 0.7 * np.sqrt(np.count_nonzero(region) / CORNERS))
        free = region.copy()
        for x, y in self._xy.round().astype(int):
            cv2.circle(free, (int(x), int(y)), round(apart), 0, -1)
        corners = cv2.goodFeaturesToTrack(gray, wanted, 0.002, apart, mask=free, blockSize=5)
        if corners is None:
            return
        new = corners.reshape(-1, 2).astype(np.float32)
        self._xy = np.concatenate([self._xy, new])
        self._numbers = np.concatenate([self._numbers, self._next_number + np.arange(len(new))])
        self._next_number += len(new)


def _flow(
    old: NDArray[np.uint8] | None, new: NDArray[np.uint8] | None, xy: F32, guess: F32
) -> tuple[F32, NDArray[np.bool_]]:
    """Places [n, 2] px in `new` of the points xy of `old`, and whether each was found [n]."""
    places, status, _ = cv2.calcOpticalFlowPyrLK(
        old,
        new,
        np.ascontiguousarray(xy, np.float32),
        np.ascontiguousarray(guess, np.float32).copy(),
        winSize=(15, 15),
        maxLevel=2,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return places, status[:, 0] > 0


def upper_face_mask(points: F32, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """[H, W] u8, 255 on the upper face above the mouth, eyes cut out; points: landmarks [478, 2] px."""
    mask = np.zeros(shape[:2], np.uint8)
    whole = points.round().astype(np.int32)
    cv2.fillConvexPoly(mask, cv2.convexHull(whole[list(UPPER_FACE)]), 255)
    lids = round(0.1 * float(np.linalg.norm(points[LEFT_EYE_OUTER] - points[RIGHT_EYE_OUTER])))
    for eye in (LEFT_EYE, RIGHT_EYE):
        hull = cv2.convexHull(whole[list(eye)])
        cv2.fillConvexPoly(mask, hull, 0)
        cv2.polylines(mask, [hull], isClosed=True, color=0, thickness=2 * max(1, lids))
    return mask
