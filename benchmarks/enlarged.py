"""A film as editors leave it: two of every five seconds larger, about the picture's middle."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from personalize.container import probe
from personalize.pictures import FrameReader
from personalize.video_writer import VideoWriter

U8 = NDArray[np.uint8]

PLAIN_S, LARGER_S, LARGER = 3.0, 2.0, 1.3  # by turns, and how many times larger
CRF = 12  # x264's: next to nothing is lost


def by_turns(rgb: U8, time: float) -> U8:
    """The picture [H, W, 3] of so many s, or the middle of it."""
    if time % (PLAIN_S + LARGER_S) < PLAIN_S:
        return rgb
    middle = (np.array(rgb.shape[1::-1]) - 1) / 2
    warp = np.column_stack([LARGER * np.eye(2), (1 - LARGER) * middle])
    return np.asarray(cv2.warpAffine(rgb, warp, rgb.shape[1::-1], flags=cv2.INTER_CUBIC), np.uint8)


@contextmanager
def enlarged(video: Path) -> Iterator[Path]:
    """The video, enlarged by turns and without sound; the file is gone afterwards."""
    info = probe(video)
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / video.name
        with VideoWriter(film, info.fps, (info.width, info.height), crf=CRF) as writer:
            for time, rgb in FrameReader(video):
                writer.write(by_turns(rgb, time), time)
        yield film
