"""Feature tracks on the rigid upper face: patches found again all through the clip, as each was first seen."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.landmark_indices import LEFT_EYE, LEFT_EYE_OUTER, RIGHT_EYE, RIGHT_EYE_OUTER, UPPER_FACE
from tracker.patch_registration import NO_TEMPLATES, cut_templates, fine_texture, register
from tracker.track import F32, F64

SPACING_S = 0.12  # between the frames that are followed: about every third at 25 fps
CORNERS = 250  # wanted in a picture
# A patch that was looked for so often, and found in less than one in so many, is given up: of a clip of an hour there
# would be more of them than can be looked for.
PATIENCE = 10
REPLENISH = 5  # followed frames between searches for new corners
# px between the outer eye corners, about: a larger face is followed in a picture shrunk by whole GRID-ths.
EYE_DISTANCE, GRID = 160.0, 16
AROUND = 48.0  # px around the upper face: patches' halves, their search and what the texture's blurs reach
REACH = 0.35  # eye distances, of the landmarks that carry a patch along
MIN_SHRINK = 0.3  # of its area: a patch seen more aslant is not looked for
MIN_LENGTH = 5  # observations of a track that is kept
ASIDE = 0.45  # eye distances, of the nose's tip: a turn of some 33 degrees


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


def turning(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """[n, 2] where the nose tip lies against the eyes, in eye distances: grows with the turn of the head."""
    right, left = points[:, RIGHT_EYE_OUTER, :2], points[:, LEFT_EYE_OUTER, :2]
    across = left - right
    down = np.stack([-across[:, 1], across[:, 0]], axis=1)
    nose = points[:, 1, :2] - (left + right) / 2
    size = (across**2).sum(1, keepdims=True)
    return np.stack([(nose * across).sum(1), (nose * down).sum(1)], axis=1) / size


def turned_as_usual(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Rows of landmarks [n, 478, 2 or 3], at least one of any, in which the head is turned about as it usually is.

    Not farther aside than landmarks and patches are to be believed, which err there by more than they tell.
    """
    turn = turning(points).astype(np.float64)
    usual = turn[np.linalg.norm(turn - np.median(turn, axis=0), axis=1).argmin()]
    return np.flatnonzero(np.linalg.norm(turn - usual, axis=1) <= ASIDE)


def _long_tracks(observations: NDArray[np.float64]) -> F32:
    """The observations of tracks of at least MIN_LENGTH, renumbered without gaps."""
    numbers = observations[:, 1].astype(np.int64)
    keep = np.bincount(numbers, minlength=1)[numbers] >= MIN_LENGTH
    kept = observations[keep]
    kept[:, 1] = np.unique(kept[:, 1], return_inverse=True)[1]
    return kept.astype(np.float32)


@dataclass(frozen=True)
class _Part:
    """The upper face of a shrunk picture, [h, w] px from its `corner` [2] on; mask: see `upper_face_mask`."""

    corner: NDArray[np.int64]
    texture: F32
    mask: NDArray[np.uint8]

    def shows(self, xy: F64) -> NDArray[np.bool_]:
        """[n] whether the upper face is at xy [n, 2] px of the shrunk picture; beyond a part its border counts."""
        within = np.nan_to_num(xy).round().astype(int) - self.corner
        x, y = np.clip(within, 0, np.array(self.mask.shape[::-1]) - 1).T
        return self.mask[y, x] > 0


