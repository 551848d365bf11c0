"""A focal length that no picture of the video's size is taken with is refused."""

from __future__ import annotations

import pytest

from personalize.errors import UserError
from personalize.settings import check_focal


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
