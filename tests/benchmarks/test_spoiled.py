"""Films are spoiled as they are said to be, and openings compared where nothing covers the mouth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.spoiled import (
    Captioned,
    Cover,
    Enlarged,
    Shaken,
    Small,
    blurred,
    errors,
    lit,
    noisy,
    ways,
    write_spoiled,
)
from personalize.pictures import FrameReader
from personalize.run import write_track
from tests.personalize.test_registration import track_of
from tests.personalize.video_factory import write_video
from tracker.head import load_head
from tracker.landmark_indices import LEFT_EYE_OUTER, LIPS, POINTS, RIGHT_EYE_OUTER

EYES_PX = 80.0


@pytest.fixture
def points() -> np.ndarray:
    """[478, 2] px: a mouth in the middle of 240 x 200 px, eyes above."""
    points = np.tile(np.float32([120, 60]), (POINTS, 1))
    points[list(LIPS)] = 120, 120
    points[LEFT_EYE_OUTER], points[RIGHT_EYE_OUTER] = (160, 50), (80, 50)
    return points


def test_a_cover_comes_stays_and_goes() -> None:
    cover = Cover((1.0, 5.0), ramp=0.5, hold=1.0)
    assert [cover.near(t) for t in (0.9, 1.25, 1.5, 2.5, 2.75, 3.0, 5.75)] == [0, 0.5, 1, 1, 0.5, 0, 1]


@pytest.mark.parametrize("skin", [True, False])
def test_a_cover_lies_on_the_mouth_when_it_is_there_and_below_before(points: np.ndarray, skin: bool) -> None:
    rgb = np.random.default_rng(0).integers(90, 250, (200, 240, 3), np.uint8)
    cover = Cover((0.0,), 1.0, 1.0, skin=skin, wide=0.5)
    changed = (cover.over(rgb, points, 1.0) != rgb).any(2)
    assert changed[112:128, 108:132].mean() > 0.95 and not changed[:85].any()
    assert not (cover.over(rgb, points, 0.1) != rgb).any(2)[:150].any(), "an eye's distance farther down"
    assert cover.over(rgb, points, 0.0) is rgb
    assert cover.over(rgb, np.full_like(points, np.nan), 1.0) is rgb


def test_a_shaken_picture_is_smeared_along_its_rows(points: np.ndarray) -> None:
    edge = np.zeros((80, 80, 3), np.uint8)
    edge[:, 40:] = 200
    shaken = Shaken((0.0,), 0.1, 0.3, far=0.25)
    row = shaken.over(edge, points, 1.0)[40, :, 0]
    assert np.count_nonzero((row > 0) & (row < 200)) == pytest.approx(0.25 * EYES_PX, abs=1)
    np.testing.assert_array_equal(shaken.over(edge.transpose(1, 0, 2), points, 1.0), edge.transpose(1, 0, 2))
    assert shaken.over(edge, points, 0.0) is edge


@pytest.mark.parametrize("photograph", [False, True])
def test_a_small_head_lies_in_the_corner(points: np.ndarray, photograph: bool) -> None:
    """Of 40 px between the eyes, half of the film's: 208 px wide and high, the eyes' middle in its middle."""
    rgb = np.full((200, 240, 3), 100, np.uint8)
    rgb[45:56, 115:126] = 255
    small = Small(EYES_PX / 2, photograph)
    assert not small(rgb, np.full_like(points, np.nan)).any()
    out, other = small(rgb, points), small(np.zeros_like(rgb), points + 30)
    assert out.shape == other.shape == (1080, 1920, 3)
    row, column = np.argwhere(out[-208:, -208:, 0] > 200).mean(0)
    assert (row, column) == pytest.approx((104, 104), abs=1)
    # The photograph stays, and the window does not follow the head.
    assert (out[:, :800] == 200).all() == (not photograph) and (out[:, :800] == other[:, :800]).all()
    assert not other[-208:, -208:].any()


def test_words_come_one_after_another_under_the_mouth(points: np.ndarray) -> None:
    rgb, captioned = np.full((200, 240, 3), 100, np.uint8), Captioned(10.0)
    assert captioned(rgb, np.full_like(points, np.nan)) is rgb
    shown = [captioned(rgb, points + 20 * k) for k in range(12)]  # a face that moves takes no word along
    rows, columns = np.argwhere((shown[0] != rgb).any(2)).T
    assert (rows.min() + rows.max()) / 2 == pytest.approx(120 + 0.55 * EYES_PX, abs=3)
    assert np.ptp(rows) == pytest.approx(0.3 * EYES_PX, abs=8) and columns.mean() == pytest.approx(120, abs=4)
    same = [(a == b).all() for a, b in zip(shown, shown[1:])]
    assert np.flatnonzero(~np.array(same)).tolist() == [
        2,
        6,
        10,
    ]  # .4 s each, the first began a picture before


def test_every_other_shot_is_larger(points: np.ndarray) -> None:
    way, rgb = Enlarged(2.0), np.random.default_rng(0).integers(0, 255, (201, 241, 3), np.uint8)
    plain = [way(rgb, points) is rgb for _ in range(20)]
    assert plain == 2 * ([True] * 6 + [False] * 4)


def test_light_noise_and_focus(points: np.ndarray) -> None:
    flat = np.full((60, 60, 3), 100, np.uint8)
    # Three times the light in gamma 2.2 is 3 ** (1 / 2.2) times the level.
    assert lit(3)(flat, points)[0, 0, 0] == round(100 * 3 ** (1 / 2.2))
    assert lit(3)(flat + 120, points).min() == 255
    assert noisy(10)(flat, points).std() == pytest.approx(10, rel=0.05)
    edge = np.zeros((80, 80, 3), np.uint8)
    edge[:, 40:] = 200
    slope = np.gradient(blurred(0.05)(edge, points)[40, :, 0].astype(float))
    places = np.arange(80)
    spread = np.sqrt((slope * (places - 39.5) ** 2).sum() / slope.sum())
    assert spread == pytest.approx(0.05 * EYES_PX, abs=0.3)


def test_a_film_is_written_again_at_its_times(tmp_path: Path, points: np.ndarray) -> None:
    times = [0.0, 0.04, 0.12, 0.2]
    pictures = [np.full((64, 96, 3), 60 + 40 * k, np.uint8) for k in range(4)]
    path = write_video(tmp_path / "v.mp4", pictures, times)
    way, crf = ways(25.0)["as it is"]
    write_spoiled(path, tmp_path / "out.mp4", way, crf, points[None])
    again = list(FrameReader(tmp_path / "out.mp4"))
    assert [time for time, _ in again] == pytest.approx(times, abs=1e-3)
    assert [rgb.mean() for _, rgb in again] == pytest.approx([60, 100, 140, 180], abs=3)


def test_openings_are_compared_where_nothing_covers_the_mouth(tmp_path: Path) -> None:
    head, time = load_head(), np.arange(50) / 25
    track = track_of(head, np.zeros((50, len(head.expression_basis))), time)
    gap = 3 + 3 * np.sin(time * 9).astype(np.float32)
    cover = Cover((1.0,), 0.2, 0.2)
    near = np.array([cover.near(t) for t in time])
    wrong = np.where(near > 0, gap + 5, gap + 0.5).astype(np.float32)
    reasons = ["occluded" if n == 1 and t < 1.3 else "ok" for n, t in zip(near, time)]
    reasons[3] = "blurred"
    # A head that turns by 15 degrees before the lens, and in the corner of the picture, where it nods by one too much.
    turns = np.outer(np.radians(15) * np.sin(time * 4), [0, 1, 0])
    whole = replace(track, lip_gap_mm=gap, rotation=turns.astype(np.float32))
    nods = Rotation.from_rotvec(np.radians(np.outer((-1.0) ** np.arange(50), [1.0, 0, 0])))
    corner = Rotation.from_euler("yx", [20, -12], degrees=True)
    spoiled = replace(
        whole,
        lip_gap_mm=wrong,
        rotation=(corner * Rotation.from_rotvec(turns) * nods).as_rotvec().astype(np.float32),
        translation=corner.apply(track.translation).astype(np.float32),
    )
    for name, found in (("whole", whole), ("spoiled", spoiled)):
        (tmp_path / name / "refine").mkdir(parents=True)
        write_track(tmp_path / name / "refine/track.npz", found)
        (tmp_path / name / "refine/quality.csv").write_text("reason\n" + "\n".join(reasons) + "\n")
    used, bare_out, covered_used, rmse, bias, r, turn = errors(
        tmp_path / "spoiled", tmp_path / "whole", cover
    )
    assert used == pytest.approx(100 * reasons.count("ok") / 50)
    assert bare_out == pytest.approx(100 / (near == 0).sum())
    assert covered_used == pytest.approx(100 * ((near == 1) & (time >= 1.3)).sum() / (near == 1).sum())
    assert (rmse, bias, r) == pytest.approx((0.5, 0.5, 1.0), abs=1e-3)
    assert turn == pytest.approx(1.0, abs=0.02)