def _part(rgb: NDArray[np.uint8], face: F32, scale: float) -> _Part:
    """Around the upper face of landmarks `face` [478, 2] px of the picture shrunk to `scale`, a multiple of 1 / GRID.

    In steps of GRID px a part shrinks to whole pixels, and to the same as if the whole picture were shrunk.
    """
    upper, whole = face[list(UPPER_FACE)], np.maximum(np.array(rgb.shape[1::-1]) // GRID, 1)
    low = np.clip(np.floor((upper.min(0) - AROUND) / scale / GRID), 0, whole - 1).astype(np.int64)
    high = np.clip(np.ceil((upper.max(0) + AROUND) / scale / GRID), low + 1, whole).astype(np.int64)
    left, top, right, bottom = GRID * np.concatenate([low, high])
    gray = cv2.cvtColor(rgb[top:bottom, left:right], cv2.COLOR_RGB2GRAY)
    corner = np.round(GRID * scale * low).astype(np.int64)
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return _Part(corner, fine_texture(gray), upper_face_mask(face - corner.astype(np.float32), gray.shape))


class FeatureFollower:
    """Follows about CORNERS corners of the rigid upper face through a clip, its cuts included: it stays one face.

    It looks at each picture while its landmarks are read, with no pass over the video of its own. A patch is looked for
    as it was first seen, bent as the landmarks around it moved: its error does not grow with time, and it is found
    again after it was hidden. Places are in px of the shrunk picture.
    """

    def __init__(
        self, time: F64, usable: NDArray[np.bool_], segments: NDArray[np.int32], boxes: F32 | None = None
    ) -> None:
        """time: [T] s. usable: [T]. segments: [T], number of the uninterrupted shot.

        boxes: [T, 4] px, left, top, right, bottom of the face, finite in usable frames: they tell its usual size.
        """
        self._time, self._usable, self._segments = time, usable, segments
        self._size = np.ones(len(time)) if boxes is None else (boxes[:, 2:] - boxes[:, :2]).max(1)
        self._step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        self._seen = 0
        self._scale = np.nan
        self._frames: list[int] = []
        self._observations = [np.zeros((0, 4))]
        self._templates = NO_TEMPLATES
        self._begun_count = 0
        self._numbers = np.zeros(0, np.int64)
        self._begun = np.zeros((0, 2))  # px, where each was first seen
        self._face = np.zeros((0, len(UPPER_FACE), 2))  # px, the landmarks there
        self._offset = np.zeros((0, 2))  # px, from where the landmarks put it to where it was last
        self._tries, self._finds = np.zeros(0, np.int64), np.zeros(0, np.int64)

    def see(self, rgb: NDArray[np.uint8], points: F32) -> None:
        """The next picture [H, W, 3] and its landmarks [478, 3] px, NaN where there is no face."""
        index, self._seen = self._seen, self._seen + 1
        if not self._due(index) or not np.isfinite(points).all():
            return
        if not self._frames:
            self._scale = self._shrinking(index, points)
        face = ((points[:, :2] + 0.5) * self._scale - 0.5).astype(np.float32)
        numbers, xy = self._followed(_part(rgb, face, self._scale), face)
        self._frames.append(index)
        places = (xy + 0.5) / self._scale - 0.5
        self._observations.append(np.column_stack([np.full(len(numbers), index), numbers, places]))

    def tracks(self) -> FeatureTracks:
        """What was followed through the pictures seen, where it is long enough to tell anything."""
        observations = _long_tracks(np.concatenate(self._observations))
        return FeatureTracks(np.array(self._frames, np.int32), observations)

    def _shrinking(self, frame: int, points: F32) -> float:
        """By how much pictures are shrunk, from the landmarks of one frame."""
        # The depth between the eyes counts as well: at the first sight the head may be turned, or near.
        eyes = float(np.linalg.norm(points[LEFT_EYE_OUTER] - points[RIGHT_EYE_OUTER]))
        usual = eyes * float(np.nanmedian(self._size[self._usable]) / self._size[frame])
        return float(np.clip(round(GRID * EYE_DISTANCE / max(usual, 1.0)), 1, GRID)) / GRID

    def _due(self, frame: int) -> bool:
        """Whether to follow into a frame, if it shows a face: the first of each shot, then about every SPACING_S."""
        if not self._usable[frame] or not self._frames:
            return bool(self._usable[frame])
        last = self._frames[-1]
        late = self._time[frame] - self._time[last] > SPACING_S - self._step / 2
        return bool(late or self._segments[frame] != self._segments[last])

    def _followed(self, part: _Part, face: F32) -> tuple[NDArray[np.int64], F64]:
        """Numbers [n] and places [n, 2] of the patches seen in a picture with landmarks `face` [478, 2]."""
        rows, xy = self._found(part, face)
        numbers = self._numbers[rows]
        if len(self._frames) % REPLENISH == 0:
            self._give_up()
            more, places = self._replenished(part, face, xy)
            numbers, xy = np.concatenate([numbers, more]), np.concatenate([xy, places])
        return numbers, xy

    def _found(self, part: _Part, face: F32) -> tuple[NDArray[np.int64], F64]:
        """Rows [n] of the patches seen again, and where [n, 2]."""
        if not len(self._numbers):
            return np.zeros(0, np.int64), np.zeros((0, 2))
        reach = REACH * float(np.linalg.norm(face[LEFT_EYE_OUTER] - face[RIGHT_EYE_OUTER]))
        expected, bend = _carried(self._begun, self._face, face[list(UPPER_FACE)].astype(np.float64), reach)
        guess = expected + self._offset
        rows = np.flatnonzero(part.shows(guess) & (np.linalg.det(bend) > MIN_SHRINK))
        self._tries[rows] += 1
        within = guess[rows] - part.corner
        xy, found = register(part.texture, within, bend[rows], self._templates.select(rows))
        xy += part.corner
        found &= part.shows(xy)
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

    def _replenished(self, part: _Part, face: F32, seen: F64) -> tuple[NDArray[np.int64], F64]:
        """Numbers [n] and places [n, 2] of new patches where none of those seen [k, 2] is."""
        wanted = CORNERS - len(seen)
        # Evenly over the upper face: as many corners as fit at this distance.
        apart = max(2.0, 0.7 * np.sqrt(np.count_nonzero(part.mask) / CORNERS))
        free = part.mask.copy()
        for x, y in (seen - part.corner).round().astype(int):
            cv2.circle(free, (int(x), int(y)), round(apart), 0, -1)
        corners = None
        if wanted > 0:
            corners = cv2.goodFeaturesToTrack(part.texture, wanted, 0.002, apart, mask=free, blockSize=5)
        if corners is None:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        within = corners.reshape(-1, 2).astype(np.float64)
        templates = cut_templates(part.texture, within)
        sound = templates.corners()
        places, count = within[sound] + part.corner, int(sound.sum())
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
