"""Which frames of a clip are used and why others are not; on whole clips where shared ones are there."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast
from unittest.mock import Mock

import numpy as np
import pytest

from personalize.container import MediaInfo, probe
from personalize.errors import UserError
from personalize.ingest import (
    DESCRIPTIONS,
    MIN_USABLE_S,
    REMEDIES,
    _check_upright,
    _form,
    _lost_in_file,
    _Seen,
    _without_sound,
    find_usable,
    ingest_video,
)
from personalize.people import (
    Tracklet,
)
from personalize.pictures import FrameReader
from personalize.shots import (
    REASONS,
    Frames,
    find_shots,
    repeated,
)
from tests.personalize.people_factory import frames_of, tracklet
from tests.personalize.video_factory import RATE, clicks, moving, write_video
from tracker.landmark_indices import LEFT_EYE_OUTER, RIGHT_EYE_OUTER
from tracker.track import F32


def follow_one(
    monkeypatch: pytest.MonkeyPatch,
    face: Tracklet,
    across: Sequence[float] = (60, 0),
    widest: F32 | None = None,
) -> None:
    """Let a clip show one face, whose eyes lie `across` [2] px from each other; see FaceFollower for widest."""
    for shape in face.shapes:
        shape[LEFT_EYE_OUTER, :2] = shape[RIGHT_EYE_OUTER, :2] + across
    follower = Mock(tracklets=[face], widest=widest, foremost=None, boxes=[])
    monkeypatch.setattr("personalize.ingest.FaceFollower", lambda _: follower)


@pytest.mark.parametrize(
    ("resized_s", "interlaced", "said"),
    [(np.nan, 10, []), (np.nan, 20, ["interlaced"]), (1.0, 20, ["changes at 1.0 s", "interlaced"])],
)
def test_pictures_of_an_unusual_form_are_told(resized_s: float, interlaced: int, said: list[str]) -> None:
    media = SimpleNamespace(width=96, height=64)
    texts = _form(media, SimpleNamespace(resized_s=resized_s, interlaced=interlaced), 25)
    assert len(texts) == len(said) and all(words in text for words, text in zip(said, texts))


def test_how_closely_is_looked_is_decided_once_for_a_clip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By how wide the face usually is: cuts of small ones, repeated pictures of somewhat larger ones too."""
    path = write_video(tmp_path / "clip.mkv", moving(60), [i / 25 for i in range(60)])
    looked: list[np.ndarray] = []
    monkeypatch.setattr(
        "personalize.ingest.Changes",
        lambda: Mock(next=lambda rgb, faces, foremost: ((1.0, False), (5.0, False), np.nan)),
    )
    monkeypatch.setattr(
        "personalize.ingest.repeated", lambda time, change, same: looked.append(change) or same
    )
    monkeypatch.setattr(
        "personalize.ingest.find_shots",
        lambda time, change, face: looked.append(change) or np.zeros(60, np.int32),
    )
    for width, repeats, cuts in ((9.0, 5.0, 5.0), (12.0, 5.0, 1.0), (24.0, 1.0, 1.0)):  # of 96 px
        face = tracklet(1, range(60))
        for sighting in face.sightings:
            sighting.box[:] = (20, 20, 20 + width, 40)
        follow_one(monkeypatch, face)
        find_usable(probe(path))
        assert (set(looked.pop()), set(looked.pop())) == ({cuts}, {repeats})
    # Beside a photograph, which is the widest.
    face, photograph = tracklet(1, range(60), width=12), tracklet(2, range(60), width=40)
    follower = Mock(tracklets=[photograph, face], widest=None, foremost=None, boxes=[])
    monkeypatch.setattr("personalize.ingest.FaceFollower", lambda _: follower)
    find_usable(probe(path))
    assert (set(looked.pop()), set(looked.pop())) == ({1.0}, {5.0})


