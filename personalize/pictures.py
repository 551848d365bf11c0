"""The pictures of a video, upright, at their true presentation times."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from personalize.container import MAX_DURATION_S, Source, display_matrix, frame_time, probe, square_size
from personalize.errors import UserError
from personalize.hdr import HLG, PQ, usual_range

U8 = NDArray[np.uint8]

# A damaged picture spoils those predicted from it: up to the next key frame, or this long.
DAMAGE_S = 5.0
MOST_SET_BACK = 50  # pictures in a row whose time stamps lie before what was shown: more are not broken ones
_UNSPECIFIED_COLOUR, _BT709, _BT2020 = 2, 1, 9  # FFmpeg's numbers of colour spaces
# Of BT.2020's primaries, nearly or in all; FFmpeg cannot take them to red, green and blue.
_BT2020_LIKE = (10, 12, 13)
_UNKNOWN_COLOURS = {8: "YCgCo", 14: "ICtCp"}
# By which width over height may differ from the first picture's: codecs crop by whole blocks.
OTHER_SHAPE = 0.02
AHEAD = 2  # pictures that are decoded while one is used
Item = TypeVar("Item")


class FrameReader(Iterator[tuple[float, U8]]):
    """Pictures of a video in order: (time s from the first picture, rgb [H, W, 3] u8 with square pixels).

    Times are strictly rising. After each step `damaged` says whether that picture was decoded from broken data or
    predicted from such a picture; pictures that do not decode at all are missing. `interlaced`: how many were of two
    fields. `resized_s`: when their size first changed, s; NaN if it did not. Every pass over a file gives the same
    pictures, but for what a decoder makes up in damaged ones. Raises UserError like `probe`, beyond the limits, where
    the clock is set back, where the pictures' shape changes, and of colours that FFmpeg cannot read.
    """

    def __init__(self, path: Path | str, max_side: int | None = None) -> None:
        """max_side: shrink to at most this many px on the long side."""
        self._path = Path(path)
        self._max_side = max_side
        self.info = probe(self._path)
        self.damaged = False
        self.interlaced, self.resized_s = 0, float("nan")
        # One for all pictures: making its tables takes longer than its work.
        self._reformatter = VideoReformatter()
        self._pictures = _ahead(self._read())

    def __next__(self) -> tuple[float, U8]:
        time, picture, self.damaged = next(self._pictures)
        return time, picture

    def _read(self) -> Generator[tuple[float, U8, bool]]:
        """Time, picture, and whether it is damaged."""
        start, step = self.info.video_start_s, 1 / self.info.fps if self.info.fps else 0.04
        damage_end, size, whole = -1.0, (0, 0), (0, 0)
        matrix, lost = np.eye(2, dtype=np.int64), 0
        with Source(self._path) as source:
            source.video.thread_type = "AUTO"
            for time, frame in _in_time(source.decode(source.video), start, step, self._path):
                seen = square_size(source.video, frame)
                if not size[0]:  # later pictures are scaled to the size of the first
                    matrix, size, whole = display_matrix(frame), self._size(*seen), seen
                self._check_size(time, whole, seen)
                self.interlaced += bool(frame.interlaced_frame)
                if frame.is_corrupt or (source.lost > lost and not frame.key_frame):
                    damage_end = time + DAMAGE_S
                elif frame.key_frame:
                    damage_end = -1.0
                lost = source.lost
                yield time, _turned(self._to_rgb(frame, size), matrix), time <= damage_end

    def _check_size(self, time: float, first: tuple[int, int], now: tuple[int, int]) -> None:
        if now == first:
            return
        if abs(now[0] / now[1] / (first[0] / first[1]) - 1) > OTHER_SHAPE:
            raise UserError(
                f"{self._path}: the picture's shape changes at {time:.1f} s, from {first[0]}x{first[1]} to "
                f"{now[0]}x{now[1]} px, as where a telephone is turned; give the part before or after"
            )
        if not self.resized_s <= time:
            self.resized_s = time

    def _size(self, width: int, height: int) -> tuple[int, int]:
        scale = min(1.0, self._max_side / max(width, height)) if self._max_side else 1.0
        return max(1, round(width * scale)), max(1, round(height * scale))

    def _to_rgb(self, frame: Any, size: tuple[int, int]) -> U8:
        """Any pixel format to [height, width, 3] u8 at `size` (width, height), as stored."""
        high = frame.color_trc in (HLG, PQ)
        colours = None
        if frame.colorspace in _UNKNOWN_COLOURS:
            name = _UNKNOWN_COLOURS[frame.colorspace]
            raise UserError(
                f"{self._path}: its colours are {name}, which cannot be read; export it as ordinary 8-bit H.264"
            )
        if frame.colorspace == _UNSPECIFIED_COLOUR:
            # HD that does not name its colours is BT.709 by convention; FFmpeg would take BT.601.
            colours = _BT2020 if high else _BT709 if frame.height >= 720 else None
        elif frame.colorspace in _BT2020_LIKE:
            colours = _BT2020
        rgb = self._reformatter.reformat(
            frame,
            width=size[0],
            height=size[1],
            format="gbrp16le" if high else "rgb24",
            threads=1,
            interpolation="AREA" if frame.width > size[0] else "BICUBIC",
            src_colorspace=colours,
        ).to_ndarray()
        if high:
            return usual_range(np.asarray(rgb, np.uint16), frame.color_trc)
        return np.asarray(rgb, np.uint8)


def _in_time(frames: Iterable[Any], start: float, step: float, path: Path) -> Generator[tuple[float, Any]]:
    """Those of a stream's frames that lie behind all before them: their times, s after `start`, and they themselves.

    step: s, from the first frame to one without a time; later ones come as far behind as the two before. Raises
    UserError beyond the limit and where the clock is set back.
    """
    before, last, set_back = -1.0, -1.0, 0
    for frame in frames:
        usual = last - before if before >= 0 else step
        time = frame_time(frame, last + usual + start) - start
        if time > MAX_DURATION_S:
            raise UserError(f"{path}: over {MAX_DURATION_S / 3600:.0f} h long; cut it")
        if time > last:
            before, last, set_back = last, time, 0
            yield time, frame
            continue
        # Behind the one before last as well: else it is the last whose stamp is broken.
        set_back += time <= before
        if set_back > MOST_SET_BACK:
            raise UserError(
                f"{path}: its clock is set back after {last:.1f} s, as where several recordings were joined to one "
                "file; give one of them, or export them anew as one"
            )


def _ahead(items: Iterator[Item]) -> Generator[Item]:
    """The same items, of which the next are made by a thread while one is used."""
    end: Any = object()
    thread = ThreadPoolExecutor(1)
    try:
        coming = deque(thread.submit(next, items, end) for _ in range(AHEAD))
        while (item := coming.popleft().result()) is not end:
            coming.append(thread.submit(next, items, end))
            yield item
    finally:
        # Not waited for: a reader that is left is ended by the garbage collector, in whatever thread and under whatever
        # lock, that of threads which begin and end among them.
        thread.shutdown(wait=False, cancel_futures=True)


def _turned(picture: U8, matrix: NDArray[np.int64]) -> U8:
    """The picture after `display_matrix`. By OpenCV, which turns it in a third of the time that NumPy takes."""
    (xx, xy), (yx, yy) = matrix
    if xx == 0:  # what was y as stored becomes x
        picture, xx, yy = cv2.transpose(picture), yx, xy
    if xx > 0 and yy > 0:
        return picture
    return cv2.flip(picture, -1 if xx < 0 and yy < 0 else int(xx < 0))
