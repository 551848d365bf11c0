"""What is told of tracks without a truth, on curves whose answers are known."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.real_tracks import (
    about_lines,
    after_cuts,
    closures,
    plosive_starts,
    raw_openings,
    stillest,
)
from tracker.landmark_indices import LEFT_EYE_OUTER, POINTS, RIGHT_EYE_OUTER
from tracker.track import Landmarks

TIME = np.arange(100) / 25.0
EVERYWHERE = np.ones(100, bool)


def closing_at(frame: int, least: float) -> np.ndarray:
    return least + np.minimum(np.abs(np.arange(100.0) - frame), 5)


def test_openings_are_in_parts_of_the_eyes_distance() -> None:
    points = np.full((2, POINTS, 3), np.nan, np.float32)
    points[0, [LEFT_EYE_OUTER, RIGHT_EYE_OUTER, 13, 14], :2] = [
        [300, 100],
        [120, 100],
        [200, 200],
        [200, 216],
    ]
    some = np.zeros(2, np.float32)
    opening = raw_openings(Landmarks(some, points, some, np.zeros((2, 1), np.float32), (), (640, 480)))
    assert opening[0] == pytest.approx(8.0) and np.isnan(opening[1])


def test_a_cut_that_smears_shows_in_the_residual_behind_it() -> None:
    segment, residual = np.repeat([0, 1, 2], [40, 40, 20]).astype(np.int32), np.full(100, 2.0)
    residual[[41, 81]] = [3.0, 5.0]
    valid = EVERYWHERE.copy()
    assert after_cuts(residual, valid, segment) == (2.0, 1.0)
    valid[81] = False
    assert after_cuts(residual, valid, segment) == (1.5, 1.0)


@pytest.mark.parametrize(("late", "near"), [(0, 0.1), (1, 0.1), (3, 2.1)])
def test_a_late_closure_is_told_from_one_in_time(late: int, near: float) -> None:
    raw, gap = closing_at(50, 0.3), closing_at(50 + late, 0.1)
    assert closures(raw, gap, TIME, EVERYWHERE, [2.0]) == [pytest.approx((near, late))]


def test_words_in_frames_out_of_use_are_left_out() -> None:
    raw, valid = closing_at(50, 0.3), EVERYWHERE.copy()
    valid[52] = False
    assert closures(raw, raw, TIME, valid, [2.0, 1.0, 9.0]) == [(pytest.approx(5.3), 0.0)]


def test_plosives_are_words_that_begin_with_closed_lips(tmp_path: Path) -> None:
    words = [{"word": word, "start": k} for k, word in enumerate(("bin", "red", "Place", "at", "m", "now"))]
    (tmp_path / "a.words.json").write_text(json.dumps({"words": words}))
    assert plosive_starts(tmp_path / "a.words.json") == [0.0, 2.0, 4.0]


def test_what_moves_evenly_does_not_shake() -> None:
    even = np.arange(26.0)[:, None, None] * np.array([[1.0, -2.0, 0.5], [0.0, 3.0, 1.0]])
    assert about_lines(even) == pytest.approx(0, abs=1e-9)
    shaken = even.copy()
    shaken[:, 0, 1] += np.cos(2 * np.pi * np.arange(26) / 2)  # every frame the other way, by 1
    assert about_lines(shaken) == pytest.approx(np.sqrt(0.5), rel=0.01)


def test_the_stillest_second_is_found_within_one_shot_and_in_use() -> None:
    shake = np.ones(100)
    shake[10:36], shake[40:70] = 0.1, 0.3
    points = np.random.default_rng(0).normal(size=(100, 50, 2)) * shake[:, None, None]
    one_shot = np.zeros(100, np.int32)
    assert stillest(points, TIME, EVERYWHERE, one_shot) == slice(10, 36)
    cut = np.where(np.arange(100) < 20, 0, 1).astype(np.int32)
    found = stillest(points, TIME, EVERYWHERE, cut)
    assert found.start >= 40 and found.stop <= 70
    unused = np.arange(100) % 20 > 0
    assert stillest(points, TIME, unused, one_shot) == slice(0, 0)
