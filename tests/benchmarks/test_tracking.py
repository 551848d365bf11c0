"""The command: one clip by name, and a name that is none."""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import tracking
from personalize.pictures import FrameReader
from tests.personalize.video_factory import moving, write_video


def test_one_clip_by_name(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(tracking, "PERSON_FRAMES", 60)
    monkeypatch.setattr(sys, "argv", ["tracking", "person1"])
    tracking.main()
    header, row, *bars = [line for line in capsys.readouterr().out.splitlines() if line]
    assert row.split()[:2] == ["person1", "landmarks"] and len(row) == len(header)
    surface, mean = (float(row.split()[2 + k]) for k in range(2))
    assert surface < mean
    assert row.split()[header.split().index("lost")] == "0.0"
    assert any(line.startswith("in model: rotation") for line in bars)
    assert any(line.startswith("frames with bare lips lost") and line.endswith("yes") for line in bars)


def test_any_stranger_may_be_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[set[str]] = []
    monkeypatch.setattr(tracking, "compile_ahead", lambda head: None)
    monkeypatch.setattr(
        tracking, "ground_truths", lambda head, chosen, *options: asked.append(chosen) or iter(())
    )
    monkeypatch.setattr(sys, "argv", ["tracking", "stranger1234"])
    tracking.main()
    assert asked == [{"stranger1234"}]


def test_films_are_enlarged_if_asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    changed: list[float] = []
    video = write_video(tmp_path / "v.mp4", moving(1) * 100, [k / 25 for k in range(100)])

    def look(video: Path, *_: object) -> None:
        first, last = (rgb.astype(int) for _, rgb in list(FrameReader(video))[::99])
        changed.append(float(np.abs(last - first).mean()))
        raise KeyboardInterrupt

    monkeypatch.setattr(tracking, "compile_ahead", lambda head: None)
    monkeypatch.setattr(tracking, "watched", look)
    for more in ([], ["--enlarged"]):
        monkeypatch.setattr(sys, "argv", ["tracking", str(video), *more])
        with pytest.raises(KeyboardInterrupt):
            tracking.main()
    assert changed[0] < 1 and changed[1] > 5


def test_unknown_clip_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["tracking", "nobody"])
    with pytest.raises(SystemExit) as stopped:
        tracking.main()
    assert stopped.value.code == 2
    assert "no clip nobody; there are person0" in capsys.readouterr().err
