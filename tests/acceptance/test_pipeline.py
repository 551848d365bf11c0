"""The whole command on a small rendered talker: the run folder, caching, and SIGKILL in every stage."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from html import unescape
from pathlib import Path

import av
import numpy as np
import pytest

from model.checkpoint import Checkpoint
from model.motion import Motion
from personalize.demo import true_errors
from personalize.evaluation.report import _facts, _warnings
from personalize.files import sha256_file
from personalize.pictures import FrameReader
from personalize.run import RunFolder, read_refined, read_track, write_refined
from personalize.sound import read_audio
from personalize.talkers.film import ASSETS, Truth, demo_identity, render_talker
from personalize.talkers.motion import talker_motion
from personalize.talkers.style import Style
from personalize.talkers.visemes import load_phones
from tracker.head import load_head

SECONDS, FPS, SIDE = 12.0, 25.0, 320
ITERATIONS = "60"
STAGES = (
    *("ingest", "landmarks", "camera", "track", "refine", "judge", "overlay"),
    *("registration", "finetune", "evaluate"),
)


@pytest.fixture(scope="session")
def talk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A 12 s film of a made-up person; its truth lies beside it."""
    path = tmp_path_factory.mktemp("talk") / "talk.mp4"
    head = load_head()
    sound, _ = read_audio(ASSETS / "demo_speech.flac")
    sound = sound[: int(SECONDS * 16000)]
    phones = [phone for phone in load_phones(ASSETS / "demo_speech.json") if phone.end <= SECONDS]
    motion = talker_motion(phones, SECONDS, FPS, 3, Style.random(3), sound, 0.48)
    render_talker(path, motion, demo_identity(head, 3), head, (SIDE, SIDE), 450.0, 3, sound)
    return path


def start(video: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "cli.main", str(video), "--out", str(out), "--iterations", ITERATIONS]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # What a shell starts in the background, these tests perhaps, ignores the interrupt, and so would its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


@pytest.fixture(scope="session")
def finished(talk: Path) -> Path:
    out = talk.with_name("whole")
    process = start(talk, out)
    said, complaints = process.communicate(timeout=400)
    assert process.returncode == 0, complaints.decode()
    assert "report" in said.decode()
    return out


def test_run_folder_holds_what_design_says(talk: Path, finished: Path) -> None:
    state = json.loads((finished / "run.json").read_text())
    assert list(state["stages"]) == list(STAGES)
    assert state["video"]["name"] == "talk.mp4"
    frames = round(SECONDS * FPS)
    with np.load(finished / "landmarks/landmarks.npz", allow_pickle=False) as landmarks:
        assert landmarks["points"].shape == (frames, 478, 3)
        assert landmarks["blendshapes"].shape == (frames, 52)
    with np.load(finished / "refine/track.npz", allow_pickle=False) as track:
        assert {"identity", "expression", "jaw", "eyes", "rotation", "lip_gap_mm"} <= set(track.files)
    with (finished / "refine/quality.csv").open(newline="") as stream:
        reasons = [row["reason"] for row in csv.DictReader(stream)]
    assert len(reasons) == frames and reasons.count("ok") > 0.98 * frames
    camera = json.loads((finished / "camera/camera.json").read_text())
    assert {"focal_px", "focal_sd_log", "principal_px", "distortion", "size", "method", "prior"} == set(
        camera
    )
    metrics = json.loads((finished / "evaluation/metrics.json").read_text())
    assert set(metrics["systems"]) == {"mean_motion", "ridge", "base", "personalized"}
    motion = Motion.load(finished / "registration/motion.npz")
    checkpoint = Checkpoint.load(finished / "checkpoint.safetensors")
    assert checkpoint.kind == "subject" and checkpoint.topology == motion.topology
    assert len(motion.valid) == pytest.approx(SECONDS * 30, abs=2)
    heard = [sha256_file(path) for path in (talk, finished / "ingest/audio.wav")]
    assert motion.provenance["av_offset_of"] == heard and motion.provenance["av_offset_s"] == 0


def test_the_track_is_near_the_truth(talk: Path, finished: Path) -> None:
    truth = Truth.load(talk.with_name("talk.truth.npz"))
    errors = true_errors(read_track(finished / "refine/track.npz"), truth, load_head())
    assert errors["tracked_percent"] > 98
    assert errors["lip_opening_r"] > 0.85
    assert errors["lip_motion_centred_mm"] < 1.5
    assert errors["rotation_deg"] < 1.5


def test_the_overlay_plays_and_has_the_sound(finished: Path) -> None:
    with av.open(str(finished / "overlay.mp4")) as film:
        assert film.streams.video[0].codec_context.name == "h264"
        assert film.streams.video[0].codec_context.pix_fmt == "yuv420p"
        assert film.streams.audio[0].codec_context.name == "aac"
    assert sum(1 for _ in FrameReader(finished / "overlay.mp4")) == round(SECONDS * FPS)


