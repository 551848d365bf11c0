"""Words on pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracker.overlay import letter

U8 = NDArray[np.uint8]


def caption(picture: U8, text: str) -> U8:
    """A copy of the picture [H, W, 3] with a line of text in its upper left corner."""
    drawn = picture.copy()
    height = picture.shape[0] // 33
    letter(drawn, text, (10, 6 + 2 * height), height)
    return drawn
