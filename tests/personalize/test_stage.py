"""Stages: cached by content, remade when anything that decides them changes, whole or not there."""

import io
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from personalize.errors import UserError
from personalize.reporter import Reporter
from personalize.run import RunFolder, read_camera, write_features, write_frames, write_landmarks
from personalize.settings import Settings
from personalize.stage import Context, Stage, is_cached, run_stages
from personalize.stages import CameraStage, Ingest
from tests.personalize.people_factory import frames_of
from tracker.feature_tracks import FeatureTracks
from tracker.track import Landmarks


class Count(Stage):
    """Writes how many bytes the video has; `slow` may be killed in the middle."""

    name, version, reads, needs, makes = "count", 1, ("seed",), ("video",), ("count.txt",)
    made: ClassVar[int] = 0

    def make(self, context: Context, folder: Path) -> None:
        type(self).made += 1
        (folder / "count.txt").write_text(f"{context.run.video.stat().st_size} {context.settings.seed}")


class Double(Stage):
    """Twice the count, as a product at the top."""

    name, version, needs, makes, products = "double", 1, ("count/count.txt",), ("half.txt",), ("double.txt",)
    made: ClassVar[int] = 0

    def make(self, context: Context, folder: Path) -> None:
        type(self).made += 1
        count = int((context.run.path / "count/count.txt").read_text().split()[0])
        (folder / "half.txt").write_text(str(count // 2))
        (folder / "double.txt").write_text(str(2 * count))


class Crawl(Stage):
    """Counts to ten in its partial folder and continues from there."""

    name, version, makes, resumes = "crawl", 1, ("steps.txt",), True

    def make(self, context: Context, folder: Path) -> None:
        log = folder / "steps.txt"
        for step in range(len(log.read_text().split()) if log.exists() else 0, 10):
            with log.open("a") as stream:
                stream.write(f"{step}@{os.getpid()} ")
            time.sleep(0.05)


@pytest.fixture
def context(tmp_path: Path) -> Context:
    video = tmp_path / "talk.mp4"
    video.write_bytes(b"twelve bytes")
    run = RunFolder.create(tmp_path / "run", video)
    run.path.mkdir()
    run.begin(Settings())
    Count.made = Double.made = 0
    return Context(run, Settings(), Reporter(stream=io.StringIO()))


STAGES = (Count(), Double())


def test_second_run_makes_nothing(context: Context) -> None:
    run_stages(STAGES, context)
    again = Context(RunFolder.open(context.run.path), context.settings, context.report)
    run_stages(STAGES, again)
    assert (Count.made, Double.made) == (1, 1)
    assert (context.run.path / "double.txt").read_text() == "24"
    entry = json.loads((context.run.path / "run.json").read_text())["stages"]["double"]
    assert set(entry["outputs"]) == {"double/half.txt", "double.txt"}


def test_a_setting_remakes_only_what_changes(context: Context) -> None:
    run_stages(STAGES, context)
    run_stages(STAGES, Context(context.run, Settings(iterations=5), context.report))
    assert (Count.made, Double.made) == (1, 1)
    run_stages(STAGES, Context(context.run, Settings(seed=1), context.report))
    assert (Count.made, Double.made) == (2, 2)


@pytest.mark.parametrize("damaged", ["count/count.txt", "double.txt"])
def test_a_damaged_output_is_made_again(context: Context, damaged: str) -> None:
    run_stages(STAGES, context)
    (context.run.path / damaged).write_text("damaged")
    run_stages(STAGES, context)
    assert (context.run.path / "count/count.txt").read_text() == "12 0"
    assert (context.run.path / "double.txt").read_text() == "24"


def test_until_from_and_force(context: Context) -> None:
    assert list(run_stages(STAGES, context, until="count")) == [STAGES[0]]
    assert (Count.made, Double.made) == (1, 0)
    assert list(run_stages(STAGES, context)) == list(STAGES)
    run_stages(STAGES, context, force="count")
    assert (Count.made, Double.made) == (2, 1), "the same bytes came out: what follows stays"
    run_stages(STAGES, context, first="count")
    assert (Count.made, Double.made) == (3, 2)
    with pytest.raises(UserError, match="no such stage; choose one of count, double"):
        run_stages(STAGES, context, until="counts")
    for option in ({"first": "double"}, {"force": "double"}):
        with pytest.raises(UserError, match="after --until count, and would not be made"):
            run_stages(STAGES, context, until="count", **option)


def test_a_cached_stage_says_again_what_it_warned_of(
    context: Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Count, "warnings", lambda self, run: ["the face is dark"])
    context.report.log_to(log := context.run.path / "log.txt")
    run_stages(STAGES, context)
    assert "warning" not in log.read_text(), "what is made warns itself"
    run_stages(STAGES, context)
    assert log.read_text().count("warning: the face is dark") == 1


def test_ingest_remembers_its_warnings(context: Context) -> None:
    (context.run.path / "ingest").mkdir()
    (context.run.path / "ingest/media.json").write_text(json.dumps({"warnings": ["the face is dark"]}))
    assert Ingest().warnings(context.run) == ["the face is dark"]


def test_a_failing_stage_leaves_the_earlier_result(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    run_stages(STAGES, context)

    def fail(self: Stage, context: Context, folder: Path) -> None:
        (folder / "count.txt").write_text("half")
        raise UserError("no")

    monkeypatch.setattr(Count, "make", fail)
    with pytest.raises(UserError):
        run_stages(STAGES, context, force="count")
    assert (context.run.path / "count/count.txt").read_text() == "12 0"
    assert is_cached(STAGES[0], STAGES[0].key(context), context.run)


def _crawl(path: Path) -> None:
    run = RunFolder.open(path)
    run_stages((Crawl(),), Context(run, Settings(), Reporter(stream=io.StringIO())))


def test_killed_stage_is_not_taken_for_finished_and_continues(context: Context) -> None:
    process = multiprocessing.get_context("fork").Process(target=_crawl, args=(context.run.path,))
    process.start()
    partial = context.run.path / ".crawl.partial/steps.txt"
    while not partial.exists() or len(partial.read_text().split()) < 3:
        time.sleep(0.01)
    os.kill(process.pid or 0, signal.SIGKILL)
    process.join()
    assert not (context.run.path / "crawl").exists()
    _crawl(context.run.path)
    steps = (context.run.path / "crawl/steps.txt").read_text().split()
    assert [int(step.split("@")[0]) for step in steps] == list(range(10))
    assert len({step.split("@")[1] for step in steps}) == 2


@pytest.fixture
def crawl(context: Context, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """How many steps one command makes, which is interrupted in step `stop`."""

    def made(stop: int | None = None, **options: str) -> int:
        slept: list[float] = []

        def sleep(seconds: float) -> None:
            slept.append(seconds)
            if len(slept) == stop:
                raise KeyboardInterrupt

        monkeypatch.setattr(time, "sleep", sleep)
        with suppress(KeyboardInterrupt):
            run_stages((Crawl(),), context, **options)
        return len(slept)

    return made


@pytest.mark.parametrize("option", ["force", "first"])
def test_an_interrupted_forced_stage_is_continued_by_the_same_command(
    crawl: Callable[..., int], option: str
) -> None:
    forced = {option: "crawl"}
    assert crawl() == 10
    assert crawl(**forced, stop=4) == 4, "what was finished is begun anew"
    assert crawl(**forced, stop=3) == 3
    assert crawl(**forced) == 3, "4 and 3 of 10 were made"
    assert crawl() == 0
    assert crawl(**forced) == 10


def test_a_forced_stage_does_not_continue_what_it_was_not_forced_in(crawl: Callable[..., int]) -> None:
    assert crawl(stop=4) == 4
    assert crawl(force="crawl", stop=7) == 7
    assert crawl(stop=1) == 1
    assert crawl(force="crawl") == 2


def test_another_process_is_refused(context: Context) -> None:
    other = RunFolder.open(context.run.path)
    with (
        context.run.locked(),
        pytest.raises(UserError, match="another personalize is working there"),
        other.locked(),
    ):
        pass


def test_another_videos_folder_is_refused(context: Context, tmp_path: Path) -> None:
    other = tmp_path / "other.mp4"
    other.write_bytes(b"other")
    before = (context.run.path / "run.json").read_bytes()
    with pytest.raises(UserError, match=r"another video \(talk.mp4\)"):
        RunFolder.create(context.run.path, other)
    assert (context.run.path / "run.json").read_bytes() == before
    with pytest.raises(UserError, match="not a run folder"):
        RunFolder.create(tmp_path, other)


def test_a_folder_whose_first_process_was_killed_at_once_is_taken(tmp_path: Path) -> None:
    video, folder = tmp_path / "talk.mp4", tmp_path / "talk.personalize"
    video.write_bytes(b"talk")
    folder.mkdir()
    for name in (".lock", ".run.json.partial"):
        (folder / name).touch()
    assert not RunFolder.create(folder, video).stages


def test_a_folder_read_again_is_as_others_left_it_and_the_video_is_not_read_again(tmp_path: Path) -> None:
    videos = [tmp_path / name for name in ("talk.mp4", "other.mp4")]
    for video in videos:
        video.write_bytes(video.name.encode())
    mine, same, other = (RunFolder.create(tmp_path / "run", videos[index]) for index in (0, 0, 1))
    for video in videos:
        video.unlink()
    mine.path.mkdir()
    same.begin(Settings())
    same.record("count", {"key": "k", "seconds": 0.0, "outputs": {}})
    assert list(mine.reread().stages) == ["count"]
    with pytest.raises(UserError, match=r"another video \(talk.mp4\)"):
        other.reread()


@pytest.mark.parametrize(
    "damage",
    [
        lambda state: state.pop("stages"),
        lambda state: state["video"].pop("sha256"),
        lambda state: state["stages"].update(double="done"),
        lambda state: state["stages"]["double"].pop("outputs"),
        lambda state: state["stages"]["double"].update(outputs=[]),
        lambda state: state["stages"]["double"].update(seconds=None),
        lambda state: state["video"].update(path=None),
    ],
)
def test_a_run_json_that_somebody_has_edited_is_refused(
    context: Context, damage: Callable[[dict[str, Any]], object]
) -> None:
    run_stages(STAGES, context)
    path = context.run.path / "run.json"
    state = json.loads(path.read_text())
    damage(state)
    path.write_text(json.dumps(state))
    with pytest.raises(UserError, match="not a run of this version"):
        RunFolder.open(context.run.path)


def test_the_camera_believes_what_the_file_tells_of_the_lens(context: Context) -> None:
    root = context.run.path
    (root / "ingest").mkdir()
    (root / "ingest/media.json").write_text(json.dumps({"focal_mm": 27.0}))
    write_frames(root / "ingest/frames.npz", frames_of(np.arange(3) / 25, np.ones(3, bool)))
    (root / "landmarks").mkdir()
    points = np.full((3, 478, 3), np.nan, np.float32)
    landmarks = Landmarks(
        *(np.arange(3) / 25, points, np.zeros((3, 52), np.float32), np.zeros(3, np.float32)),
        blendshape_names=("",) * 52,
        size=(640, 480),
    )
    write_landmarks(root / "landmarks/landmarks.npz", landmarks)
    nothing = FeatureTracks(np.zeros(0, np.int32), np.zeros((0, 4), np.float32))
    write_features(root / "landmarks/features.npz", nothing)
    run_stages([CameraStage()], context)
    camera, _ = read_camera(root / "camera")
    assert camera.focal_px == pytest.approx(1.1 * 27 / 36 * 640) and "27 mm" in camera.prior