def test_the_report_needs_no_other_file(finished: Path) -> None:
    page = (finished / "report.html").read_text()
    assert re.findall(r"(?:src|href)=\"(?!data:|#)", page) == []
    assert "personalized" in page and "data:video/mp4;base64," in page


def test_the_report_tells_what_ails_the_clip(finished: Path, tmp_path: Path) -> None:
    media = json.loads((finished / "ingest/media.json").read_text())
    page = unescape((finished / "report.html").read_text())
    assert media["warnings"] and all(text in page for text in media["warnings"])
    out = tmp_path / "unlike"
    shutil.copytree(finished, out)
    refined = read_refined(out / "photometric")
    write_refined(out / "photometric", replace(refined, like_lips=0.4))
    texts = _warnings(RunFolder.open(out), media)
    assert len(texts) == len(media["warnings"]) + 1 and "40% of it looks like them" in texts[-1]
    quality = out / "refine/quality.csv"
    quality.write_text(quality.read_text().replace(",ok\n", ",occluded\n"))
    covered = _warnings(RunFolder.open(out), media)
    assert covered[:-1] == texts and "a microphone, a mask" in covered[-1]


def test_a_report_of_another_trackers_result_is_of_its_camera(finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "tracked"
    shutil.copytree(finished, out)
    media = json.loads((out / "ingest/media.json").read_text())

    def facts(tracked: str | None) -> dict[str, str]:
        return {fact["name"]: fact["value"] for fact in _facts(RunFolder.open(out), media, tracked)}

    assert "(bundle" in facts(None)["focal length"] and "camera" in facts(None)["stages"]
    shutil.rmtree(out / "camera")
    focal = read_track(out / "refine/track.npz").focal
    assert facts("results/vhap")["focal length"] == f"{focal:.0f} px (as vhap has it)"
    assert "camera" not in facts("results/vhap")["stages"] and "refine" in facts("results/vhap")["stages"]


def content(out: Path) -> dict[str, str]:
    """sha256 of every output that carries no time of day, by name."""
    stages = json.loads((out / "run.json").read_text())["stages"]
    outputs = {name: digest for entry in stages.values() for name, digest in entry["outputs"].items()}
    return {name: digest for name, digest in outputs.items() if name != "report.html"}


def test_killed_in_every_stage_it_ends_in_the_same_result(talk: Path, finished: Path) -> None:
    out = talk.with_name("killed")
    folders = {"evaluate": "evaluation", "refine": "photometric", "judge": "refine"}
    for stage in STAGES:
        process = start(talk, out)
        partial = out / f".{folders.get(stage, stage)}.partial"
        while process.poll() is None and not partial.exists():
            time.sleep(0.005)
        if stage in ("finetune", "overlay"):  # long ones: in their middle
            time.sleep(2)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    process = start(talk, out)
    _, complaints = process.communicate(timeout=400)
    assert process.returncode == 0, complaints.decode()
    assert content(out) == content(finished)


@pytest.mark.parametrize(
    ("how", "code", "said"),
    [
        (signal.SIGINT, 130, b"interrupted; run the same command again to continue"),
        (signal.SIGTERM, -signal.SIGTERM, b""),
    ],
)
def test_an_ended_run_is_no_crash(talk: Path, how: signal.Signals, code: int, said: bytes) -> None:
    out = talk.with_name(how.name)
    process = start(talk, out)
    while process.poll() is None and not (out / ".landmarks.partial").exists():
        time.sleep(0.005)
    process.send_signal(how)
    _, complaints = process.communicate(timeout=60)
    assert process.returncode == code
    assert said in complaints
    assert b"Traceback" not in complaints and b"Aborted" not in complaints


def test_a_second_run_makes_nothing(talk: Path, finished: Path) -> None:
    before = {
        path: path.stat().st_mtime_ns
        for path in finished.rglob("*")
        if path.name not in ("run.json", "log.txt")
    }
    process = start(talk, finished)
    _, said = process.communicate(timeout=100)
    assert process.returncode == 0
    assert said.decode().count("cached") == len(STAGES)
    after = {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path in before}
    assert {path for path in before if before[path] != after[path]} <= {finished, finished / ".lock"}


def test_animate_gives_motion_and_film(finished: Path, tmp_path: Path) -> None:
    speech = tmp_path / "speech.wav"
    command = [sys.executable, "-m", "cli.main", "animate"]
    sound, _ = read_audio(ASSETS / "demo_speech.flac")
    from personalize.sound import write_wav

    write_wav(speech, sound[: 2 * 16000])
    subprocess.run(
        [*command, str(speech), "--subject", str(finished), "--samples", "2", "--out", str(tmp_path / "out")],
        check=True,
        capture_output=True,
        timeout=200,
    )
    motions = [Motion.load(tmp_path / f"out/{index}/motion.npz") for index in range(2)]
    assert len(motions[0].valid) == 60
    assert not np.allclose(motions[0].coefficients, motions[1].coefficients)
    with av.open(str(tmp_path / "out/0/animation.mp4")) as film:
        assert film.streams.audio and film.streams.video[0].frames == 60
