"""Pictures and sound come at their true times, upright, and files that are no video are refused in one line."""

from __future__ import annotations

import gc
import struct
import threading
import time
from collections.abc import Generator
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
from av.sidedata.sidedata import Type as SideData

from personalize.container import Source, _duration, _prominence, _quantizer, display_matrix, probe, quantizer
from personalize.errors import UserError
from personalize.pictures import FrameReader, _ahead, _in_time, _turned
from personalize.sound import on_video_clock, read_audio, write_wav
from personalize.video_writer import VideoWriter
from tests.personalize.video_factory import RATE, clicks, corner_picture, moving, write_sounds, write_video

STEADY = [i / 25 for i in range(25)]


def click_times(samples: np.ndarray, start: float, rate: int = 16_000) -> list[float]:
    """Times at which the sound becomes loud after 50 ms of quiet."""
    loud = np.flatnonzero(np.abs(samples) > 0.3)
    first = loud[np.diff(loud, prepend=-rate) > rate // 20]
    return [start + int(i) / rate for i in first]


def test_variable_rate_keeps_presentation_times(tmp_path: Path) -> None:
    times = [0.0, 0.04, 0.12, 0.3, 0.34, 1.0]
    path = write_video(tmp_path / "v.mkv", moving(6), [t + 2.0 for t in times])
    assert [t for t, _ in FrameReader(path)] == pytest.approx(times, abs=1e-3)
    assert probe(path).video_start_s == pytest.approx(2.0, abs=2e-3)


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_rotation_metadata_is_applied(tmp_path: Path, rotation: int) -> None:
    upright = corner_picture()
    stored = np.ascontiguousarray(np.rot90(upright, -rotation // 90))
    path = write_video(tmp_path / "v.mp4", [stored] * 3, STEADY[:3], rotation=rotation)
    info = probe(path)
    assert (info.width, info.height) == (96, 64)
    _, picture = next(FrameReader(path))
    assert np.abs(picture.astype(int) - upright)[4:-4, 4:-4].mean() < 8


class Unknown:
    """A picture of a film beside which FFmpeg finds what PyAV has no name for."""

    def __init__(self, frame: av.VideoFrame) -> None:
        self._frame = frame

    @property
    def side_data(self) -> list[object]:
        raise ValueError("31 is not a valid Type")

    def __getattr__(self, name: str) -> object:
        return getattr(self._frame, name)


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_pictures_are_turned_where_something_unknown_lies_beside_them(tmp_path: Path, rotation: int) -> None:
    path = write_video(tmp_path / "v.mp4", moving(1), STEADY[:1], rotation=rotation)
    with Source(path) as source:
        frame = next(source.decode(source.video))
    np.testing.assert_array_equal(display_matrix(Unknown(frame)), display_matrix(frame))
    assert _quantizer(Unknown(frame)) is None


def test_a_title_in_old_letters_makes_no_film_unreadable(tmp_path: Path) -> None:
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w", metadata_encoding="latin-1") as out:
        out.metadata["title"] = "Caf\xe9"
        stream = out.add_stream("mpeg4", rate=25)
        stream.width, stream.height = 96, 64
        for picture in moving(3):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        out.mux(stream.encode(None))
    assert b"Caf\xe9" in path.read_bytes()
    assert len(list(FrameReader(path))) == 3


def test_of_recordings_joined_byte_by_byte_the_first_is_read(tmp_path: Path) -> None:
    """The second one's streams bear other numbers; FFmpeg finds them when it comes to them."""
    content = b""
    for seed, number in enumerate((256, 512)):
        path = tmp_path / f"{number}.ts"
        numbers = {"mpegts_start_pid": str(number), "mpegts_pmt_start_pid": str(number + 200)}
        with av.open(str(path), "w", options=numbers) as out:
            stream = out.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
            for picture in moving(25, seed):
                out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            out.mux(stream.encode(None))
        content += path.read_bytes()
    joined = tmp_path / "joined.ts"
    joined.write_bytes(content)
    assert len(list(FrameReader(joined))) == 25


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_every_quarter_turn_and_mirror(swapped: bool, signs: tuple[int, int]) -> None:
    """Each pixel (x, y) goes to (x, y) @ matrix, counted from the left top of what comes out."""
    stored = np.random.default_rng(0).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    matrix = np.diag(signs)[::-1] if swapped else np.diag(signs)
    y, x = np.mgrid[:5, :7].reshape(2, -1)
    place = np.column_stack([x, y]) @ matrix
    place -= place.min(0)
    expected = np.zeros((*place.max(0)[::-1] + 1, 3), np.uint8)
    expected[place[:, 1], place[:, 0]] = stored[y, x]
    np.testing.assert_array_equal(_turned(stored, matrix), expected)


def test_a_reader_that_is_left_early_leaves_no_thread_behind(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", moving(25), STEADY)

    def is_alone() -> bool:
        # A picture that is being decoded holds its reader until it is done.
        for _ in range(100):
            gc.collect()
            if not any("ThreadPool" in thread.name for thread in threading.enumerate()):
                return True
            time.sleep(0.05)
        return False

    assert is_alone()
    reader = FrameReader(path)
    assert next(reader)[0] == 0 and any("ThreadPool" in t.name for t in threading.enumerate())
    del reader
    assert is_alone()
    assert len(list(FrameReader(path))) == 25 and is_alone()


def test_a_reader_that_is_left_is_not_waited_for() -> None:
    """The garbage collector may end it inside a thread that begins, whose lock its own thread needs to end."""
    go, done = threading.Event(), list[int]()

    def items() -> Generator[int]:
        yield 0
        go.wait(10)
        done.append(1)
        yield 1

    reader = _ahead(items())
    assert next(reader) == 0
    reader.close()
    assert not done
    go.set()


def test_pixels_that_are_not_square_are_made_so(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mkv", moving(3), STEADY[:3], aspect=Fraction(4, 3))
    assert (probe(path).width, probe(path).height) == (128, 64)
    assert next(FrameReader(path))[1].shape == (64, 128, 3)


def test_ten_bits_and_smaller_pictures(tmp_path: Path) -> None:
    picture = corner_picture()
    path = write_video(tmp_path / "v.mkv", [picture] * 3, STEADY[:3], pixels="yuv420p10le")
    _, read = next(FrameReader(path))
    assert read.dtype == np.uint8 and np.abs(read.astype(int) - picture)[4:-4, 4:-4].mean() < 8
    assert next(FrameReader(path, max_side=48))[1].shape == (32, 48, 3)


def test_late_sound_and_gaps_keep_their_times(tmp_path: Path) -> None:
    sound = clicks([0.1, 0.5, 1.5], 2.0)
    path = write_video(tmp_path / "v.mkv", moving(25), STEADY, sound, sound_start=0.4, sound_gap=(1.0, 1.6))
    samples, start = read_audio(path)
    assert start == pytest.approx(0.4, abs=2e-3)
    assert click_times(samples, start) == pytest.approx([0.5, 0.9, 1.9], abs=3e-3)
    clocked = on_video_clock(samples, start, 3.0)
    assert len(clocked) == 48_000 and click_times(clocked, 0.0) == pytest.approx([0.5, 0.9, 1.9], abs=3e-3)


def test_sound_that_begins_before_the_picture_is_cut_on_its_clock() -> None:
    assert list(on_video_clock(np.arange(6, dtype=np.float32), -0.5, 2.0, rate=4)) == [2, 3, 4, 5, 0, 0, 0, 0]


def test_recordings_joined_as_files_are_refused(tmp_path: Path) -> None:
    """Their clock begins anew: the pictures of the one would be paired with the sound of the other."""
    times = [i / 25 for i in range(60)]
    parts = [write_video(tmp_path / f"{seed}.ts", moving(60, seed), times).read_bytes() for seed in range(2)]
    joined = tmp_path / "joined.ts"
    joined.write_bytes(b"".join(parts))
    with pytest.raises(UserError, match=r"joined\.ts: its clock is set back after 2\.4 s"):
        list(FrameReader(joined))


@pytest.mark.parametrize("stamps", ["ahead", "equal", "early"])
def test_broken_time_stamps_cost_their_pictures_and_no_more(tmp_path: Path, stamps: str) -> None:
    times = [i / 25 for i in range(300)]
    if stamps == "ahead":  # one, by 4 s
        times[100] += 4
        left = 200
    elif stamps == "equal":
        times[8::8] = times[7::8][: len(times[8::8])]
        left = 300 - len(times[8::8])
    else:
        times[6::6] = [time - 0.05 for time in times[6::6]]
        left = 300 - len(times[6::6])
    # As they are: no encoder would write such times.
    frames = [SimpleNamespace(pts=round(t * 1000), time_base=Fraction(1, 1000)) for t in times]
    assert len(list(_in_time(frames, 0.0, 0.04, tmp_path))) == left


def test_pictures_stored_in_another_order_keep_their_times_in_avi(tmp_path: Path) -> None:
    """It knows the order alone in which they are stored."""
    path = write_video(tmp_path / "v.avi", moving(60), [i / 25 for i in range(60)], options={"bf": "3"})
    read = list(FrameReader(path))
    assert [t for t, _ in read] == pytest.approx([i / 25 for i in range(60)], abs=2e-3)
    assert [int(np.argmin([np.abs(p.astype(int) - q).mean() for q in moving(60)])) for _, p in read] == [
        *range(60)
    ]


def _joined(folder: Path, size: tuple[int, int]) -> Path:
    """A second of pictures of 96 x 64 px, and one of those of another size (width, height)."""
    parts = [
        write_video(folder / f"{start}.ts", [corner_picture(*shape)] * 25, [start + t for t in STEADY])
        for start, shape in enumerate([(96, 64), size])
    ]
    path = folder / "joined.ts"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    return path


def test_pictures_that_change_their_shape_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"shape changes at 1\.0 s, from 96x64 to 64x96 px"):
        list(FrameReader(_joined(tmp_path, (64, 96))))


def test_pictures_that_change_their_size_are_told(tmp_path: Path) -> None:
    reader = FrameReader(_joined(tmp_path, (192, 128)))
    assert {picture.shape for _, picture in reader} == {(64, 96, 3)}
    assert reader.resized_s == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("flags", "woven"), [("", 0), ("+ildct+ilme", 25)])
def test_interlaced_pictures_are_counted(tmp_path: Path, flags: str, woven: int) -> None:
    reader = FrameReader(
        write_video(tmp_path / "v.mkv", moving(25), STEADY, options={"flags": flags} if flags else {})
    )
    assert len(list(reader)) == 25 and reader.interlaced == woven and np.isnan(reader.resized_s)


@pytest.mark.parametrize(
    ("pixels", "told", "steps"),
    # Of ten bits x264 counts from -12: the file comes out as large as that of eight at 40.
    [("yuv420p", 20, 20), ("yuv420p", 40, 40), ("yuv420p10le", 52, 40)],
)
def test_how_coarsely_a_film_is_coded_is_known(tmp_path: Path, pixels: str, told: int, steps: int) -> None:
    rng = np.random.default_rng(0)  # noise, so that no block is left out
    pictures = [rng.integers(0, 255, (64, 96, 3), np.uint8) for _ in range(25)]
    constant = {"x264-params": f"qp={told}:ipratio=1:bframes=0:aq-mode=0"}
    path = write_video(tmp_path / "v.mp4", pictures, STEADY, pixels=pixels, options=constant)
    assert quantizer(path) == pytest.approx(steps, abs=0.5)


def test_a_pictures_quantizer_is_the_mean_of_its_blocks() -> None:
    class Side(bytes):
        type = SideData.VIDEO_ENC_PARAMS

    head = struct.pack("<IxxxxQQii", 3, 64, 20, 1, 30).ljust(64, b"\0")
    blocks = b"".join(struct.pack("<5i", 16 * k, 0, 16, 16, beyond) for k, beyond in enumerate((-2, 1, 10)))
    eight_bits = SimpleNamespace(components=[SimpleNamespace(bits=8)])
    assert _quantizer(SimpleNamespace(side_data=[Side(head + blocks)], format=eight_bits)) == 33
    assert _quantizer(SimpleNamespace(side_data=[], format=eight_bits)) is None


@pytest.mark.parametrize("codec", ["mpeg4", "libvpx-vp9"])
def test_other_codecs_do_not_tell_how_coarsely_they_code(tmp_path: Path, codec: str) -> None:
    assert np.isnan(quantizer(write_video(tmp_path / "v.mp4", moving(5), STEADY[:5], codec=codec)))


@pytest.mark.parametrize("colours", [8, 14])
def test_colours_that_cannot_be_read_are_named(tmp_path: Path, colours: int) -> None:
    path = write_video(tmp_path / "v.mp4", moving(3), STEADY[:3], colours=colours)
    with pytest.raises(UserError, match=r"its colours are (YCgCo|ICtCp)"):
        list(FrameReader(path))


def test_video_without_sound_gives_none(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", moving(5), STEADY[:5])
    assert not probe(path).has_audio and len(read_audio(path)[0]) == 0


def _with_two_sounds(path: Path, unknown: int) -> Path:
    """Twice the same sound, of which `unknown`, counted from 0, is of a format that nobody knows."""
    source = write_video(path.with_name("one.mov"), moving(25), STEADY, clicks([0.5], 1.0))
    with av.open(str(source)) as whole, av.open(str(path), "w") as out:
        streams = [out.add_stream_from_template(whole.streams[index]) for index in (0, 1, 1)]
        for packet in whole.demux():
            if packet.dts is None:
                continue
            if packet.stream.type == "audio":
                again = av.Packet(bytes(packet))
                again.pts, again.dts, again.time_base = packet.pts, packet.dts, packet.time_base
                again.stream = streams[2]
                out.mux(again)
            packet.stream = streams[packet.stream.index]
            out.mux(packet)
    before, *entries = path.read_bytes().split(b"sowt")
    assert len(entries) == 2
    names = [b"what" if index == unknown else b"sowt" for index in range(2)]
    path.write_bytes(before + names[0] + entries[0] + names[1] + entries[1])
    return path


@pytest.mark.parametrize("unknown", [0, 1])
def test_sound_of_an_unknown_format_beside_a_known_one(tmp_path: Path, unknown: int) -> None:
    """Telephones write sound of all directions beside what everybody can read."""
    path = _with_two_sounds(tmp_path / "v.mov", unknown)
    assert probe(path).has_audio and probe(path).audio_codec == "pcm_s16le"
    assert click_times(*read_audio(path)) == pytest.approx([0.5], abs=3e-3)


def test_channels_are_neither_added_nor_cancelled(tmp_path: Path) -> None:
    tone = clicks([0.2, 0.7], 1.0)
    peak = float(np.abs(read_audio(write_sounds(tmp_path / "mono.mkv", [tone[None]]))[0]).max())
    for name, channels in {"same": [tone, tone], "opposite": [tone, -tone], "one": [0 * tone, tone]}.items():
        samples, start = read_audio(write_sounds(tmp_path / f"{name}.mkv", [np.stack(channels)]))
        assert np.abs(samples).max() == pytest.approx(peak / 2 if name == "one" else peak, rel=0.1)
        assert click_times(samples / np.abs(samples).max(), start) == pytest.approx([0.2, 0.7], abs=0.01)


def test_of_several_sounds_the_loudest_is_taken(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(0, 1e-3, RATE).astype(np.float32)
    path = write_sounds(tmp_path / "two.mkv", [noise[None], clicks([0.5], 1.0)[None]])
    assert click_times(*read_audio(path)) == pytest.approx([0.5], abs=0.01)


def test_sound_whose_rate_and_channels_change(tmp_path: Path) -> None:
    tone = clicks([0.5], 1.0)
    first = write_sounds(tmp_path / "a.ts", [tone[None]])
    second = write_sounds(
        tmp_path / "b.ts", [np.stack([tone, tone])[:, : RATE * 2 // 3]], rate=32_000, start=1.0
    )
    (tmp_path / "joined.ts").write_bytes(first.read_bytes() + second.read_bytes())
    samples, start = read_audio(tmp_path / "joined.ts")
    assert len(click_times(samples, start)) == 2


def test_sound_of_an_unknown_format_alone_is_none(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mov", moving(25), STEADY, clicks([0.5], 1.0))
    path.write_bytes(path.read_bytes().replace(b"sowt", b"what"))
    assert not probe(path).has_audio and len(read_audio(path)[0]) == 0


def test_samples_that_are_no_numbers_are_silent(tmp_path: Path) -> None:
    """Of a WAV of floats, as editors export it."""
    samples = np.full(1600, 0.5, "<f4")
    samples[[100, 200, 300]] = np.nan, np.inf, -np.inf
    kind = struct.pack("<HHIIHH", 3, 1, 16_000, 64_000, 4, 32)
    chunks = b"WAVEfmt " + struct.pack("<I", len(kind)) + kind + b"data" + struct.pack("<I", samples.nbytes)
    path = tmp_path / "floats.wav"
    path.write_bytes(b"RIFF" + struct.pack("<I", len(chunks) + samples.nbytes) + chunks + samples.tobytes())
    for rate in (16_000, 48_000):
        read, _ = read_audio(path, rate)
        assert np.isfinite(read).all() and (read == 0).any()
        assert np.median(read) == pytest.approx(0.5, abs=1e-3)


def test_wav_keeps_its_samples(tmp_path: Path) -> None:
    samples = np.linspace(-1, 1, 1000, dtype=np.float32)
    write_wav(tmp_path / "a.wav", samples)
    read, start = read_audio(tmp_path / "a.wav")
    assert start == 0 and np.abs(read - samples).max() < 1e-4


@pytest.mark.parametrize("rate", [8_000, 44_100, 48_000])
def test_a_moment_of_sound_is_not_lost(tmp_path: Path, rate: int) -> None:
    """Shorter than what a resampler waits for."""
    write_wav(tmp_path / "a.wav", np.full(rate // 250, 0.5, np.float32), rate)
    read, _ = read_audio(tmp_path / "a.wav", 48_000)
    assert len(read) == pytest.approx(192, abs=2) and read.max() > 0.3


def test_damaged_pictures_are_named_until_the_next_key(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (64, 96, 3), dtype=np.uint8) for _ in range(40)]
    path = write_video(tmp_path / "v.mkv", pictures, [i / 25 for i in range(40)], keys=10)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = rng.integers(0, 255, 3000, dtype=np.uint8).tobytes()
    path.write_bytes(data)
    reader = FrameReader(path)
    damaged = [reader.damaged for _ in reader]
    assert len(damaged) >= 20 and not damaged[0]
    assert any(damaged) or len(damaged) < 40
    assert not damaged[-1]


def test_pictures_predicted_from_one_that_does_not_decode_are_damaged(tmp_path: Path) -> None:
    pictures = [np.full((64, 96, 3), 4 * i, np.uint8) for i in range(40)]
    path = write_video(tmp_path / "v.mp4", pictures, [i / 25 for i in range(40)], keys=10)
    with av.open(str(path)) as whole:
        packets = [packet for packet in whole.demux(video=0) if packet.size]
        at = next(packet.pos for packet in packets if round(25 * packet.pts * packet.time_base) == 13)
    data = bytearray(path.read_bytes())
    data[at : at + 4] = b"\xff\xff\xff\xff"  # longer than the file
    path.write_bytes(data)
    reader = FrameReader(path)
    seen = {round(25 * time): reader.damaged for time, _ in reader}
    damaged = {index for index, is_damaged in seen.items() if is_damaged}
    assert 13 not in seen
    # Those shortly before may be predicted from it as well.
    assert set(range(14, 20)) <= damaged <= set(range(11, 20))


@pytest.mark.parametrize(
    ("step_s", "keys", "damaged"),
    [(0.04, (0, 20), range(10, 20)), (1.0, (0, 20), range(10, 16)), (1.0, (0, 12), range(10, 12))],
)
def test_damage_lasts_until_the_next_key_and_five_seconds_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_s: float, keys: tuple[int, ...], damaged: range
) -> None:
    path = write_video(tmp_path / "v.mkv", moving(3), STEADY[:3])
    frames = [
        SimpleNamespace(
            width=96,
            height=64,
            side_data=[],
            rotation=0,
            interlaced_frame=False,
            is_corrupt=n == 10,
            key_frame=n in keys,
        )
        for n in range(30)
    ]
    monkeypatch.setattr(
        "personalize.pictures._in_time", lambda *_: ((step_s * n, f) for n, f in enumerate(frames))
    )
    monkeypatch.setattr(FrameReader, "_to_rgb", lambda *_: corner_picture())
    reader = FrameReader(path)
    assert [n for n, _ in enumerate(reader) if reader.damaged] == list(damaged)


def test_a_film_beyond_the_limit_is_refused_whatever_its_container_says(tmp_path: Path) -> None:
    frames = [SimpleNamespace(pts=pts, time_base=Fraction(1)) for pts in (0, 1, 4 * 3600 + 1)]
    with pytest.raises(UserError, match="over 4 h long"):
        list(_in_time(frames, 0.0, 0.04, tmp_path))
    long = SimpleNamespace(duration=4 * 3600 + 1, time_base=Fraction(1))
    with pytest.raises(UserError, match=r"4\.0 h long; cut it to under 4 h"):
        _duration(tmp_path, SimpleNamespace(video=long))


def test_pictures_that_are_far_too_large_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "v.mkv", moving(2), STEADY[:2])
    monkeypatch.setattr("personalize.container.MAX_SIDE_PX", 95)
    with pytest.raises(UserError, match="96x64 px; scale it to at most 95 px a side"):
        probe(path)


def test_of_several_pictures_the_one_that_players_show_is_taken_or_the_largest() -> None:
    none, shown = av.stream.Disposition(0), av.stream.Disposition.default
    streams = [
        SimpleNamespace(disposition=flag, width=width, height=64)
        for flag, width in ((none, 96), (none, 200), (shown, 32), (shown, 48))
    ]
    assert max(streams, key=_prominence) is streams[3]
    assert max(streams[:2], key=_prominence) is streams[1]


def test_smaller_pictures_are_averaged_and_not_sampled(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 96, 1), dtype=np.uint8).repeat(3, 2)
    path = write_video(tmp_path / "v.mkv", [noise] * 2, STEADY[:2])
    _, small = next(FrameReader(path, max_side=24))
    blocks = noise[..., 0].reshape(16, 4, 24, 4).mean((1, 3))
    assert np.abs(small[..., 0] - blocks).mean() < 5


@pytest.mark.parametrize(("height", "red"), [(720, 63), (704, 81)])
def test_colours_that_are_not_named_are_those_of_hd_where_it_is_hd(
    tmp_path: Path, height: int, red: int
) -> None:
    """Pure red, as BT.709 and BT.601 store it: Y of 63 or 81, and blue and red beside it."""
    blue = {63: 102, 81: 90}[red]
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=25, options={"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = 32, height, "yuv420p"
        for index in range(2):
            frame = av.VideoFrame(32, height, "yuv420p")
            for plane, level in zip(frame.planes, (red, blue, 240)):
                plane.update(bytes([level]) * plane.buffer_size)
            frame.pts, frame.time_base = index, Fraction(1, 25)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    _, picture = next(FrameReader(path))
    np.testing.assert_allclose(picture[height // 2, 16], [255, 0, 0], atol=4)


def _still(path: Path) -> Path:
    with av.open(str(path), "w", format="image2") as out:
        stream = out.add_stream("png", rate=1)
        stream.height, stream.width, stream.pix_fmt = 64, 96, "rgb24"
        out.mux(stream.encode(av.VideoFrame.from_ndarray(corner_picture(), format="rgb24")))
        out.mux(stream.encode(None))
    return path


def _text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_what_is_no_video_is_refused_in_one_line(tmp_path: Path) -> None:
    write_wav(tmp_path / "sound.wav", clicks([0.1], 1.0), RATE)
    whole = write_video(tmp_path / "whole.mp4", moving(25), STEADY)
    (tmp_path / "cut.mp4").write_bytes(whole.read_bytes()[:600])
    (tmp_path / "unknown.mp4").write_bytes(
        whole.read_bytes().replace(b"avc1", b"what").replace(b"avcC", b"whaC")
    )
    playlist = f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{whole}\n#EXT-X-ENDLIST\n"
    cases = {
        tmp_path / "missing.mp4": "no such file",
        tmp_path: "not a file",
        _text(tmp_path / "empty.mp4", ""): "empty",
        _text(tmp_path / "text.mp4", "not a video"): "not a video",
        _text(tmp_path / "list.m3u8", playlist): "not a video",
        tmp_path / "cut.mp4": "not a video",
        tmp_path / "sound.wav": "no picture in it",
        tmp_path / "unknown.mp4": "no picture in it",
        _still(tmp_path / "still.png"): "still picture",
        write_video(tmp_path / "one.mp4", moving(1), [0.0]): "only one picture",
    }
    for path, words in cases.items():
        with pytest.raises(UserError, match=words) as caught:
            probe(path)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_what_is_no_sound_is_refused_as_such(tmp_path: Path) -> None:
    for path, says in {
        tmp_path: "not a file; give a sound or video file",
        _text(tmp_path / "empty.wav", ""): "the file is empty; give a complete sound or video",
        _text(tmp_path / "text.wav", "not a sound"): "not a sound or video that can be read",
    }.items():
        with pytest.raises(UserError, match=says) as caught:
            read_audio(path)
        assert "\n" not in str(caught.value)


def test_written_video_reads_back_with_its_sound(tmp_path: Path) -> None:
    path = tmp_path / "out ü.mp4"
    pictures = [p[:63, :95] for p in moving(30)]
    with VideoWriter(path, 30, (95, 63), audio=clicks([0.5], 1.0), audio_rate=RATE) as writer:
        for i, picture in enumerate(pictures):
            writer.write(picture, i / 30)
    read = list(FrameReader(path))
    assert [t for t, _ in read] == pytest.approx([i / 30 for i in range(30)], abs=1e-3)
    assert read[0][1].shape == (64, 96, 3)
    assert np.abs(read[7][1][:63, :95].astype(int) - pictures[7]).mean() < 10
    assert probe(path).pixel_format == "yuv420p" and probe(path).audio_codec == "aac"
    assert click_times(*read_audio(path))[0] == pytest.approx(0.5, abs=0.01)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_a_film_that_cannot_be_written_says_which(tmp_path: Path) -> None:
    with pytest.raises(OSError) as caught:
        VideoWriter(tmp_path / "nowhere/out.mp4", 25, (96, 64))
    assert str(caught.value.filename) == str(tmp_path / "nowhere/.out.mp4.partial")


def test_a_film_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    path.write_bytes(b"earlier")
    with pytest.raises(RuntimeError), VideoWriter(path, 25, (96, 64)) as writer:
        writer.write(corner_picture())
        raise RuntimeError
    assert path.read_bytes() == b"earlier" and list(tmp_path.iterdir()) == [path]


def test_pictures_nearer_than_the_clock_tells_apart_are_written_all_the_same(tmp_path: Path) -> None:
    times = (0.0, 0.04, 0.040002, 0.08)
    with VideoWriter(tmp_path / "out.mp4", 25, (96, 64)) as writer:
        for time in times:
            writer.write(corner_picture(), time)
    assert [t for t, _ in FrameReader(tmp_path / "out.mp4")] == pytest.approx(times, abs=1e-4)
