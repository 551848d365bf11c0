"""What a phone wrote of its lens is read wherever phones write it, and broken metadata are as none."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from personalize.container import probe
from personalize.recorded_lens import recorded_focal_mm
from tests.personalize.video_factory import moving, write_video

FOCAL = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
MODEL = b"com.apple.quicktime.camera.lens_model"
TEXT, SIGNED, UNSIGNED, FLOAT, DOUBLE = 1, 21, 22, 23, 24


def box(kind: bytes, *content: bytes) -> bytes:
    """As ISO/IEC 14496-12 has it: the length of all, the type, the content."""
    held = b"".join(content)
    return struct.pack(">I", 8 + len(held)) + kind + held


def metadata(kind: int, value: bytes, version: bytes = b"") -> bytes:
    """A box of two keys and their values, the focal length second. version: four bytes in MP4, none in QuickTime."""
    values = {MODEL: (TEXT, b"Phone 3 back camera 5.1mm f/1.6"), FOCAL: (kind, value)}
    keys = [struct.pack(">I", 8 + len(key)) + b"mdta" + key for key in values]
    items = [
        box(struct.pack(">I", number), box(b"data", struct.pack(">II", *(kind, 0)), held))
        for number, (kind, held) in enumerate(values.values(), 1)
    ]
    handler = box(b"hdlr", bytes(8), b"mdta", bytes(13))
    return box(b"meta", version, handler, box(b"keys", struct.pack(">II", 0, 2), *keys), box(b"ilst", *items))


def inside(held: bytes, place: list[bytes], new: bytes) -> bytes:
    """The boxes `held` with one more at the end of the box at `place`, a path of types."""
    if not place:
        return held + new
    start = 0
    while start < len(held):
        size, kind = struct.unpack(">I4s", held[start : start + 8])
        if kind == place[0]:
            content = inside(held[start + 8 : start + size], place[1:], new)
            return held[:start] + box(kind, content) + held[start + size :]
        start += size
    raise AssertionError(f"no {place[0]!r} in the file")


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video whose camera wrote nothing down; its metadata come behind the pictures, so that they may grow."""
    return write_video(tmp_path_factory.mktemp("lens") / "v.mp4", moving(3), [0.0, 0.04, 0.08])


def with_metadata(film: Path, name: str, place: list[bytes], *new: bytes) -> Path:
    """A copy that holds metadata."""
    out = film.with_name(name)
    out.write_bytes(inside(film.read_bytes(), place, b"".join(new)))
    return out


@pytest.mark.parametrize("version", [b"", bytes(4)])
@pytest.mark.parametrize("place", [[b"moov", b"trak"], [b"moov"]])
@pytest.mark.parametrize(
    ("kind", "value", "mm"),
    [
        (UNSIGNED, b"\x1a", 26),
        (SIGNED, struct.pack(">i", 27), 27),
        (FLOAT, struct.pack(">f", 28.5), 28.5),
        (DOUBLE, struct.pack(">d", 77), 77),
        (TEXT, b"50.00mm", 50),
    ],
)
def test_the_focal_length_is_read(
    film: Path, kind: int, value: bytes, mm: float, place: list[bytes], version: bytes
) -> None:
    path = with_metadata(film, "wrote.mp4", place, metadata(kind, value, version))
    assert probe(path).focal_mm == pytest.approx(mm)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        *[(UNSIGNED, b"\x00"), (SIGNED, b"\xff"), (FLOAT, struct.pack(">f", float("nan"))), (FLOAT, b"\x00")],
        *[
            (UNSIGNED, b"\x05"),
            (DOUBLE, struct.pack(">d", 401)),
        ],  # of the lens itself, not as on film; a telescope's
        *[(TEXT, b"wide"), (TEXT, b""), (UNSIGNED, b"\xff" * 300), (99, b"\x1a")],
    ],
)
def test_what_is_no_focal_length_counts_as_none(film: Path, kind: int, value: bytes) -> None:
    path = with_metadata(film, "odd.mp4", [b"moov", b"trak"], metadata(kind, value))
    assert probe(path).focal_mm == 0


def test_without_metadata_there_is_none(film: Path) -> None:
    assert probe(film).focal_mm == 0
    assert probe(write_video(film.with_name("v.mkv"), moving(3), [0.0, 0.04, 0.08])).focal_mm == 0


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_broken_metadata_raise_nothing(film: Path, data: st.DataObject) -> None:
    path = with_metadata(film, "broken.mp4", [b"moov", b"trak"], metadata(UNSIGNED, b"\x1a"))
    held = bytearray(path.read_bytes())
    moov = held.rindex(b"moov")
    for place in data.draw(st.lists(st.integers(moov, len(held) - 1), min_size=1, max_size=4)):
        held[place] = data.draw(st.integers(0, 255))
    path.write_bytes(held[: data.draw(st.integers(moov, len(held)))])
    assert 0 <= recorded_focal_mm(path) <= 400


def test_what_a_broken_track_does_not_tell_the_movie_may(film: Path) -> None:
    held = metadata(UNSIGNED, b"\x1a").replace(b"ilst", b"ilst\x7f", 1)
    path = with_metadata(film, "two.mp4", [b"moov", b"trak"], held)
    path.write_bytes(inside(path.read_bytes(), [b"moov"], metadata(UNSIGNED, b"\x1c")))
    assert recorded_focal_mm(path) == 28


def test_a_file_of_nothing_but_boxes_is_soon_given_up(film: Path) -> None:
    path = with_metadata(film, "many.mp4", [b"moov"], box(b"free") * 200_000, metadata(UNSIGNED, b"\x1a"))
    assert recorded_focal_mm(path) == 0


def test_the_picture_tracks_lens_counts_before_the_movies(film: Path) -> None:
    path = with_metadata(film, "both.mp4", [b"moov", b"trak"], metadata(UNSIGNED, b"\x1a"))
    path.write_bytes(inside(path.read_bytes(), [b"moov"], metadata(UNSIGNED, b"\x1c")))
    assert recorded_focal_mm(path) == 26


def test_boxes_of_64_bits_are_read_as_others_are(film: Path) -> None:
    """Telephones write them where a film may grow beyond 4 GB."""
    held = metadata(UNSIGNED, b"\x1a")
    long = struct.pack(">I4sQ", 1, b"meta", len(held) + 8) + held[8:]
    path = with_metadata(film, "long.mp4", [b"moov", b"trak"], long)
    path.write_bytes(struct.pack(">I4sQ", 1, b"free", 24) + bytes(8) + path.read_bytes())
    assert recorded_focal_mm(path) == 26


def test_metadata_of_more_than_a_megabyte_are_not_looked_through(film: Path) -> None:
    long = metadata(UNSIGNED, b"\x1a")
    long = box(b"meta", long[8:], box(b"free", bytes(1 << 20)))
    assert recorded_focal_mm(with_metadata(film, "fat.mp4", [b"moov", b"trak"], long)) == 0
