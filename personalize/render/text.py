"""Words on pictures."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]


def caption(picture: U8, text: str) -> U8:
    """A copy of the picture [H, W, 3] with a line of text in its upper left corner."""
    drawn = picture.copy()
    size = picture.shape[0] / 700
    for colour, weight in (((0, 0, 0), 4), ((240, 240, 240), 2)):
        origin = (10, round(30 * size) + 6)
        cv2.putText(drawn, text, origin, cv2.FONT_HERSHEY_SIMPLEX, size, colour, weight, cv2.LINE_AA)
    return drawn
