"""The loss over the steps, for people to plot and for TensorBoard; continues where a killed training's did."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, TextIO

from model.files import write_bytes


class TrainingLog:
    """`step,loss` lines in a CSV file, rows beyond a continuation's start removed; TensorBoard beside it."""

    def __init__(self, path: Path | None, step: int, tensorboard: Path | None) -> None:
        """path: of the CSV file, None to write nothing at all. step: where training starts or goes on."""
        self._stream: TextIO | None = None
        self._writer: Any = None
        if path is None:
            return
        rows = []
        if path.exists():
            with path.open(newline="") as stream:
                rows = [row for row in csv.reader(stream) if len(row) == 2 and row[0].isdigit()]
        lines = ["step,loss", *(",".join(row) for row in rows if int(row[0]) <= step)]
        write_bytes(path, ("\n".join(lines) + "\n").encode())
        self._stream = path.open("a")
        if tensorboard is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(tensorboard), purge_step=step + 1)

    def __enter__(self) -> TrainingLog:
        return self

    def write(self, step: int, loss: float) -> None:
        """One row."""
        if self._stream is not None:
            self._stream.write(f"{step},{loss:.6g}\n")
            self._stream.flush()
        if self._writer is not None:
            self._writer.add_scalar("loss", loss, step)

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._stream.close()
        if self._writer is not None:
            self._writer.close()
