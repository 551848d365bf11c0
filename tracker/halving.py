"""Pictures shrunk to a half, a quarter, an eighth: what OpenCV does several times faster than any other size."""

from __future__ import annotations

from typing import Any

import cv2
from numpy.typing import NDArray


def halved(picture: NDArray[Any], times: int) -> NDArray[Any]:
    """[H, W, ..] -> [H // 2^times, W // 2^times, ..], means of blocks; rows and columns left over are cut off.

    One row and one column are left of any picture.
    """
    for _ in range(times):
        height, width = (max(side // 2, 1) for side in picture.shape[:2])
        picture = cv2.resize(
            picture[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA
        )
    return picture
