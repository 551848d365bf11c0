"""Times a user writes, as frames."""

import numpy as np
import pytest

from model.motion import Motion
from personalize.errors import UserError
from personalize.times import frames_at


def motion(frames: int = 300, start_s: float = 0.0) -> Motion:
    empty = np.zeros((1, 3), np.float32)
    return Motion(
        30.0,
        start_s,
        empty,
        np.zeros((0, 3), np.int32),
        np.zeros((1, 1, 3), np.float32),
        np.zeros((frames, 1), np.float32),
        np.ones(frames, bool),
    )


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("", []),
        ("0:0.1", [0, 1, 2]),
        (" :0.1 , 9.9: ", [0, 1, 2, 297, 298, 299]),
        ("3.2", [96]),
        ("3.21,5", [96, 150]),
        ("0,9.967", [0, 299]),
        (":1%,99%:", [0, 1, 2, 297, 298, 299]),
        ("50%:5.1", [150, 151, 152]),
        ("9.9:10", [297, 298, 299]),
        (":", list(range(300))),
    ],
)
def test_times_and_spans(text: str, frames: list[int]) -> None:
    assert np.flatnonzero(frames_at(text, motion(), "--keep")).tolist() == frames


def test_times_count_from_the_presentation_time_of_the_motion() -> None:
    late = motion(30, start_s=2.0)
    assert np.flatnonzero(frames_at("2:2.1,2.5", late, "--keep")).tolist() == [0, 1, 2, 15]
    assert np.flatnonzero(frames_at("0:2.1", late, "--keep")).tolist() == [0, 1, 2]
    with pytest.raises(UserError, match=r"from 2.00 to 3.00 s"):
        frames_at("1.5", late, "--keyframes")


@pytest.mark.parametrize("text", ["0:11", "-1:2", "10", "101%", "12:", "200", "-3"])
def test_what_lies_outside_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=r"--keep: .* is outside the motion, which is from 0.00 to 10.00 s"):
        frames_at(text, motion(), "--keep")


def test_a_time_in_the_last_half_frame_is_told_where_the_last_one_lies() -> None:
    with pytest.raises(UserError, match=r"9.99 is outside .* its last frame at 9.97 s"):
        frames_at("9.99", motion(), "--keep")


@pytest.mark.parametrize("text", ["a", "1:b", "nan", "inf:", "1,,2", "1:2:3", "%"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="is not a time"):
        frames_at(text, motion(), "--keep")


@pytest.mark.parametrize("text", ["2:1", "1:1", "1:1.01", "10:"])
def test_empty_spans_are_refused(text: str) -> None:
    with pytest.raises(UserError, match="holds no frame"):
        frames_at(text, motion(), "--keep")
