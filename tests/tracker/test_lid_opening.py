"""Lids that the landmarker keeps apart in blinks shut; open eyes, glances and faces without blinks stay as they are."""

import numpy as np
import pytest

from tracker.energy import LID_PAIRS
from tracker.landmark_indices import POINTS
from tracker.lid_opening import MOST, lids_shut

FRAMES, PX_PER_M, TOUCH = 200, 2000.0, 0.0005
EVERY = np.arange(FRAMES)
UPPER, LOWER = np.transpose(LID_PAIRS)


def eyes(opening_m: np.ndarray) -> np.ndarray:
    """[n, 478, 2] px of a face whose lids are as far apart, along a tilted line."""
    points = np.random.default_rng(0).uniform(100, 300, (1, POINTS, 2)).repeat(len(opening_m), 0)
    down = np.array([0.6, 0.8]) * PX_PER_M
    points[:, LOWER] = points[:, UPPER] + opening_m[:, None, None] * down
    return points


def apart_m(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, UPPER] - points[:, LOWER], axis=-1) / PX_PER_M


def blinking(shut_m: float, at: range = range(20, FRAMES, 40)) -> np.ndarray:
    opening = np.full(FRAMES, 0.010)
    for frame in at:
        opening[frame - 1 : frame + 2] = [0.005, shut_m, 0.005]
    return opening


def shut(points: np.ndarray, sound: np.ndarray = EVERY) -> np.ndarray:
    return lids_shut(points, np.full(FRAMES, PX_PER_M), np.full(len(LID_PAIRS), TOUCH), sound)


def test_blinks_shut_and_open_eyes_stay():
    points = eyes(blinking(0.003))
    found = shut(points)
    np.testing.assert_allclose(apart_m(found)[20:200:40], TOUCH, atol=1e-6)
    np.testing.assert_allclose(found[:15], points[:15])
    assert (apart_m(found)[19] < 0.005).all() and (apart_m(found)[19] > 0.003).all()
    np.testing.assert_allclose(found[:, UPPER] + found[:, LOWER], points[:, UPPER] + points[:, LOWER])


def test_no_more_is_taken_than_lids_can_be_misread_by():
    assert apart_m(shut(eyes(blinking(0.0039))))[20] == pytest.approx(0.0039 - MOST)


@pytest.mark.parametrize("opening", [blinking(0.005), blinking(0.003, range(20, 90, 40)), blinking(0.0)])
def test_glances_few_blinks_and_lids_that_meet_change_nothing(opening: np.ndarray):
    points = eyes(opening)
    np.testing.assert_array_equal(shut(points), points)


def test_frames_in_which_the_face_is_covered_tell_nothing():
    points = eyes(blinking(0.003))
    np.testing.assert_array_equal(shut(points, np.setdiff1d(EVERY, range(20, FRAMES, 40))), points)
