"""Files are whole or not there."""

from pathlib import Path
from typing import IO

import pytest

from model.files import write_atomic, write_bytes


def fail(stream: IO[bytes]) -> None:
    stream.write(b"half of it")
    raise OSError("no space left")


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no space"):
        write_atomic(tmp_path / "new.bin", fail)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "old.bin"
    write_bytes(path, b"old")
    with pytest.raises(OSError, match="no space"):
        write_atomic(path, fail)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new"
