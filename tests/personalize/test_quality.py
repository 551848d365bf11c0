"""Why frames are left out: one answer, kept in quality.csv and told in spans."""

import csv
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from personalize.evaluation.report import _apart
from personalize.pipeline import STAGES
from personalize.quality import (
    cover_warnings,
    frame_reasons,
    head_angles,
    left_out,
    lip_warnings,
    read_reasons,
    write_quality,
)
from personalize.run import write_refined
from personalize.shots import REASONS, Frames
from personalize.stages import Judge, Refine
from tests.personalize.test_registration import track_of
from tracker.head import load_head
from tracker.refine import Refined

TIME = np.arange(6) / 25
DOUBTS = ["occluded", "occluded", "blurred", "poor_fit", "poor_fit", "poor_fit"]


@pytest.fixture
def track():
    head = load_head()
    track = track_of(head, np.zeros((6, len(head.expression_basis))), TIME)
    valid = np.array([False, False, True, True, True, True])
    return replace(track, valid=valid, confidence=np.float32([0, 0, 0.3, 0.49, 0.5, 1]))


@pytest.fixture
def frames() -> Frames:
    reason = np.array([REASONS.index("cut"), 0, 0, 0, 0, 0], np.uint8)
    return Frames(TIME, reason == 0, reason, REASONS, np.zeros(6, np.int32), np.zeros((6, 4), np.float32))


def test_the_first_reason_counts(frames, track):
    assert frame_reasons(frames, track, DOUBTS, 0.5) == ["cut", "no_face", "blurred", "poor_fit", "ok", "ok"]
    assert frame_reasons(frames, track, DOUBTS, 0.0) == ["cut", "no_face", "ok", "ok", "ok", "ok"]
    unknown = replace(track, confidence=np.full(6, np.nan, np.float32))
    assert "ok" not in frame_reasons(frames, unknown, DOUBTS, 0.0)


def test_quality_csv_carries_the_reasons(frames, track, tmp_path: Path):
    reasons = frame_reasons(frames, track, DOUBTS, 0.5)
    photometric = np.array([np.nan, np.nan, 3, 1.5, 1, 0.5], np.float32)
    write_quality(tmp_path / "quality.csv", track, reasons, photometric)
    assert read_reasons(tmp_path / "quality.csv").tolist() == reasons
    rows = list(csv.DictReader((tmp_path / "quality.csv").open(newline="")))
    assert [row["photometric"] for row in rows] == ["", "", "3.000", "1.500", "1.000", "0.500"]


def test_another_threshold_judges_again_and_makes_nothing_else():
    assert [stage.name for stage in STAGES if "min_confidence" in stage.reads] == ["judge"]


@pytest.mark.parametrize(
    ("like_lips", "fineness", "said"),
    [
        (np.nan, np.nan, []),
        (0.16, 0.09, []),
        (0.31, 0.2, ["31% of it looks like them"]),
        (0.7, 0.07, ["70% of it", "out of focus"]),
    ],
)
def test_how_badly_lips_are_seen_is_told_when_made_and_when_cached(
    track, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, like_lips: float, fineness: float, said: list[str]
):
    (tmp_path / "photometric").mkdir()
    refined = Refined(track, np.ones((6, 2), np.float32), like_lips, fineness)
    write_refined(tmp_path / "photometric", refined)
    texts = Refine().warnings(Mock(path=tmp_path))
    assert len(texts) == len(said) and all(words in text for words, text in zip(said, texts))
    for name in ("read_track", "read_landmarks", "read_frames", "read_appearance"):
        monkeypatch.setattr(f"personalize.run.{name}", Mock())
    monkeypatch.setattr("personalize.run.read_camera", lambda _: (Mock(), Mock()))
    for name in ("run_head", "bare"):
        monkeypatch.setattr(f"personalize.stages.{name}", Mock())
    monkeypatch.setattr("personalize.stages.refine_track", lambda *_, **__: refined)
    context = MagicMock()
    Refine().make(context, tmp_path / "photometric")
    assert [call.args[0] for call in context.report.warn.call_args_list] == texts


