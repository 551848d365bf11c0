"""Arrays from a `.npz` that somebody else made: never unpickled, and no more unpacked than a head may need."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.motion import DAMAGED
from personalize.errors import UserError

LARGEST_ARRAYS_BYTES = 2 << 30


def read_user_npz(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """The named arrays. Raises UserError, in one line, for a missing or damaged file, and for a name it lacks."""
    if not path.is_file():
        raise UserError(f"there is no file {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > LARGEST_ARRAYS_BYTES:
                raise UserError(
                    f"{path} unpacks to more than {LARGEST_ARRAYS_BYTES >> 30} GB; is it another file?"
                )
        with np.load(path, allow_pickle=False) as file:
            missing = [name for name in names if name not in file.files]
            if missing:
                raise UserError(f"{path} lacks {', '.join(missing)}; is it another file?")
            return {name: file[name] for name in names}
    except DAMAGED as error:
        reason = " ".join(str(error).split())[:120]
        raise UserError(
            f"{path} is not a readable .npz of plain arrays ({reason}); get the file again"
        ) from error
