"""The installed command as a user runs it: exit codes, one line for a mistake, nothing touched."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import pytest

import cli.main
from personalize.errors import UserError
from personalize.pipeline import STAGES
from personalize.subject_data import BASE_CHECKPOINT
from tests.personalize.video_factory import corner_picture, write_video


def personalize(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "cli.main", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


def assert_refused(result: subprocess.CompletedProcess[str], *words: str) -> None:
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    lines = [line for line in result.stderr.splitlines() if line.startswith("personalize: ")]
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in lines[0]


def test_version_and_help(tmp_path: Path) -> None:
    assert personalize("--version", cwd=tmp_path).stdout.startswith("personalize 0.")
    shown = personalize("--help", cwd=tmp_path)
    assert shown.returncode == 0
    assert all(command in shown.stdout for command in ("animate", "edit", "demo"))
    options = personalize("run", "--help", cwd=tmp_path).stdout
    assert "--iterations" in options
    assert ", ".join(stage.name for stage in STAGES) in " ".join(options.split())


def test_the_command_is_there_before_what_takes_seconds_to_import(tmp_path: Path) -> None:
    """So that help comes at once and an interruption meets no traceback."""
    script = (
        "import sys, cli.main; print([name for name in ('torch', 'numba', 'cv2') if name in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert shown.stdout.strip() == "[]", shown.stderr


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("missing.mp4", None, "no such file"),
        ("empty.mp4", b"", "empty"),
        ("text.mp4", b"not a video\n", "not a video"),
    ],
)
def test_what_is_no_video_is_refused_and_leaves_nothing(
    tmp_path: Path, name: str, content: bytes | None, says: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    before = sorted(tmp_path.iterdir())
    assert_refused(personalize(name, cwd=tmp_path), name, says)
    assert sorted(tmp_path.iterdir()) == before


def test_a_name_of_two_lines_gets_one(tmp_path: Path) -> None:
    result = personalize("two\nlines.mp4", cwd=tmp_path)
    assert_refused(result, "two lines.mp4", "no such file")
    assert len(result.stderr.splitlines()) == 1


def test_wrong_options_get_one_line(tmp_path: Path) -> None:
    assert_refused(personalize("run", "talk.mp4", "--iterations", "none", cwd=tmp_path), "iterations")
    assert_refused(personalize("animate", "speech.wav", "--subject", "nowhere", cwd=tmp_path), "nowhere")
    assert_refused(personalize("train", "--out", "base.safetensors", cwd=tmp_path), "--vocaset", "--motions")
    data = ("--vocaset", "nowhere", "--template-mesh", "m.ply")
    assert_refused(personalize("train", "--out", "base.safetensors", *data, cwd=tmp_path), "nowhere")
    edit = ("edit", "none.npz", "--subject", str(BASE_CHECKPOINT))
    assert_refused(personalize(*edit, cwd=tmp_path), "none.npz", "motion.npz")
    assert_refused(personalize(*edit, "--rule", "euler", cwd=tmp_path), "rule")
    assert_refused(personalize(*edit, "--remake", ",", cwd=tmp_path), "--remake ','", "no part of the face")


def test_an_encoder_a_device_a_focal_length_or_a_mode_that_is_not_there_gets_one_line_before_any_work(
    tmp_path: Path,
) -> None:
    video, speech = tmp_path / "talk.mkv", tmp_path / "speech.wav"
    write_video(video, [corner_picture()] * 10, [0.04 * n for n in range(10)])
    speech.touch()
    assert_refused(personalize("run", video, "--encoder", "nowhere", cwd=tmp_path), "nowhere")
    assert_refused(personalize("run", video, "--device", "abacus", cwd=tmp_path), "abacus", "cpu")
    assert_refused(personalize("run", video, "--distortion", "-0.2", cwd=tmp_path), "--distortion", "--focal")
    assert_refused(personalize("run", video, "--distortion", "-0.2,much", cwd=tmp_path), "-0.2,much")
    assert_refused(personalize("run", video, "--focal", "inf", cwd=tmp_path), "--focal inf", "96x64 px")
    folding = ("--distortion=-5", "--focal", "100")
    assert_refused(personalize("run", video, *folding, cwd=tmp_path), "--distortion -5", "folds")
    assert_refused(personalize("run", video, "--seed", "-1", cwd=tmp_path), "--seed")
    others = ("--tracked", tmp_path, "--focal", "100")
    assert_refused(personalize("run", video, *others, cwd=tmp_path), "--focal", "--tracked")
    assert_refused(personalize("run", video, "--overlay", "shaded,wire", cwd=tmp_path), "wire:", "wireframe")
    assert_refused(
        personalize("run", video, "--until", "lunch", cwd=tmp_path), "--until lunch", "registration"
    )
    subject = ("--subject", BASE_CHECKPOINT)
    assert_refused(personalize("animate", speech, *subject, "--encoder", "nowhere", cwd=tmp_path), "nowhere")
    assert sorted(tmp_path.iterdir()) == [speech, video]


@pytest.mark.parametrize(
    ("error", "asked", "to_do"),
    [
        (AttributeError("no _multiarray_umath"), ["talk.mp4"], " to continue"),
        (UserError("wav2vec2 cannot be read"), ["animate", "speech.wav"], ": it begins anew"),
    ],
)
def test_an_interruption_that_a_module_makes_another_error_of_is_one(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: Exception,
    asked: list[str],
    to_do: str,
) -> None:
    def importing(*_: object, **__: object) -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        except KeyboardInterrupt:
            raise error from None

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(cli.main, "app", importing)
    monkeypatch.setattr(sys, "argv", ["personalize", *asked])
    try:
        with pytest.raises(SystemExit) as stopped:
            cli.main.main()
    finally:
        signal.signal(signal.SIGINT, before)
    assert stopped.value.code == 130
    assert capsys.readouterr().err == f"personalize: interrupted; run the same command again{to_do}\n"


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), 2, "no space is left"),
        (PermissionError(errno.EACCES, "Permission denied", "out/run.json"), 2, "out/run.json: cannot be"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "talk.personalize"), 2, "File name too long"),
        (OSError(errno.EIO, "Input/output error"), 1, "this is a bug"),
    ],
)
def test_a_full_disk_and_a_closed_place_are_no_bugs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: OSError, code: int, said: str
) -> None:
    monkeypatch.setattr(cli.main, "app", Mock(side_effect=error))
    monkeypatch.setattr(sys, "argv", ["personalize", "talk.mp4"])
    with pytest.raises(SystemExit) as stopped:
        cli.main.main()
    assert stopped.value.code == code
    lines = capsys.readouterr().err.splitlines()
    assert said in lines[-1] and (len(lines) == 1) == (code == 2)
