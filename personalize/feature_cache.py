"""Speech features kept by content: sound that an encoder has heard once is not encoded again.

They lie in `features/` of $PERSONALIZE_CACHE, else of $XDG_CACHE_HOME/personalize, else of ~/.cache/personalize, and
take at most 1 GiB: what was not used for the longest time goes first. Deleting the folder costs time only.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from model.files import write_atomic
from model.motion import DAMAGED
from model.speech import SpeechEncoder
from personalize.files import read_npz

LIMIT_BYTES = 1 << 30
# Bumped when an encoder of the same name gives other features: it is part of every key.
VERSION = 1

Features = tuple[NDArray[np.float32], NDArray[np.float64]]


def encode_cached(encoder: SpeechEncoder, audio: NDArray[np.float32]) -> Features:
    """`encoder.encode(audio)`, from the cache where it holds it; a broken file there is made again.

    A cache that cannot be written is done without.
    """
    path = cache_folder() / f"{cache_key(encoder.name, audio)}.npz"
    kept = _read(path, encoder.width)
    if kept is not None:
        return kept
    features, times = encoder.encode(audio)
    if features.nbytes <= LIMIT_BYTES:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, lambda stream: np.savez(stream, features=features, times=times))
            _shrink(path.parent)
        except OSError:
            pass
    return features, times


def cache_folder() -> Path:
    """Where the features lie."""
    if own := os.environ.get("PERSONALIZE_CACHE"):
        return Path(own) / "features"
    caches = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(caches).expanduser() / "personalize" / "features"


def cache_key(encoder: str, audio: NDArray[np.float32]) -> str:
    """sha256 of everything that decides the features; torch's version because it decides their last bits."""
    digest = hashlib.sha256(f"{VERSION} {torch.__version__} {encoder} {audio.dtype} {audio.shape} ".encode())
    digest.update(np.ascontiguousarray(audio).tobytes())
    return digest.hexdigest()


def _read(path: Path, width: int) -> Features | None:
    """The features in a file, marked as used; None where it is missing or broken (the zip carries checksums)."""
    try:
        content = read_npz(path)
        features, times = content["features"], content["times"]
        os.utime(path)
    except (KeyError, *DAMAGED):
        return None
    return (features, times) if features.shape == (len(times), width) else None


def _shrink(folder: Path) -> None:
    """Remove what was not used for the longest time until the rest is within the limit."""
    files = sorted(((path, path.stat()) for path in folder.glob("*.npz*")), key=lambda file: file[1].st_mtime)
    excess = sum(stat.st_size for _, stat in files) - LIMIT_BYTES
    for path, stat in files:
        if excess <= 0:
            break
        path.unlink(missing_ok=True)
        excess -= stat.st_size
