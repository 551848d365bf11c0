"""The lens that a phone writes into its video: the focal length in the metadata of the picture track.

FFmpeg gives the metadata of the whole file alone. Boxes: ISO/IEC 14496-12; keys and values: Apple, QuickTime File
Format, "Metadata". Files are untrusted: nothing but metadata is read, and little of that.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import BinaryIO

FOCAL_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
RANGE_MM = (8.0, 400.0)  # of lenses there are
MOST_BOXES, MOST_BYTES = 1000, 1 << 20  # of one box, looked through; of one track's metadata
UTF8, SIGNED, UNSIGNED, FLOAT, DOUBLE = 1, 21, 22, 23, 24  # types of values
Box = tuple[bytes, int, int]  # type, where its content begins and ends


def recorded_focal_mm(path: Path) -> float:
    """Focal length that a QuickTime or MP4 file says its camera had, mm on film 36 mm wide; 0 where it says none."""
    with path.open("rb") as file:
        whole = (b"", 0, file.seek(0, 2))
        for movie in _children(file, whole, b"moov"):
            for place in (*_children(file, movie, b"trak"), movie):
                for meta in _children(file, place, b"meta"):
                    try:
                        mm = _focal_mm(file, meta)
                    except (struct.error, ValueError):
                        continue
                    if RANGE_MM[0] <= mm <= RANGE_MM[1]:
                        return mm
    return 0.0


def _children(file: BinaryIO, box: Box, kind: bytes) -> list[Box]:
    """The boxes of one type directly inside a box, up to where it is broken: the pictures may be whole."""
    found = []
    with suppress(struct.error, ValueError):
        for child in islice(_boxes(file, *box[1:]), MOST_BOXES):
            if child[0] == kind:
                found.append(child)
    return found


def _boxes(file: BinaryIO, start: int, end: int) -> Iterator[Box]:
    """All boxes from start to end."""
    while start + 8 <= end:
        file.seek(start)
        size, kind = struct.unpack(">I4s", file.read(8))
        header = 8
        if size == 1:
            (size,), header = struct.unpack(">Q", file.read(8)), 16
        size = size or end - start  # 0: all that is left
        if size < header or start + size > end:
            raise ValueError("a box that ends before it begins, or after the one around it")
        yield kind, start + header, start + size
        start += size


def _focal_mm(file: BinaryIO, meta: Box) -> float:
    """What a metadata box tells of the focal length, mm; 0 where it does not."""
    _, start, end = meta
    if end - start > MOST_BYTES:
        return 0.0
    file.seek(start)
    held = file.read(end - start)
    # QuickTime's box begins with its content, MP4's with four bytes of version and flags.
    content = BytesIO(held if held[4:8] == b"hdlr" else held[4:])
    parts = {part[0]: part for part in _boxes(content, 0, len(content.getbuffer()))}
    if b"keys" not in parts or b"ilst" not in parts:
        return 0.0
    names = _names(content, parts[b"keys"])
    if FOCAL_KEY not in names:
        return 0.0
    number = struct.pack(">I", names.index(FOCAL_KEY) + 1)
    for item in _children(content, parts[b"ilst"], number):
        for _, first, last in _children(content, item, b"data"):
            content.seek(first)
            kind, _ = struct.unpack(">II", content.read(8))
            return _number(kind & 0xFFFFFF, content.read(last - first - 8))
    return 0.0


def _names(content: BinaryIO, keys: Box) -> list[bytes]:
    """The keys, in the order in which values number them."""
    content.seek(keys[1])
    _, count = struct.unpack(">II", content.read(8))
    names = []
    for _ in range(min(count, MOST_BOXES)):
        size, _ = struct.unpack(">I4s", content.read(8))
        names.append(content.read(size - 8))
    return names


def _number(kind: int, value: bytes) -> float:
    """A number as one of the types that cameras write; 0 if it is none."""
    if kind in (SIGNED, UNSIGNED):
        return float(int.from_bytes(value[:8], "big", signed=kind == SIGNED))
    if kind in (FLOAT, DOUBLE):
        return float(struct.unpack(">f" if kind == FLOAT else ">d", value)[0])
    found = re.fullmatch(rb"\s*(\d+(?:\.\d+)?)\s*(?:mm)?\s*", value) if kind == UTF8 else None
    return float(found[1]) if found else 0.0
