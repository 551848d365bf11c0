"""Which frames of a clip are usable and why not, and its uninterrupted shots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.face_detector import around

REASONS = (
    "ok",
    "no_face",
    "cut",
    "other_person",
    "too_small",
    "too_dark",
    "too_bright",
    "blurred",
    "corrupt",
    "duplicate",
)
# The usual width of the widest face, of the picture's long side, below which cuts are told by faces' surroundings too;
# and times that, of the narrowest, below which repeated pictures are.
SMALL_FACE, NEARLY_SMALL = 0.1, 2.0
THUMBNAIL = 64  # px, long side of the grey pictures in which cuts and duplicates are looked for
MAX_GAP_S = 0.25  # a longer time between two pictures ends a shot: nothing is known of what moved there
MIN_SHOT_S = 0.5  # shorter shots are left out: too little to track
# A cut changes the picture by so much (grey levels, mean) and so many times more than its neighbours in time.
CUT_LEVEL, CUT_RATIO, CUT_WINDOW_S = 1.5, 1.9, 0.28
# What lies above the mouth of the foremost face, its hair too: shares of its box beyond its sides and its top, and of
# its height. A caption or a slide that comes changes much of the picture, and nothing there. In 8 real clips with
# captions written in and moments left out, the ratio is 1.2 at most at 98 % of captions, and less than that at 2 % of
# those cuts that the picture tells (all of one man's, who moves fast); where nothing is cut, up to 2.4 in them and 1.7
# in 600 films. Of compressed film a part of the face may stand still and jump, but the rest of the picture does not.
ASIDE, ABOVE, DOWN, FACE_SIDE = 0.1, 0.3, 0.6, 32
FACE_STAYS, FACE_JUMPS = 1.2, 3.0
USUAL_CHANGE = 0.5  # grey levels, that any two pictures differ by
SAME_LEVEL = 1.0  # grey levels: no pixel of the thumbnail changes by more in a repeated picture
# One that was coded anew changes by less than this (mean), and by so small a share of what pictures around it do.
CODED_LEVEL, CODED_SHARE = 0.12, 0.15
# In a clip of which so much is told to be repeated, by less than this: of its new pictures the share is 2 and more.
REPEATING, REPEATING_LEVEL, REPEATING_SHARE = 0.05, 0.25, 0.45
REPEATED_S = 0.085  # within which the same picture may be shown again and again; then there is a new one
MOST_WINDOW = 100  # pictures: broken time stamps may lie any number to the second

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Frames:
    """The frames of a clip, as `frames.npz` holds them.

    time: [T] s from the first picture. usable: [T]. reason: [T] index into `reasons`, 0 where usable.
    segment: [T] number of the uninterrupted shot. box: [T, 4] left, top, right, bottom px of the main person's
    face in the upright picture at full size, NaN where it is not seen.
    """

    time: F64
    usable: Bool
    reason: U8
    reasons: tuple[str, ...]
    segment: NDArray[np.int32]
    box: F32

    @property
    def seen(self) -> Bool:
        """[T] frames that show the person, usable or not."""
        return np.asarray(np.isfinite(self.box).all(axis=1))


def thumbnail(rgb: U8) -> F32:
    """A picture [H, W, 3] as a grey one, 0 to 255, whose long side is THUMBNAIL px.

    Not rounded to whole levels, by which the pictures of a dim film would be the same.
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = THUMBNAIL / max(grey.shape)
    size = [max(1, round(side * scale)) for side in grey.shape[::-1]]
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)


def difference(grey: F32, last: F32) -> tuple[float, bool]:
    """How a grey picture [h, w] differs from the one before: (mean grey levels, whether it is the same)."""
    change = np.abs(grey - last)
    return float(change.mean()), bool(change.max() <= SAME_LEVEL)


class Changes:
    """Pictures one after another, and how each differs from the one before."""

    def __init__(self) -> None:
        self._last: tuple[U8, F32] | None = None

    def next(
        self, rgb: U8, faces: Sequence[F32], foremost: F32 | None
    ) -> tuple[tuple[float, bool], tuple[float, bool], float]:
        """How it differs (see `difference`): the whole, that or what surrounds a small face, and above a mouth.

        faces: [4] px, their boxes in the last picture. Where one is small in a picture that stands still, as of
        somebody who shows their screen, its motion is next to nothing of the whole: whichever is most. foremost: the
        box of the face above whose mouth the third is told, mean grey levels; NaN without one.
        """
        grey, before = thumbnail(rgb), self._last
        self._last = rgb, grey
        if before is None:
            return (0.0, False), (0.0, False), np.nan
        whole = change, same = difference(grey, before[1])
        for face in faces:
            if face[2] - face[0] < 1.25 * NEARLY_SMALL * SMALL_FACE * max(rgb.shape):
                nearby, alike = difference(
                    *(thumbnail(around(picture, face)[0]) for picture in (rgb, before[0]))
                )
                change, same = max(change, nearby), same and alike
        there = np.nan if foremost is None else _face_change(rgb, before[0], foremost)
        return whole, (change, same), there


