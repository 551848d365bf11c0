"""The overlay's options, the frames of its contact sheet, and what is said about a frame."""

import numpy as np
import pytest

from personalize.errors import UserError
from personalize.overlay import COLUMNS, SPREAD, WORST, check_modes, notable_frames
from personalize.render.track import PANEL, around_face, grid
from personalize.settings import Settings
from personalize.stages import Overlay
from tracker.overlay import MODES


def test_a_mode_that_does_not_exist_is_named_with_those_that_do() -> None:
    check_modes(tuple(MODES))
    with pytest.raises(UserError, match=r"--overlay shded: no such mode.*wireframe"):
        check_modes(("wireframe", "shded"))
    with pytest.raises(UserError, match="no such mode"):
        check_modes(("",))


def test_the_modes_are_part_of_the_stage_key() -> None:
    assert "overlay" in Overlay.reads
    assert set(Settings().overlay) <= set(MODES)


def test_notable_frames_are_the_worst_apart_and_a_spread() -> None:
    confidence = np.ones(400, np.float32)
    confidence[100:110] = np.linspace(0.2, 0.3, 10)
    confidence[300] = 0.1
    valid = np.ones(400, bool)
    valid[:40] = False
    frames = notable_frames(valid, confidence)
    assert len(frames) == WORST + SPREAD
    assert frames[:2].tolist() == [300, 100]
    assert np.diff(np.sort(frames[:WORST])).min() >= 360 // (4 * WORST)
    assert frames[WORST] == 40 and frames[-1] == 399
    assert valid[frames].all()


def test_a_single_tracked_frame_is_enough_for_a_contact_sheet() -> None:
    frames = notable_frames(np.array([False, True]), np.array([0, 1], np.float32))
    assert set(frames.tolist()) == {1}


def test_the_grid_has_a_place_for_each_picture() -> None:
    pictures = [np.full((20, 30, 3), value, np.uint8) for value in range(100, 106)]
    sheet = grid(pictures, COLUMNS)
    assert sheet.shape == (40, 30 * COLUMNS, 3)
    assert [int(sheet[10, 15 + 30 * k, 0]) for k in range(COLUMNS)] == [100, 101, 102, 103]
    assert [int(sheet[30, 15 + 30 * k, 0]) for k in range(2)] == [104, 105]
    assert (sheet[20:, 60:] == sheet[20, 60]).all()


def test_the_part_shown_holds_the_face_at_all_times_and_stays_in_the_picture() -> None:
    points = np.zeros((2, 478, 2), np.float32)
    points[0, :, 0], points[0, :, 1] = np.linspace(20, 120, 478), np.linspace(5, 150, 478)
    points[1] = points[0] + (60, 10)
    crop = around_face(points, (360, 288))
    for one in points:
        placed = crop.place(one)
        assert (placed >= 0).all() and (placed < crop.size).all()
    low, high = np.array(crop.origin), np.array(crop.origin) + crop.extent
    assert (low >= 0).all() and (high <= (360, 288)).all()
    assert max(crop.size) == PANEL
    assert not any(side % 2 for side in crop.size)
    assert crop.scale[0] == pytest.approx(crop.scale[1], rel=0.01)