@pytest.mark.parametrize(
    ("nod", "fineness", "warned"), [(9, 0.2, 0), (20, 0.2, 1), (20, np.nan, 0), (-30, 0.2, 0)]
)
def test_a_face_filmed_from_above_is_told(track, nod: float, fineness: float, warned: int):
    """Of frames that were fitted; openings that another tracker read are its own."""
    bowed = (Rotation.from_euler("x", nod, degrees=True) * FACING).as_rotvec()
    upright = FACING.as_rotvec()
    rotation = np.float32([upright, upright, bowed, bowed, bowed, upright])
    seen = replace(track, rotation=rotation, translation=np.tile(np.float32([0, 0, 0.6]), (6, 1)))
    texts = lip_warnings(Refined(seen, np.ones((6, 2), np.float32), 0.1, fineness))
    assert len(texts) == warned and all(f"from above, by some {nod} degrees" in text for text in texts)


def test_a_face_that_is_covered_for_long_is_told(tmp_path: Path):
    hidden = np.array(["ok"] * 5 + ["occluded"] * 2 + ["duplicate", "no_face", "cut"])
    (text,) = cover_warnings(hidden)
    assert "in 29% of the frames that show" in text
    assert cover_warnings(np.array(["ok"] * 5 + ["occluded"])) == []
    assert cover_warnings(np.array(["no_face"])) == []
    (tmp_path / "refine").mkdir()
    (tmp_path / "refine/quality.csv").write_text("\n".join(["reason", *hidden]))
    assert list(Judge().warnings(Mock(path=tmp_path))) == [text]


def test_spans_end_where_the_next_frame_begins():
    reasons = np.array(["ok", "occluded", "occluded", "cut", "ok", "no_face"])
    spans = [(span.start_s, pytest.approx(span.end_s), span.reason) for span in left_out(TIME, reasons)]
    assert spans == [(0.04, 0.12, "occluded"), (0.12, 0.16, "cut"), (0.2, 0.24, "no_face")]
    assert left_out(TIME, np.array(["ok"] * 6)) == []
    assert left_out(TIME[:1], np.array(["cut"]))[0].end_s == 0


def test_cuts_have_no_row_of_their_own_in_the_report():
    spans = left_out(TIME, np.array(["ok", "occluded", "cut", "ok", "cut", "no_face"]))
    told, cuts = _apart(spans)
    assert [span.reason for span in told] == ["occluded", "no_face"]
    assert sum(cut.end_s - cut.start_s for cut in cuts) == pytest.approx(0.08)


FACING = Rotation.from_matrix(
    np.diag([1.0, -1.0, -1.0])
)  # x of the picture is the subject's left, its y is down


@pytest.mark.parametrize(
    ("yaw", "pitch", "roll"), [(0, 0, 0), (30, 0, 0), (0, 20, 0), (0, 0, 10), (-40, -25, 15)]
)
def test_angles_of_the_head_are_signed_as_they_say(track, tmp_path: Path, yaw: int, pitch: int, roll: int):
    """By where nose and crown point: the head leans, then goes back about its own ears' axis, then turns."""
    one = np.radians([yaw, pitch, roll])
    nose = [np.sin(one[0]) * np.cos(one[1]), -np.sin(one[1]), -np.cos(one[0]) * np.cos(one[1])]
    level = np.array([np.cos(one[0]), 0, np.sin(one[0])])  # to the left ear of a head that does not lean
    crown = np.cos(one[2]) * np.cross(nose, level) + np.sin(one[2]) * level
    head = np.column_stack([np.cross(crown, nose), crown, nose])
    rotation = Rotation.from_matrix(head).as_rotvec().astype(np.float32)
    np.testing.assert_allclose(head_angles(rotation[None])[0], [yaw, pitch, roll], atol=1e-3)
    # The table counts what a neck turns as well.
    neck = (FACING.inv() * Rotation.from_matrix(head)).as_rotvec().astype(np.float32)
    still = replace(track, rotation=np.tile(FACING.as_rotvec(), (6, 1)), neck=np.tile(neck, (6, 1)))
    write_quality(tmp_path / "quality.csv", still, ["ok"] * 6, np.ones(6, np.float32))
    row = next(csv.DictReader((tmp_path / "quality.csv").open(newline="")))
    told = [float(row[f"{name}_deg"]) for name in ("yaw", "pitch", "roll")]
    np.testing.assert_allclose(told, [yaw, pitch, roll], atol=0.01)
