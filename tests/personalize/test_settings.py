"""A focal length that no picture of the video's size is taken with is refused."""

from __future__ import annotations

import pytest

from personalize.errors import UserError
from personalize.settings import check_distortion, check_focal


@pytest.mark.parametrize("focal", [35.0, 1.0, 0.0, -900.0, 1e300, float("inf"), float("nan")])
def test_a_focal_length_in_mm_or_absurd_is_refused_with_the_range_in_pixels(focal: float) -> None:
    for size in ((1280, 720), (720, 1280)):
        with pytest.raises(UserError) as caught:
            check_focal(focal, size)
        said = str(caught.value)
        assert said.startswith(f"--focal {focal:g}: ") and "in pixels, not mm" in said and "\n" not in said
        assert f"{size[0]}x{size[1]} px" in said and "between 384 and 12800" in said


@pytest.mark.parametrize("focal", [None, 384.0, 1500.0, 12800.0])
def test_focal_lengths_of_wide_angles_and_telephoto_lenses_pass(focal: float | None) -> None:
    check_focal(focal, (1280, 720))


@pytest.mark.parametrize(
    ("focal", "distortion"),
    [(400.0, (-5.0,)), (500.0, (-0.6,)), (500.0, (0.1, 0.0, -9.0)), (300.0, (-0.4, 0.05))],
)
def test_a_lens_that_folds_the_picture_is_refused(focal: float, distortion: tuple[float, ...]) -> None:
    with pytest.raises(UserError, match="folds a picture of 640x480 px over itself"):
        check_distortion(focal, distortion, (640, 480))


@pytest.mark.parametrize(
    ("focal", "distortion"),
    [
        (None, ()),
        (900.0, ()),
        (900.0, (-0.21, 0.05)),
        (450.0, (-0.28,)),
        (300.0, (-0.3, 0.1)),
        (290.0, (-0.265, 0.085, -0.0147)),
        (400.0, (0.3, 0.1, 0.02)),
    ],
)
def test_lenses_that_there_are_pass(focal: float | None, distortion: tuple[float, ...]) -> None:
    check_distortion(focal, distortion, (640, 480))
