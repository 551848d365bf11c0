"""Time left in plain lines: of a stage from its start, of what it continues, and of a second count in it."""

import io
import os
from pathlib import Path

import pytest

from personalize import reporter
from personalize.errors import UserError
from personalize.files import write_text
from personalize.reporter import Reporter


class Clock:
    """Stands for the time module: a second passes only when told."""

    now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def strftime(self, _: str) -> str:
        return "then"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(reporter, "time", clock)
    return clock


def lines(clock: Clock, steps: list[tuple[float, int, int]]) -> list[str]:
    stream = io.StringIO()
    report = Reporter(stream)
    with report.stage("work"):
        for after, done, total in steps:
            clock.now += after
            report.progress(done, total)
    return [line.split(", ")[1] for line in stream.getvalue().splitlines() if "left" in line]


def test_from_the_start(clock: Clock) -> None:
    assert lines(clock, [(1, 1, 400), (19, 100, 400)]) == ["about 60 s left"]


def test_what_was_done_before_took_no_time(clock: Clock) -> None:
    assert lines(clock, [(2, 300, 400), (20, 350, 400)]) == ["about 20 s left"]


def test_another_total_begins_another_count(clock: Clock) -> None:
    steps = [(1, 1, 100), (500, 100, 100), (10, 1, 11), (20, 3, 11)]
    assert lines(clock, steps) == ["about 80 s left"]


def test_the_log_says_why_a_stage_stopped(tmp_path: Path) -> None:
    reporter = Reporter(io.StringIO())
    reporter.log_to(tmp_path / "log.txt")
    for error, said in ((UserError("too dark"), "too dark"), (KeyboardInterrupt(), "KeyboardInterrupt")):
        with pytest.raises(type(error)), reporter.stage("ingest"):
            raise error
        assert (tmp_path / "log.txt").read_text().splitlines()[-1].endswith(f"ingest stopped: {said}")


def test_names_that_are_no_text_are_written_all_the_same(tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9.mp4")
    reporter = Reporter(io.StringIO())
    reporter.log_to(tmp_path / "log.txt")
    reporter.say(name)
    write_text(tmp_path / "report.html", name)
    for file in tmp_path.iterdir():
        assert "caf" in file.read_text(encoding="utf-8")


def test_a_name_is_said_as_it_is_written() -> None:
    stream = io.StringIO()
    Reporter(stream).say("talk :car: [red].mp4")
    assert stream.getvalue() == "talk :car: [red].mp4\n"
