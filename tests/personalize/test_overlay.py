"""The overlay's options, the frames of its contact sheet, and what is said about a frame."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from personalize.errors import UserError
from personalize.overlay import COLUMNS, SPREAD, WORST, check_modes, notable_frames, write_overlay
from personalize.pictures import FrameReader
from personalize.quality import write_quality
from personalize.render.track import BAD, FOOTER, GOOD, PANEL, TILE, TrackPictures, around_face, grid
from personalize.run import RunFolder, read_camera, read_track, write_camera, write_landmarks, write_track
from personalize.settings import Settings
from personalize.sound import read_audio
from personalize.stages import Overlay
from tests.personalize.video_factory import clicks, write_video
from tests.tracker.turning_head import picture, shifted_landmarks, turning_track
from tracker.head import load_head
from tracker.overlay import MODES
from tracker.track import Bundle, Camera

FRAMES, LEFT_OUT = 6, 4


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


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run folder up to its track; one frame is left out."""
    head, folder = load_head(), tmp_path_factory.mktemp("overlay")
    track = turning_track(head, FRAMES)
    video = folder / "talk.mkv"
    pictures = [picture(track, head, frame) for frame in range(FRAMES)]
    write_video(video, pictures, track.time.tolist(), sound=clicks([0.1], FRAMES / 25))
    valid = np.arange(FRAMES) != LEFT_OUT
    confidence = np.where(valid, 0.9, 0).astype(np.float32)
    run = RunFolder.create(folder / "run", video)
    for name in ("landmarks", "refine"):
        (run.path / name).mkdir(parents=True)
    write_landmarks(run.path / "landmarks/landmarks.npz", shifted_landmarks(track, head, 0))
    track = dataclasses.replace(track, valid=valid, confidence=confidence)
    write_track(run.path / "refine/track.npz", track)
    reasons = ["ok" if used else "blurred" for used in valid]
    write_quality(run.path / "refine/quality.csv", track, reasons, np.ones(len(track.time), np.float32))
    return run


def make(run: RunFolder, folder: Path, modes: tuple[str, ...]) -> Path:
    folder.mkdir()
    write_overlay(run, load_head(), modes, folder, lambda done, total: None)
    return folder


def test_the_film_shows_every_frame_in_every_mode_and_what_is_left_out(
    run: RunFolder, tmp_path: Path
) -> None:
    folder = make(run, tmp_path / "made", tuple(MODES))
    film = [rgb for _, rgb in FrameReader(folder / "overlay.mp4")]
    assert len(film) == len(list(FrameReader(folder / "preview.mp4"))) == FRAMES
    columns, rows = 3, 2
    height, width = (film[0].shape[0] - FOOTER) // rows, film[0].shape[1] // columns
    assert max(width, height) == PANEL
    for frame, colour, video_alone in ((0, GOOD, False), (LEFT_OUT, BAD, True)):
        panels = [film[frame][:height, column * width : (column + 1) * width] for column in range(columns)]
        changed = [np.abs(panel[60:].astype(int) - panels[0][60:]).mean() for panel in panels[1:]]
        assert all((change < 2) == video_alone for change in changed)  # the codec leaves traces
        shown = film[frame][-FOOTER:].reshape(-1, 3).astype(int)
        assert np.abs(shown - colour).sum(1).min() < 60
    sheet = cv2.imread(str(folder / "contact_sheet.png"))
    places = len(notable_frames(np.arange(FRAMES) != LEFT_OUT, np.ones(FRAMES)))
    assert sheet.shape == (-(-places // COLUMNS) * TILE, COLUMNS * TILE, 3)


def test_the_preview_is_the_beginning_and_the_sheet_shows_its_frames_in_their_colours(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("personalize.overlay.PREVIEW_S", 0.1)
    folder = make(run, tmp_path / "made", ("shaded",))
    whole, preview = ([t for t, _ in FrameReader(folder / f"{name}.mp4")] for name in ("overlay", "preview"))
    assert whole == pytest.approx(np.arange(FRAMES) / 25, abs=1e-3) and preview == pytest.approx(whole[:3])
    lengths = [len(read_audio(folder / f"{name}.mp4")[0]) / 16_000 for name in ("overlay", "preview")]
    assert lengths == pytest.approx([FRAMES / 25, 0.1], abs=0.05)  # sound is coded in blocks
    pictures, valid = TrackPictures.of(run, load_head(), ("shaded",)), np.arange(FRAMES) != LEFT_OUT
    frame = int(notable_frames(valid, np.ones(FRAMES, np.float32))[0])
    _, rgb = list(FrameReader(run.video))[frame]
    sheet = cv2.cvtColor(cv2.imread(str(folder / "contact_sheet.png")), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(sheet[:TILE, :TILE], pictures.tile(rgb, frame))


def test_the_same_film_is_made_twice(run: RunFolder, tmp_path: Path) -> None:
    first, second = (make(run, tmp_path / name, ("wireframe", "error")) for name in ("first", "second"))
    for name in ("overlay.mp4", "preview.mp4", "contact_sheet.png"):
        assert (first / name).read_bytes() == (second / name).read_bytes()


@pytest.mark.parametrize("bends", [True, False])
def test_lens_and_zoom_are_taken_out_of_what_is_shown(run: RunFolder, bends: bool) -> None:
    pictures = TrackPictures.of(run, load_head(), ("landmarks",))
    zoom = np.tile(np.float32([1.3, 100, 80]), (FRAMES, 1))
    made = {"distortion": np.array([-0.5], np.float32)} if bends else {"zoom": zoom}
    seen = dataclasses.replace(pictures.track, **made)
    rgb = np.random.default_rng(0).integers(0, 255, (*pictures.landmarks.size[::-1], 3)).astype(np.uint8)
    width, height = pictures.crop.size
    shown = dataclasses.replace(pictures, track=seen).film(rgb, LEFT_OUT)[60:height, :width]
    expected = pictures.crop.picture(seen.lens.picture(rgb, LEFT_OUT))[60:height]
    assert (shown == expected).mean() > 0.99 and (shown == pictures.crop.picture(rgb)[60:height]).mean() < 0.5


def test_zoom_is_kept_with_the_camera_and_the_track(run: RunFolder, tmp_path: Path) -> None:
    zoom = np.tile(np.float32([1.3, 100, 80]), (FRAMES, 1))
    track = dataclasses.replace(read_track(run.path / "refine/track.npz"), zoom=zoom)
    write_track(tmp_path / "track.npz", track)
    np.testing.assert_array_equal(read_track(tmp_path / "track.npz").lens.zoom, zoom)
    nothing = np.zeros((0, 3), np.float32)
    camera = Camera(900.0, 0.1, (159.5, 119.5), (), (320, 240), "bundle", "", zoom)
    bundle = Bundle(np.zeros(0, np.int32), nothing, nothing, nothing, np.zeros((0, 4), np.float32))
    write_camera(tmp_path, camera, bundle)
    again, _ = read_camera(tmp_path)
    np.testing.assert_array_equal(again.lens.zoom, zoom)
    assert again.focal_px == 900 and "zoom" not in (tmp_path / "camera.json").read_text()
