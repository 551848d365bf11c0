"""What the user hears while it works: stages, a progress bar with time left, warnings; and `log.txt`.

On a terminal a bar; elsewhere plain lines, a few per stage. Everything goes to stderr, so that stdout carries results.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

PLAIN_LINE_EVERY_S = 15.0


class Reporter:
    """Says what happens on stderr and, once a run folder is there, in its `log.txt` with times."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._console = Console(file=stream or sys.stderr, highlight=False, soft_wrap=True)
        self._log: Path | None = None
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._stage = ""
        self._stage_started = 0.0
        self._last_line = 0.0
        self._counted = (0, 0, 0.0)  # total, done and time when this count began

    def log_to(self, path: Path) -> None:
        """Append everything said from now on to `path`."""
        self._log = path

    def say(self, text: str) -> None:
        """One line for the user."""
        self._console.print(text, markup=False, emoji=False)
        self._write_log(text)

    def warn(self, text: str) -> None:
        """One line the user should act on."""
        self.say(f"warning: {text}")

    def cached(self, stage: str) -> None:
        """The stage's result is already there."""
        self.say(f"{stage:<13} cached")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Around one stage: shows its name, its progress and how long it took."""
        self._stage, self._stage_started = name, time.monotonic()
        self._last_line = self._stage_started
        self._counted = (0, 0, self._stage_started)
        self._write_log(f"{name} started")
        if self._console.is_terminal:
            columns = (
                TextColumn("{task.description:<13}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task(name, total=None)
            self._bar.start()
        try:
            yield
        except BaseException as error:
            self._write_log(f"{name} stopped: {str(error) or type(error).__name__}")
            raise
        finally:
            if self._bar is not None:
                self._bar.stop()
            self._bar = self._task = None
        self.say(f"{name:<13} {time.monotonic() - self._stage_started:.1f} s")

    def progress(self, done: int, total: int) -> None:
        """`done` of `total` steps of the running stage; another total begins another count."""
        if self._bar is not None and self._task is not None:
            if total != self._counted[0]:
                self._bar.reset(self._task)
                self._counted = (total, done, 0.0)
            self._bar.update(self._task, completed=done, total=total)
            return
        now = time.monotonic()
        if total != self._counted[0]:
            # The first steps of a stage began with it; what it continues took its time in another run.
            fresh = self._counted[0] == 0 and done <= max(1, total // 100)
            self._counted = (total, 0, self._stage_started) if fresh else (total, done, now)
        _, first, began = self._counted
        if now - self._last_line >= PLAIN_LINE_EVERY_S and first < done < total:
            self._last_line = now
            left = (now - began) / (done - first) * (total - done)
            self.say(f"{self._stage:<13} {done}/{total}, about {left:.0f} s left")

    def _write_log(self, text: str) -> None:
        if self._log is not None:
            # The name of a video may hold bytes that are no text.
            with self._log.open("a", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")