def test_broken_time_stamps_take_no_more_memory_than_whole_ones() -> None:
    time = np.arange(3000) / 90_000
    assert find_shots(time, np.ones(3000), np.ones(3000)).max() == 0
    assert not repeated(time, np.ones(3000), np.zeros(3000, bool)).any()


def test_no_sound_silence_and_no_face_are_named(tmp_path: Path) -> None:
    pictures, times = moving(30), [i / 25 for i in range(30)]
    mute = write_video(tmp_path / "mute.mkv", pictures, times)
    silent = write_video(tmp_path / "silent.mkv", pictures, times, np.zeros(RATE, np.float32))
    nobody = write_video(tmp_path / "nobody.mkv", pictures, times, clicks([0.2], 1.0))
    for path, words in ((mute, "no sound"), (silent, "silent"), (nobody, "no face")):
        with pytest.raises(UserError, match=words) as caught:
            ingest_video(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [1, 2, 30])
def test_a_black_clip_and_a_single_picture_show_no_face(tmp_path: Path, count: int) -> None:
    black = [np.zeros((64, 96, 3), np.uint8)] * count
    path = write_video(tmp_path / "black.mkv", black, [i / 25 for i in range(count)], clicks([0.2], 1.0))
    with pytest.raises(UserError, match=r"no face was found|only one picture") as caught:
        ingest_video(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("tilt_deg", "refused"), [(-90, True), (90, True), (180, True), (0, False), (40, False)]
)
def test_a_face_that_lies_on_its_side_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tilt_deg: float, refused: bool
) -> None:
    path = write_video(tmp_path / "clip.mkv", moving(20), [i / 25 for i in range(20)])
    angle = np.radians(tilt_deg)
    follow_one(monkeypatch, tracklet(1, range(20)), 60 * np.array([np.cos(angle), np.sin(angle)]))
    if refused:
        with pytest.raises(UserError, match="on its side"):
            find_usable(probe(path))
    else:
        assert find_usable(probe(path))[0].usable.any()


@pytest.mark.parametrize(
    ("quarters", "surer", "refusal"),
    [
        (2, 0.3, "upside down; turn the video"),
        (1, 0.06, "on its side"),
        (3, 0.06, "on its side"),
        (1, 0.04, None),  # a head that is tilted
        (2, -0.3, None),
    ],
)
def test_a_picture_that_is_turned_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quarters: int, surer: float, refusal: str | None
) -> None:
    path = write_video(tmp_path / "clip.mkv", moving(60), [i / 25 for i in range(60)])
    box = np.array([20, 20, 40, 40], np.float32)
    follow_one(monkeypatch, tracklet(1, range(60)), [60, 0], box)
    told, errs = np.full(4, 0.6), np.array([0.6, 0.5, 0.5, 0.5])
    told[quarters] += surer
    # One look of several errs.
    looks = iter([errs if refusal else told, *[told] * 9])
    monkeypatch.setattr("personalize.ingest.TURN_S", 0.25)
    monkeypatch.setattr("personalize.ingest.sureness_of_turns", lambda *_: next(looks))
    if refusal:
        with pytest.raises(UserError, match=refusal):
            find_usable(probe(path))
    else:
        assert find_usable(probe(path))[0].usable.any()


@pytest.mark.parametrize(
    ("turned", "upright", "unseen", "refused"),
    [(3, 0, 0, False), (4, 0, 0, True), (6, 4, 0, False), (8, 2, 0, True), (3, 0, 9, False)],
)
def test_three_quarters_of_four_looks_and_more_tell_that_a_picture_is_turned(
    turned: int, upright: int, unseen: int, refused: bool
) -> None:
    each = {"turned": [0.6, 0.8, 0.9, 0.8], "upright": [0.9, 0.8, 0.6, 0.8], "unseen": [0.0, 0.7, 0.0, 0.0]}
    numbers = {"turned": turned, "upright": upright, "unseen": unseen}
    turns = [np.array(each[kind]) for kind, count in numbers.items() for _ in range(count)]
    media = SimpleNamespace(path="clip.mp4")
    if refused:
        with pytest.raises(UserError, match="upside down"):
            _check_upright(media, [], turns)
    else:
        _check_upright(media, [], turns)


