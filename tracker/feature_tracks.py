"""Feature tracks on the rigid upper face: patches found again all through the clip, as each was first seen."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.landmark_indices import LEFT_EYE, LEFT_EYE_OUTER, RIGHT_EYE, RIGHT_EYE_OUTER, UPPER_FACE
from tracker.patch_registration import NO_TEMPLATES, cut_templates, fine_texture, register
from tracker.track import F32, F64, Landmarks

SPACING_S = 0.12  # between the frames that are followed: about every third at 25 fps
MIN_PRESENCE = 0.5
CORNERS = 250  # wanted in a picture
# A patch that was looked for so often, and found in less than one in so many, is given up: of a clip of an hour there
# would be more of them than can be looked for.
PATIENCE = 10
REPLENISH = 5  # followed frames between searches for new corners
EYE_DISTANCE = (
    160.0  # px between the outer eye corners, at most: a larger face is followed in a smaller picture
)
REACH = 0.35  # eye distances, of the landmarks that carry a patch along
MIN_SHRINK = 0.3  # of its area: a patch seen more aslant is not looked for
MIN_LENGTH = 5  # observations of a track that is kept

Frame = tuple[float, NDArray[np.uint8]]


@dataclass(frozen=True)
class FeatureTracks:
    """What was followed. frames: [M] i4, ascending.

    observations: [O, 4] f4 (frame, track, x px, y px), by frame; tracks are numbered 0..Q-1.
    """

    frames: NDArray[np.int32]
    observations: F32

    def select(self, rows: NDArray[np.integer], most: int) -> FeatureTracks:
        """What was seen in some of the frames, of no more tracks than `most`, numbered as before.

        They are the longest of each frame: of all frames alike, since shots may have no track in common.
        """
        frames = self.frames[rows]
        seen = self.observations[np.isin(self.observations[:, 0], frames)]
        number = seen[:, 1].astype(np.int64)
        length = np.bincount(number, minlength=1)
        order = np.lexsort((-length[number], seen[:, 0]))
        _, first, count = np.unique(seen[:, 0], return_index=True, return_counts=True)
        place = np.empty(len(seen), np.int64)
        place[order] = np.arange(len(seen)) - np.repeat(first, count)
        best = np.full(len(length), len(seen))
        np.minimum.at(best, number, place)
        chosen = np.lexsort((-length, best))[:most]
        return FeatureTracks(frames, seen[np.isin(number, chosen)])


def followed_frames(
    landmarks: Landmarks, usable: NDArray[np.bool_], segments: NDArray[np.int32]
) -> NDArray[np.int32]:
    """[M] frames to follow: the first of each shot in which a face is seen, then one about every SPACING_S.

    usable: [T] bool. segments: [T], number of the uninterrupted shot.
    """
    good = np.flatnonzero(usable & (landmarks.presence >= MIN_PRESENCE))
    interval = float(np.median(np.diff(landmarks.time))) if len(landmarks.time) > 1 else 0.0
    chosen: list[int] = []
    for frame in good.tolist():
        if (
            not chosen
            or segments[frame] != segments[chosen[-1]]
            or landmarks.time[frame] - landmarks.time[chosen[-1]] > SPACING_S - interval / 2
        ):
            chosen.append(frame)
    return np.array(chosen, np.int32)


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
    """Follows about CORNERS corners of the rigid upper face through the clip, its cuts included: it stays one face.

    frames: (time s, rgb [H, W, 3] u8), as many as the landmarks. usable: [T] bool. segments: [T], number of the
    uninterrupted shot.
    """
    chosen = followed_frames(landmarks, usable, segments)
    total = len(landmarks.time)
    eyes = landmarks.points[chosen][:, [RIGHT_EYE_OUTER, LEFT_EYE_OUTER], :2]
    distance = float(np.median(np.linalg.norm(eyes[:, 0] - eyes[:, 1], axis=-1))) if len(chosen) else 1.0
    follower = _Follower(min(1.0, EYE_DISTANCE / distance))
    wanted = set(chosen.tolist())
    rows = []
    for index, (_, rgb) in enumerate(frames):
        if progress is not None:
            progress(index + 1, total)
        if index not in wanted:
            continue
        tracks, xy = follower.next(rgb, landmarks.points[index, :, :2])
        rows.append(np.column_stack([np.full(len(tracks), index), tracks, xy]))
    observations = _long_tracks(np.concatenate(rows) if rows else np.zeros((0, 4)))
    return FeatureTracks(chosen, observations)


def _long_tracks(observations: NDArray[np.float64]) -> F32:
    """The observations of tracks of at least MIN_LENGTH, renumbered without gaps."""
    numbers = observations[:, 1].astype(np.int64)
    keep = np.bincount(numbers, minlength=1)[numbers] >= MIN_LENGTH
    kept = observations[keep]
    kept[:, 1] = np.unique(kept[:, 1], return_inverse=True)[1]
    return kept.astype(np.float32)


class _Follower:
    """Patches and where they were last, in a picture scaled by `scale`.

    A patch is looked for in each picture as it was first seen, bent as the landmarks around it moved: its error does
    not grow with time, and it is found again after it was hidden.
    """

    def __init__(self, scale: float) -> None:
        self._scale = scale
        self._templates = NO_TEMPLATES
        self._begun_count = 0
        self._numbers = np.zeros(0, np.int64)
        self._begun = np.zeros((0, 2))  # px, where each was first seen
        self._face = np.zeros((0, len(UPPER_FACE), 2))  # px, the landmarks there
        self._offset = np.zeros((0, 2))  # px, from where the landmarks put it to where it was last
        self._tries, self._finds = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._age = 0

    def next(self, rgb: NDArray[np.uint8], points: F32) -> tuple[NDArray[np.int64], F32]:
        """Numbers [n] and places [n, 2] px of the patches seen in this picture; points: landmarks [478, 2] px."""
        gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if self._scale < 1:
            gray = cv2.resize(gray, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA)
        scale = np.array(gray.shape[::-1]) / np.array(rgb.shape[1::-1])
        face = ((points + 0.5) * scale - 0.5).astype(np.float32)
        region, texture = upper_face_mask(face, gray.shape), fine_texture(gray)
        rows, xy = self._found(texture, face, region)
        numbers = self._numbers[rows]
        if self._age % REPLENISH == 0:
            self._give_up()
            more, places = self._replenished(texture, face, region, xy)
            numbers, xy = np.concatenate([numbers, more]), np.concatenate([xy, places])
        self._age += 1
        return numbers, ((xy + 0.5) / scale - 0.5).astype(np.float32)

    def _found(self, texture: F32, face: F32, region: NDArray[np.uint8]) -> tuple[NDArray[np.int64], F64]:
        """Rows [n] of the patches seen again, and where [n, 2] px."""
        if not len(self._numbers):
            return np.zeros(0, np.int64), np.zeros((0, 2))
        reach = REACH * float(np.linalg.norm(face[LEFT_EYE_OUTER] - face[RIGHT_EYE_OUTER]))
        expected, bend = _carried(self._begun, self._face, face[list(UPPER_FACE)].astype(np.float64), reach)
        guess = expected + self._offset
        rows = np.flatnonzero(_inside(region, guess) & (np.linalg.det(bend) > MIN_SHRINK))
        self._tries[rows] += 1
        xy, found = register(texture, guess[rows], bend[rows], self._templates.select(rows))
        found &= _inside(region, xy)
        rows, xy = rows[found], xy[found]
        self._finds[rows] += 1
        self._offset[rows] = xy - expected[rows]
        return rows, xy

    def _give_up(self) -> None:
        """Drop the patches that are hardly ever found."""
        hopeful = (self._tries < PATIENCE) | (PATIENCE * self._finds > self._tries)
        self._templates = self._templates.select(hopeful)
        for name in ("_numbers", "_begun", "_face", "_offset", "_tries", "_finds"):
            setattr(self, name, getattr(self, name)[hopeful])

    def _replenished(
        self, texture: F32, face: F32, region: NDArray[np.uint8], seen: F64
    ) -> tuple[NDArray[np.int64], F64]:
        """Numbers [n] and places [n, 2] px of new patches where none of those seen [k, 2] px is."""
        wanted = CORNERS - len(seen)
        # Evenly over the region: as many corners as fit at this distance.
        apart = max(2.0, 0.7 * np.sqrt(np.count_nonzero(region) / CORNERS))
        free = region.copy()
        for x, y in seen.round().astype(int):
            cv2.circle(free, (int(x), int(y)), round(apart), 0, -1)
        corners = None
        if wanted > 0:
            corners = cv2.goodFeaturesToTrack(texture, wanted, 0.002, apart, mask=free, blockSize=5)
        if corners is None:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        places = corners.reshape(-1, 2).astype(np.float64)
        templates = cut_templates(texture, places)
        sound = templates.corners()
        places, count = places[sound], int(sound.sum())
        numbers = self._begun_count + np.arange(count)
        self._begun_count += count
        self._numbers = np.concatenate([self._numbers, numbers])
        self._templates = self._templates.joined(templates.select(sound))
        self._begun = np.concatenate([self._begun, places])
        landmarks = np.broadcast_to(face[list(UPPER_FACE)], (count, len(UPPER_FACE), 2))
        self._face = np.concatenate([self._face, landmarks])
        self._offset = np.concatenate([self._offset, np.zeros((count, 2))])
        self._tries, self._finds = (
            np.concatenate([counted, np.zeros(count, np.int64)]) for counted in (self._tries, self._finds)
        )
        return numbers, places


def _carried(xy: F64, before: F64, now: F64, reach: float) -> tuple[F64, F64]:
    """Where the landmarks around them carry points xy [n, 2] px, and the affine motion there [n, 2, 2].

    before: [n, L, 2] px, the landmarks when each point was at xy. now: [L, 2] px. reach: px, of a landmark's weight.
    """
    weight = np.exp(-((before - xy[:, None]) ** 2).sum(-1) / (2 * reach**2)) + 1e-6
    weight /= weight.sum(1, keepdims=True)
    centre, goal = np.einsum("nl,nli->ni", weight, before), weight @ now
    old, new = before - centre[:, None], now - goal[:, None]
    spread = np.einsum("nl,nli,nlj->nij", weight, old, old)
    bend = np.einsum("nl,nli,nlj->nij", weight, new, old) @ np.linalg.inv(spread)
    return goal + np.einsum("nij,nj->ni", bend, xy - centre), bend


def _inside(region: NDArray[np.uint8], xy: F64) -> NDArray[np.bool_]:
    x, y = np.clip(np.nan_to_num(xy).round().astype(int), 0, np.array(region.shape[::-1]) - 1).T
    return region[y, x] > 0


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
