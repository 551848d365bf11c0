"""A face that is cut out lies where its window says, to a tenth of a pixel, at its edges too."""

from __future__ import annotations

import numpy as np
import pytest

from tracker.lens import Lens
from tracker.view import Window

ORIGIN, SIZE = (7, 5), (97, 61)


def whole(width: int, height: int, count: int = 1) -> np.ndarray:
    """[count, 2, 2], ends of pictures that are not enlarged."""
    return Lens(1.0, (0.0, 0.0), ()).ends((width, height), np.arange(count))


@pytest.mark.parametrize("scale", [1.0, 0.83, 0.64, 0.5, 0.37, 0.31])
def test_a_ramp_is_read_where_it_was(scale: float) -> None:
    window = Window(np.array([ORIGIN], np.float64), scale, SIZE, whole(640, 640))
    slope = 0.6
    random = np.random.default_rng(0)

    def read(sign: int) -> np.ndarray:
        """[width] grey levels of a ramp to the right or the left, whose rounding the rows' mean takes out."""
        ramp = 128 + sign * slope * (np.arange(400) - 200) + random.random((400, 400))
        picture = np.repeat(np.floor(ramp).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
        cut = window.cut(picture, 0)
        assert cut.shape == SIZE[::-1]
        return cut.mean(0, dtype=np.float64)

    # Up less down: what rounding adds to both goes.
    found = 200 + (read(1) - read(-1)) / (2 * slope)
    expected = (np.arange(SIZE[0]) + 0.5) / scale - 0.5 + ORIGIN[0]
    inside = expected < 395
    line = np.polyval(np.polyfit(expected[inside], found[inside], 1), expected[inside])
    assert np.abs(line - expected[inside]).max() < 0.15


def test_what_lies_outside_of_the_picture_is_not_its_own() -> None:
    window = Window(np.array([[-20.0, 30.0]]), 0.5, (60, 50), whole(90, 200))
    # 20 px of the left border at half the size are 10; the picture ends 90 px on, and goes on below the window.
    np.testing.assert_allclose(window.own(0, 0.0), [[9.75, 0], [54.25, 49]])
    np.testing.assert_allclose(window.own(0, 2.0), [[11.75, 0], [52.25, 49]])


def test_windows_hold_every_face_but_one_that_is_far_too_large() -> None:
    """Faces as wide as high, at the middle of a picture; one comes nearer, another is none."""
    sizes = np.array([100.0] * 8 + [160.0, 900.0])
    corners = np.array([[-0.5, -0.5], [0.5, 0.5], [0.0, 0.2]])
    observed = 640 + sizes[:, None, None] * corners
    window = Window.around(observed, 10 * sizes, 500.0, whole(1280, 1280))
    assert window.scale == 0.5  # of the usual face's 1000 px per m
    assert window.size == (115, 115)  # twice the usual face and a margin, at that scale
    low, high = ((end - window.origin + 0.5) * 0.5 - 0.5 for end in (observed.min(1), observed.max(1)))
    assert (low[:9] > 0).all() and (high[:9] < 114).all()
    assert Window.around(observed[:9], 10 * sizes[:9], 500.0, whole(1280, 1280)).size == (92, 92)
    assert Window.around(observed, sizes, 500.0, whole(1280, 1280)).scale == 1.0