def test_a_head_on_its_side_is_told_so_whatever_the_detector_finds_surer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_video(tmp_path / "clip.mkv", moving(60), [i / 25 for i in range(60)])
    box = np.array([20, 20, 40, 40], np.float32)
    follow_one(monkeypatch, tracklet(1, range(60)), [0, 60], box)
    monkeypatch.setattr("personalize.ingest.TURN_S", 0.25)
    monkeypatch.setattr("personalize.ingest.sureness_of_turns", lambda *_: np.array([0.5, 0.5, 0.9, 0.5]))
    with pytest.raises(UserError, match="lies on its side"):
        find_usable(probe(path))


def test_sound_beside_all_pictures_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(
        tmp_path / "clip.mkv", moving(20), [i / 25 for i in range(20)], clicks([1], 2), sound_start=50
    )
    frames = frames_of(np.arange(300) / 25, np.ones(300, bool))
    monkeypatch.setattr("personalize.ingest.find_usable", lambda media, progress: (frames, []))
    with pytest.raises(UserError, match="before the first picture or after the last"):
        ingest_video(path)


def test_sound_that_does_not_last_as_long_as_the_pictures_is_told() -> None:
    sound = np.zeros(16_000 * 3, np.float32)
    assert _without_sound(sound, 0.5, 4.0) == []
    (late,) = _without_sound(sound, 1.5, 4.5)
    assert "from 1.5 to 4.5 s of 4.5 s" in late
    (early,) = _without_sound(sound, -0.2, 11.0)
    assert "from 0.0 to 2.8 s of 11.0 s" in early


@pytest.mark.parametrize(
    ("light", "burnt", "reason", "said"),
    [
        (120.0, 0.1, "ok", ""),
        (190.0, 0.35, "ok", "overexposed (35% of its colours cut off)"),
        (230.0, 0.7, "too_bright", "left out: the face is overexposed"),
        (65.0, 0.0, "ok", ""),
        (45.0, 0.0, "ok", "dark (45 of 255)"),
        (8.0, 0.0, "too_dark", "left out: the face is too dark"),
    ],
)
def test_too_much_light_is_told_as_too_little_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, light: float, burnt: float, reason: str, said: str
) -> None:
    path = write_video(tmp_path / "clip.mkv", moving(20), [i / 25 for i in range(20)])
    face = tracklet(1, range(20), light=light, burnt=burnt)
    follow_one(monkeypatch, face)
    frames, warnings = find_usable(probe(path))
    assert {frames.reasons[index] for index in frames.reason[1:]} == {reason}
    assert (said in " ".join(warnings)) if said else not any("face is" in text for text in warnings)


@pytest.mark.parametrize(("steps", "told"), [(24, False), (26, True)])
def test_hard_compression_is_told_by_how_large_the_face_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int, told: bool
) -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (64, 96, 3), np.uint8) for _ in range(20)]
    coded = {"x264-params": f"qp={steps}:ipratio=1:bframes=0:aq-mode=0"}
    path = write_video(tmp_path / "clip.mp4", pictures, [i / 25 for i in range(20)], options=coded)
    follow_one(monkeypatch, tracklet(1, range(20)))  # 60 px between the eyes
    _, warnings = find_usable(probe(path))
    assert any(f"quantizer {steps} of 51, 60 px" in text for text in warnings) == told


