"""Cuts, repeated pictures, usable time and the split."""

from __future__ import annotations

import numpy as np
import pytest

from personalize.shots import (
    CUT_RATIO,
    FACE_JUMPS,
    Changes,
    difference,
    find_shots,
    repeated,
    sudden,
    thumbnail,
    usable_seconds,
)
from personalize.split import make_split
from tests.personalize.people_factory import frames_of


def cuts(time: np.ndarray, change: np.ndarray, face: np.ndarray | None = None) -> list[int]:
    """First frames of shots behind the first one. face: none is seen where it is not given."""
    shots = find_shots(time, change, np.full(len(time), np.nan) if face is None else face)
    return (np.flatnonzero(np.diff(shots)) + 1).tolist()


def test_a_cut_is_found_where_the_change_stands_out() -> None:
    change = 0.5 + 0.2 * np.sin(np.arange(100.0))
    change[[30, 33, 70]] = 8.0
    assert cuts(np.arange(100) / 25, change) == [30, 33, 70]


def test_steady_strong_motion_is_no_cut() -> None:
    change = np.random.default_rng(0).uniform(4, 8, 200)
    assert not cuts(np.arange(200) / 25, change, change)


def test_what_comes_beside_a_face_is_no_cut_and_a_face_that_jumps_is_one() -> None:
    time, change, face = np.arange(200) / 25, np.full(200, 0.4), np.full(200, 1.2)
    captions = np.arange(10, 200, 10)
    change[captions] = 9.0
    assert cuts(time, change) == captions.tolist()
    assert not cuts(time, change, face)
    face[[50, 60]] = np.nan  # it is not seen for a moment: nobody knows
    assert cuts(time, change, face) == [50, 60]
    face[[70, 133, 160]], change[133] = (9.0, 9.0, 4.0), 2.0  # with a caption, between two, and a nod
    assert cuts(time, change, face) == [50, 60, 70, 133, 160]
    still = np.full(200, 0.4)  # as where film is compressed hard
    assert not cuts(time, still, face)
    still[[70, 133, 160]] = 1.6
    assert cuts(time, still, face) == [70, 133]


def test_a_face_changes_by_what_is_seen_above_its_mouth() -> None:
    random = np.random.default_rng(0)
    picture = random.integers(0, 255, (480, 640, 3), dtype=np.uint8)
    box = np.array([200, 100, 400, 300], np.float32)
    captioned, other, moved = picture.copy(), picture.copy(), np.roll(picture, 90, axis=1)
    captioned[225:330] = 255
    other[60:215, 185:415] = random.integers(0, 60, (155, 230, 3))
    for shown, least, most in ((picture, 0, 0), (captioned, 0, 0), (other, 60, 120), (moved, 5, 60)):
        changes = Changes()
        assert np.isnan(changes.next(picture, [], box)[2])
        (whole, _), _, face = changes.next(shown, [], box)
        assert least <= face <= most and (shown is not captioned or whole > 10)
        assert np.isnan(changes.next(picture, [], None)[2])
        for beyond in (900, -900):
            assert np.isnan(changes.next(picture, [], box + beyond)[2])


def test_a_missing_second_ends_a_shot_and_a_dropped_frame_does_not() -> None:
    time = np.concatenate([np.arange(25) / 25, 2 + np.arange(25) / 25])
    time = np.delete(time, 40)
    change = np.full(len(time), 1.0)
    change[40] = 4.0  # two steps at once
    assert cuts(time, change) == cuts(time, np.ones(len(time)), change) == [25]


def test_a_repeated_picture_is_seen_and_a_small_motion_is_not_one() -> None:
    grey = np.random.default_rng(0).integers(0, 255, (36, 64), dtype=np.uint8)
    moved = grey.copy()
    moved[10:12, 10:12] ^= 8
    assert difference(grey, grey)[1] and not difference(moved, grey)[1]


def test_a_small_face_that_moves_in_a_still_picture_repeats_nothing() -> None:
    screen = np.random.default_rng(0).integers(0, 255, (720, 1280, 3), dtype=np.uint8)
    moved, face = screen.copy(), np.array([1100, 600, 1130, 640], np.float32)
    moved[628:631, 1112:1116] ^= 31  # a mouth
    changes = Changes()
    assert changes.next(screen, [face], None)[:2] == ((0.0, False), (0.0, False))
    (whole, same), (near, alike), _ = changes.next(moved, [face], None)
    assert same and not alike and near > 10 * whole
    near_face = near
    assert changes.next(moved, [face], None)[:2] == ((0.0, True), (0.0, True))
    # What changes elsewhere counts as well: another slide, of which the still face sees nothing.
    slide = moved.copy()
    slide[:300, :600] = 255
    other, (near, alike), _ = changes.next(slide, [face], None)
    assert (near, alike) == other and near > 10 and not alike
    changes.next(moved, [face], None)
    # A large face is a large part of the picture.
    large = np.array([200, 100, 900, 700], np.float32)
    whole_only = changes.next(screen, [large], None)
    assert whole_only[0] == whole_only[1] == (whole, True)
    assert changes.next(moved, [large, face], None)[1] == (
        near_face,
        False,
    )  # as that of a photograph on a slide


