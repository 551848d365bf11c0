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

    def next(self, rgb: U8, faces: Sequence[F32]) -> tuple[tuple[float, bool], tuple[float, bool]]:
        """See `difference`: of the whole, and of that or what surrounds a small face, whichever is most.

        faces: [4] px, their boxes in the last picture. Where one is small in a picture that stands still, as of
        somebody who shows their screen, its motion is next to nothing of the whole.
        """
        grey, before = thumbnail(rgb), self._last
        self._last = rgb, grey
        if before is None:
            return (0.0, False), (0.0, False)
        whole = change, same = difference(grey, before[1])
        for face in faces:
            if face[2] - face[0] < 1.25 * NEARLY_SMALL * SMALL_FACE * max(rgb.shape):
                nearby, alike = difference(
                    *(thumbnail(around(picture, face)[0]) for picture in (rgb, before[0]))
                )
                change, same = max(change, nearby), same and alike
        return whole, (change, same)


def sudden(change: float, before: Sequence[float]) -> bool:
    """Whether `find_shots`, which knows the pictures behind too, may take a `change` after those `before` for a cut."""
    return change > CUT_LEVEL and change > CUT_RATIO * (sorted([0.0, 0.0, *before])[-2] + USUAL_CHANGE)


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


def find_shots(time: F64, change: F64) -> NDArray[np.int32]:
    """Number [T] of the uninterrupted shot of each frame, after its `change` [T] (see `difference`)."""
    step = np.diff(time, prepend=time[0] - 1.0)
    typical = _usual_step(time)
    # Pictures that are further apart differ more without any cut.
    rate = change / np.maximum(1.0, step / typical)
    window = min(max(3, round(CUT_WINDOW_S / typical)), MOST_WINDOW)
    padded = np.pad(rate, window, mode="reflect" if len(rate) > window else "edge")
    around = np.stack([padded[i : i + len(rate)] for i in range(2 * window + 1) if i != window])
    # The second largest, so that two cuts near each other are both found.
    usual = np.sort(around, axis=0)[-2] + USUAL_CHANGE
    first = (step > MAX_GAP_S) | ((rate > CUT_LEVEL) & (rate > CUT_RATIO * usual))
    first[0] = True
    return (np.cumsum(first) - 1).astype(np.int32)


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
