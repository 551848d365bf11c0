"""Text and JSON that are either whole or not there; arrays read; content hashes."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.files import write_bytes


def write_text(path: Path, text: str) -> None:
    """UTF-8 text, atomically; bytes of file names that are no text are written as \\xNN."""
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_json(path: Path, value: Any) -> None:
    """Indented JSON, atomically; NaN and infinity are refused, since other programs cannot read them."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an `.npz`, never unpickled."""
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def sha256_file(path: Path) -> str:
    """sha256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def sha256_json(value: Any) -> str:
    """sha256 of a JSON value with sorted keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