@pytest.mark.parametrize(
    ("rate", "new", "of"), [(30, 1, 2), (30, 4, 5), (60, 1, 2), (60, 1, 3), (60, 1, 4), (60, 1, 5)]
)
def test_pictures_that_are_repeated_and_coded_anew_are_seen(rate: int, new: int, of: int) -> None:
    random, time = np.random.default_rng(0), np.arange(200) / rate
    change = random.uniform(0.6, 1.4, 200)
    again = np.arange(200) % of >= new
    change[again] = random.uniform(0.02, 0.08, again.sum())
    nothing = np.zeros(200, bool)
    np.testing.assert_array_equal(repeated(time, change, nothing)[5:-5], again[5:-5])
    still = random.uniform(0.02, 0.08, 200)
    assert not repeated(time, still, nothing).any()
    assert repeated(time, still, again).sum() == again.sum()


def test_in_a_clip_that_repeats_pictures_more_of_the_small_changes_are_repeats() -> None:
    random, time = np.random.default_rng(0), np.arange(600) / 60
    again, change, nothing = np.arange(600) % 2 == 1, random.uniform(0.3, 0.7, 600), np.zeros(600, bool)
    slow = change.copy()
    change[again] = random.uniform(0.03, 0.13, again.sum())
    assert repeated(time, change, nothing)[again].mean() > 0.98
    assert not repeated(time, change, nothing)[~again].any()
    slow[::40] = 0.11  # where nothing else is repeated, a moment of rest is none
    assert not repeated(time, slow, nothing).any()


def test_the_first_picture_and_a_still_one_repeat_nothing() -> None:
    change, nothing = np.ones(50), np.zeros(50, bool)
    change[0] = 0
    change[20:30] = 0
    assert not repeated(np.arange(50) / 25, change, nothing).any()


def test_a_rest_of_a_fifth_of_a_second_is_no_repeated_picture() -> None:
    change = np.where(np.arange(100) % 25 < 5, 0.05, 1.0)
    assert not repeated(np.arange(100) / 25, change, np.zeros(100, bool)).any()


def test_usable_time_bridges_repeated_frames_but_not_cuts() -> None:
    time = np.arange(100) / 50
    every_other = np.arange(100) % 2 == 0
    assert usable_seconds(frames_of(time, every_other)) == pytest.approx(2.0, abs=0.05)
    lost = (time < 0.5) | (time >= 1.5)
    assert usable_seconds(frames_of(time, lost)) == pytest.approx(1.0, abs=0.03)
    assert usable_seconds(frames_of(time, np.zeros(100, bool))) == 0


def test_split_is_two_to_one_to_one_in_time_and_disjoint() -> None:
    time = np.arange(3000) / 25
    usable = (time < 20) | (time > 40)  # 100 s
    split = make_split(frames_of(time, usable))
    seconds = {k: sum(b - a for a, b in split[k]) for k in ("train", "val", "test")}
    assert split["usable_seconds"] == pytest.approx(100, abs=0.2)
    assert seconds == pytest.approx({"train": 50, "val": 25, "test": 25}, abs=0.5)
    assert split["train"][0] == [0.0, pytest.approx(20, abs=0.05)]
    assert split["val"][0][0] - split["train"][-1][1] >= 0.15
    assert split["test"][0][0] - split["val"][-1][1] >= 0.15


def test_split_moves_to_a_cut_nearby() -> None:
    time = np.arange(1000) / 25
    segment = (time >= 20.8).astype(int)
    split = make_split(frames_of(time, np.ones(1000, bool), segment))
    assert split["train"][-1][1] == pytest.approx(20.8, abs=0.05)
    assert split["val"][0][0] == pytest.approx(20.8, abs=0.05)


def test_what_may_be_a_cut_holds_every_cut() -> None:
    random = np.random.default_rng(1)
    for scale in (0.2, 1.0, 4.0):
        change = random.gamma(1.0, scale, 400)
        change[random.choice(400, 12, replace=False)] += 40.0
        for ratio, first in (
            (CUT_RATIO, cuts(np.arange(400) / 25, change)),
            (FACE_JUMPS, cuts(np.arange(400) / 25, np.full(400, 2.0), change)),
        ):
            assert len(first) > 3
            assert all(sudden(change[i], change[max(i - 7, 0) : i], ratio) for i in first)


def test_what_moves_in_the_dark_is_no_repeated_picture() -> None:
    dark = np.full((480, 640, 3), 11, np.uint8)
    moved = dark.copy()
    moved[200:206, 300:310] = 13  # one of ten by ten pixels by 1.2 levels, which rounding would make 1
    assert not difference(thumbnail(moved), thumbnail(dark))[1]
    assert difference(thumbnail(dark), thumbnail(dark))[1]