@pytest.mark.parametrize(
    ("fps", "repeats", "said"), [(4, 1, "4.0"), (6, 1, "6.0"), (25, 5, "5.0"), (8, 1, ""), (25, 2, "")]
)
def test_too_few_pictures_a_second_are_refused(tmp_path: Path, fps: int, repeats: int, said: str) -> None:
    pictures = [picture for picture in moving(24) for _ in range(repeats)]
    path = write_video(tmp_path / "slow.mkv", pictures, [i / fps for i in range(len(pictures))])
    if said:
        with pytest.raises(UserError, match=rf"^{path}: only {said} different pictures a second") as caught:
            find_usable(probe(path))
        assert "\n" not in str(caught.value)
    else:
        find_usable(probe(path))


def test_a_matroska_file_that_begins_late_breaks_not_off(tmp_path: Path) -> None:
    path = write_video(tmp_path / "late.mkv", moving(50), [5 * 3600 + i / 25 for i in range(50)])
    assert probe(path).duration_s == pytest.approx(2.0, abs=0.1)
    assert not any("breaks off" in text for text in find_usable(probe(path))[1])


def test_what_the_file_lost_is_said(tmp_path: Path) -> None:
    path = write_video(tmp_path / "gap.mkv", moving(20), [i / 25 + (i >= 10) for i in range(20)])
    _, warnings = find_usable(probe(path))
    assert any(
        "1.0 s without pictures, in a gap at 0.4 s: the film counts as cut there; export" in text
        for text in warnings
    )


def seen_as(faces: list[Tracklet], time: np.ndarray, **marks: np.ndarray) -> _Seen:
    """What a pass over pictures at `time` [T] s shows where these faces are; marks: as of `_Seen`."""
    nothing = np.zeros(len(time), bool)
    reader = SimpleNamespace(resized_s=np.nan, interlaced=0)
    still, unseen = np.ones(len(time)), np.full(len(time), np.nan)
    rest = {"change": still, "face": unseen, "again": nothing, "corrupt": nothing} | marks
    return _Seen(time=time, faces=faces, turns=[], reader=cast(FrameReader, reader), **rest)


def usable_of(
    seen: _Seen, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int] = (960, 540)
) -> tuple[Frames, list[str]]:
    """`find_usable` of a film of that size (width, height)."""
    monkeypatch.setattr("personalize.ingest._looked_through", lambda *_: seen)
    monkeypatch.setattr("personalize.ingest.quantizer", lambda _: np.nan)
    media = SimpleNamespace(path="film.mp4", width=size[0], height=size[1], duration_s=float(seen.time[-1]))
    return find_usable(cast(MediaInfo, media))