def _face_change(rgb: U8, last_rgb: U8, box: F32) -> float:
    """Mean grey levels by which two pictures differ above the mouth of a face in a box [4] px."""
    (left, top, right, _), (wide, high) = box, box[2:] - box[:2]
    sides = left - ASIDE * wide, right + ASIDE * wide, top - ABOVE * high, top + DOWN * high
    first, last, low, end = (max(0, round(float(side))) for side in sides)
    parts = [picture[low:end, first:last] for picture in (rgb, last_rgb)]
    if not parts[0].size:
        return np.nan
    size = (FACE_SIDE, FACE_SIDE)
    now, then = (
        cv2.resize(
            cv2.cvtColor(part, cv2.COLOR_RGB2GRAY).astype(np.float32), size, interpolation=cv2.INTER_AREA
        )
        for part in parts
    )
    return difference(np.asarray(now), np.asarray(then))[0]


def sudden(change: float, before: Sequence[float], ratio: float = CUT_RATIO) -> bool:
    """Whether `find_shots`, which knows the pictures behind too, may take a `change` after those `before` for a cut.

    ratio: CUT_RATIO for pictures, FACE_JUMPS above a mouth.
    """
    usual = sorted([0.0, 0.0, *np.nan_to_num(before)])[-2]
    return change > CUT_LEVEL and change > ratio * (usual + USUAL_CHANGE)


def repeated(time: F64, change: F64, same: Bool) -> Bool:
    """[T] pictures that repeat the one before: those that are the `same`, and those coded as if they were new ones.

    time: [T] s. change: [T], see `difference`. Of film at 24 pictures a second in a file of 30 every fifth does, of 12
    in 60 four in a row. Where nothing moves all change as little, and none is left out.
    """
    reach = min(max(2, int(REPEATED_S / _usual_step(time))), MOST_WINDOW)
    padded = np.pad(change, reach)
    before, after = (
        np.max([padded[reach + way * step :][: len(change)] for step in range(1, reach + 1)], axis=0)
        for way in (-1, 1)
    )
    around = np.minimum(before, after)
    coded = (change < CODED_LEVEL) & (change < CODED_SHARE * around)
    if coded.mean() > REPEATING:
        coded = (change < REPEATING_LEVEL) & (change < REPEATING_SHARE * around)
    return same | coded


def find_shots(time: F64, change: F64, face: F64) -> NDArray[np.int32]:
    """Number [T] of the uninterrupted shot of each frame.

    change, face: [T] grey levels by which each differs from the one before, as a whole and above the foremost mouth
    (NaN where none is seen); see `Changes`. A picture that changes around a face that stays is no cut, and a face that
    jumps is one even if the whole changes no more than around it.
    """
    step = np.diff(time, prepend=time[0] - 1.0)
    # Pictures that are further apart differ more without any cut.
    apart = np.maximum(1.0, step / _usual_step(time))
    window = min(max(3, round(CUT_WINDOW_S / _usual_step(time))), MOST_WINDOW)
    (of_all, ratio), (of_face, face_ratio) = (
        (rate, _standing_out(rate, window)) for rate in (change / apart, face / apart)
    )
    cut = (ratio > CUT_RATIO) & ~(face_ratio < FACE_STAYS)
    jump = (of_face > CUT_LEVEL) & (face_ratio > FACE_JUMPS)
    first = (step > MAX_GAP_S) | ((of_all > CUT_LEVEL) & (cut | jump))
    first[0] = True
    return (np.cumsum(first) - 1).astype(np.int32)


def _standing_out(rate: F64, window: int) -> F64:
    """[T] how many times a rate [T] is that of the frames around it, so many to both sides; NaN if few are known."""
    padded = np.pad(rate, window, mode="reflect" if len(rate) > window else "edge")
    around = np.stack([padded[i : i + len(rate)] for i in range(2 * window + 1) if i != window])
    # The second largest, so that two cuts near each other are both found.
    usual = np.sort(np.nan_to_num(around), axis=0)[-2] + USUAL_CHANGE
    return np.where(np.isnan(around).mean(0) < 0.5, rate / usual, np.nan)


def _usual_step(time: F64) -> float:
    """s from one picture to the next."""
    return float(np.median(np.diff(time))) if len(time) > 1 else 1.0


def usable_seconds(frames: Frames) -> float:
    """Time that usable frames cover, s. Frames left out inside a shot cost nothing when the gap is short."""
    return float(covered(frames).sum())


def covered(frames: Frames) -> F64:
    """[T] s that each usable frame stands for: up to the next usable one of its shot, if that is near."""
    seconds = np.zeros(len(frames.time))
    index = np.flatnonzero(frames.usable)
    if len(index) < 2:
        return seconds
    step = np.diff(frames.time[index])
    near = (step <= MAX_GAP_S) & (np.diff(frames.segment[index]) == 0)
    seconds[index] = np.median(np.diff(frames.time))
    seconds[index[:-1]] = np.where(near, step, seconds[index[:-1]])
    return seconds