def test_every_frame_is_left_out_for_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cuts at 40, 48 and 80: eight frames are no shot, and behind the last there is somebody else."""
    time, change = np.arange(100) / 25, np.ones(100)
    change[[40, 48, 80]] = 20
    mine = [*range(26), *range(36, 60), *range(62, 80)]
    spoiled = {
        "blurred": {"sharpness": 0.19},
        "too_dark": {"light": 14.0},
        "too_bright": {"burnt": 0.51},
        "too_small": {"eyes": 19.0},
    }
    at = dict(zip((10, 12, 14, 16), spoiled.items()))
    faces = [tracklet(1, mine), tracklet(2, range(80, 100))]
    faces[0].sightings = [
        replace(one, **at[one.frame][1]) if one.frame in at else one for one in faces[0].sightings
    ]
    marks = {
        name: np.isin(np.arange(100), rows) for name, rows in (("again", (18, 20)), ("corrupt", (20, 30)))
    }
    frames, warnings = usable_of(seen_as(faces, time, change=change, **marks), monkeypatch)
    expected = np.full(100, "ok", object)
    for frame, (name, _) in at.items():
        expected[frame] = name
    expected[26:36] = "no_face"  # for more than .3 s; 60 and 61 are taken to be like their neighbours
    expected[[18, 20, 30]] = "duplicate", "corrupt", "corrupt"
    expected[40:49], expected[80:] = "cut", "other_person"
    assert [frames.reasons[index] for index in frames.reason] == expected.tolist()
    np.testing.assert_array_equal(frames.usable, expected == "ok")
    np.testing.assert_array_equal(
        np.isnan(frames.box[:, 0]), np.isin(np.arange(100), [*range(26, 36), *range(80, 100)])
    )
    np.testing.assert_array_equal(frames.seen, ~np.isnan(frames.box[:, 0]))
    assert any("2.0% of 100 frames left out: damaged" in text for text in warnings)  # however few
    assert any("20.0% of 100 frames left out: another person" in text for text in warnings)
    assert set(DESCRIPTIONS) == set(REMEDIES) == set(REASONS[1:])
    assert not any("repeated" in text for text in warnings)


def test_what_the_detector_missed_for_a_moment_lies_between_its_neighbours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    face = tracklet(1, [*range(20), 22, *range(23, 40), 50])
    for sighting in face.sightings:
        sighting.box[:] = np.float32([0, 0, 50, 50]) + sighting.frame
    frames, _ = usable_of(seen_as([face], np.arange(51) / 25), monkeypatch)
    np.testing.assert_allclose(frames.box[20:22, 0], [20, 21])
    assert np.isnan(frames.box[40:50]).all() and frames.box[50, 0] == 50


@pytest.mark.parametrize(
    ("eyes", "reason", "said"), [(15.0, "ok", "30 px"), (9.0, "too_small", ""), (30.0, "ok", "")]
)
def test_faces_are_measured_in_the_films_own_pixels(
    monkeypatch: pytest.MonkeyPatch, eyes: float, reason: str, said: str
) -> None:
    """They are looked for in smaller pictures."""
    face = tracklet(1, range(40))
    face.sightings = [replace(one, eyes=eyes) for one in face.sightings]
    frames, warnings = usable_of(seen_as([face], np.arange(40) / 25), monkeypatch, (1080, 1920))
    assert {frames.reasons[index] for index in frames.reason} == {reason}
    np.testing.assert_allclose(frames.box[5], [0, 0, 100, 100])
    assert any(f"small ({said} between the eyes)" in text for text in warnings) == bool(said)


@pytest.mark.parametrize(("seconds", "said"), [(8, "refused"), (20, "only 20.0 s of usable face"), (40, "")])
def test_how_much_usable_face_there_is_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: int, said: str
) -> None:
    path = write_video(tmp_path / "clip.mkv", moving(20), [i / 25 for i in range(20)], clicks([0.2], 1))
    frames = frames_of(np.arange(25 * seconds) / 25, np.ones(25 * seconds, bool))
    monkeypatch.setattr("personalize.ingest.find_usable", lambda media, progress: (frames, []))
    if said == "refused":
        with pytest.raises(UserError, match=r"only 8\.0 s of usable face, at least 10 s are needed"):
            ingest_video(path)
        return
    ingested = ingest_video(path)
    assert len(ingested.audio) == 16_000 * seconds  # to the end of the last picture
    assert (said in ingested.warnings[0]) if said else not any("usable" in text for text in ingested.warnings)


def test_a_file_that_breaks_off_is_told() -> None:
    media = cast(MediaInfo, SimpleNamespace(duration_s=5.0))
    assert _lost_in_file(media, np.arange(101) / 25) == []
    assert _lost_in_file(media, np.arange(76) / 25) == [
        "the file breaks off at 3.0 s of 5.0 s; copy or export it again if you need the rest"
    ]


SHARED = Path(os.environ.get("PERSONALIZE_SHARED", Path(__file__).parents[3] / "shared")) / "data/videos"


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the shared videos")
def test_a_real_face_is_used_up_to_the_cartoon() -> None:
    frames, _ = find_usable(probe(SHARED / "face_then_cartoon_6s.mov"))
    assert frames.usable[frames.time < 2.3].mean() > 0.95
    assert not frames.usable[frames.time > 2.5].any()
    with pytest.raises(UserError, match=rf"only 2\.\d s of usable face, at least {MIN_USABLE_S:.0f} s"):
        ingest_video(SHARED / "face_then_cartoon_6s.mov")
