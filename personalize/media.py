"""Reading video and sound at their true presentation times. Files are untrusted: local only, limited in size."""

from __future__ import annotations

import stat
import wave
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np
from numpy.typing import NDArray

from personalize.errors import UserError

AUDIO_RATE = 16_000
MAX_DURATION_S = 4 * 3600.0
MAX_SIDE_PX = 16_384
# Sound is placed anew where its times leave the running count by more than this. Containers round times to 1 ms.
GAP_S = 0.01
# A damaged picture spoils those predicted from it: up to the next key frame, or this long where keys are rare.
DAMAGE_S = 5.0

_ROTATION_FORMATS = ("_pipe", "image2", "gif", "tty")
_UNSPECIFIED_COLOUR, _BT709 = 2, 1

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]


@dataclass(frozen=True)
class MediaInfo:
    """What a file holds. Everything is JSON-able.

    width, height: px of the upright picture with square pixels. rotation_deg: counter-clockwise turn that the file
    asks for. fps: nominal rate. duration_s: as the container states it, 0 when it does not.
    video_start_s: presentation time of the first picture on the container's clock.
    audio_rate (Hz), audio_channels: 0 without sound.
    """

    path: str
    bytes: int
    container: str
    video_codec: str
    pixel_format: str
    width: int
    height: int
    rotation_deg: int
    fps: float
    duration_s: float
    video_start_s: float
    has_audio: bool
    audio_codec: str
    audio_rate: int
    audio_channels: int

    def as_json(self) -> dict[str, Any]:
        """Plain dictionary for media.json."""
        return asdict(self)


class _Source:
    """An opened container. It reads through one file handle, so that a playlist cannot open other files."""

    def __init__(self, path: Path) -> None:
        self._file = _open_file(path)
        try:
            self.container = av.open(self._file, mode="r", container_options={"protocol_whitelist": "none"})
        except (av.FFmpegError, OSError, ValueError) as error:
            self._file.close()
            raise UserError(
                f"{path}: not a video that can be read ({_reason(error)}); is it complete?"
            ) from None
        self.video = next((s for s in self.container.streams.video if not _is_cover(s)), None)
        self.audio = next(iter(self.container.streams.audio), None)

    def __enter__(self) -> _Source:
        return self

    def __exit__(self, *exc: object) -> None:
        self.container.close()
        self._file.close()


def _open_file(path: Path) -> BinaryIO:
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise UserError(f"{path}: not a file; give a video file")
        if path.stat().st_size == 0:
            raise UserError(f"{path}: the file is empty; give a complete video")
        return path.open("rb")
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; check the name") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None


def _is_cover(stream: Any) -> bool:
    """Whether a video stream is only the cover picture of a sound file."""
    return bool(stream.disposition & av.stream.Disposition.attached_pic)


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).splitlines()[0]


def probe(path: Path | str) -> MediaInfo:
    """Look at a video without decoding more than its first pictures.

    Raises UserError when there is no such file, it is not a video, has no picture stream, is a still picture, has
    no length, or is beyond the limits on size and duration.
    """
    path = Path(path)
    with _Source(path) as source:
        video, audio, name = source.video, source.audio, source.container.format.name
        if video is None:
            raise UserError(
                f"{path}: there is no picture in this file, only sound; give a video of a talking face"
            )
        _check_size(path, video.width, video.height)
        duration = _duration(source)
        if duration > MAX_DURATION_S:
            raise UserError(
                f"{path}: {duration / 3600:.1f} h long; cut it to under {MAX_DURATION_S / 3600:.0f} h"
            )
        frames = _first_frames(source, 2)
        if not frames:
            raise UserError(f"{path}: no picture in it can be decoded; record or export it again")
        if len(frames) == 1 and name.endswith(_ROTATION_FORMATS):
            raise UserError(f"{path}: a still picture; give a video of a talking face")
        if len(frames) == 1:
            raise UserError(f"{path}: only one picture long; give a video of a talking face, 30 s or more")
        turn = _Turn(frames[0])
        width, height = turn.upright_size(*_square_size(video, frames[0]))
        return MediaInfo(
            path=str(path),
            bytes=path.stat().st_size,
            container=name,
            video_codec=video.codec_context.name,
            pixel_format=frames[0].format.name,
            width=width,
            height=height,
            rotation_deg=int(frames[0].rotation),
            fps=float(video.average_rate or video.guessed_rate or 0),
            duration_s=duration,
            video_start_s=_time(frames[0], 0.0),
            has_audio=audio is not None,
            audio_codec=audio.codec_context.name if audio else "",
            audio_rate=audio.rate if audio else 0,
            audio_channels=audio.channels if audio else 0,
        )


def _duration(source: _Source) -> float:
    if source.video is not None and source.video.duration:
        return float(source.video.duration * source.video.time_base)
    return float(source.container.duration or 0) / av.time_base


def _check_size(path: Path, width: int, height: int) -> None:
    if max(width, height) > MAX_SIDE_PX:
        raise UserError(f"{path}: {width}x{height} px; scale it to at most {MAX_SIDE_PX} px a side")


def _first_frames(source: _Source, count: int) -> list[Any]:
    frames: list[Any] = []
    for frame in _decode(source.container, source.video):
        frames.append(frame)
        if len(frames) == count:
            break
    return frames


def _decode(container: Any, stream: Any) -> Iterator[Any]:
    """Frames in presentation order; packets that do not decode, or a file that breaks off, are passed over."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except (StopIteration, av.FFmpegError):
            return
        try:
            yield from packet.decode()
        except av.FFmpegError:
            continue


def _time(frame: Any, fallback: float) -> float:
    return fallback if frame.pts is None else float(frame.pts * frame.time_base)


def _square_size(stream: Any, frame: Any) -> tuple[int, int]:
    """Size as stored, width corrected for pixels that are not square."""
    aspect = float(stream.sample_aspect_ratio or 1)
    return (round(frame.width * aspect) if 0.1 < aspect < 10 else frame.width), frame.height


class _Turn:
    """Makes a decoded picture upright after the file's display matrix."""

    def __init__(self, frame: Any) -> None:
        self._matrix = np.eye(2, dtype=int)
        for side in frame.side_data:
            if side.type == av.sidedata.sidedata.Type.DISPLAYMATRIX:
                numbers = np.frombuffer(bytes(memoryview(side)), dtype="<i4")
                # Rows map stored (x, y) to displayed (x, y); only quarter turns and mirrors are taken.
                matrix = np.sign(np.round(numbers[[0, 1, 3, 4]].reshape(2, 2) / 65536)).astype(int)
                if abs(round(np.linalg.det(matrix))) == 1 and np.abs(matrix).sum() == 2:
                    self._matrix = matrix

    def upright_size(self, width: int, height: int) -> tuple[int, int]:
        return (width, height) if self._matrix[0, 0] else (height, width)

    def __call__(self, picture: U8) -> U8:
        (xx, xy), (yx, yy) = self._matrix
        if xx == 0:
            picture, xx, yy = picture.swapaxes(0, 1), yx, xy
        return np.ascontiguousarray(picture[:: int(yy), :: int(xx)])


class FrameReader(Iterator[tuple[float, U8]]):
    """Pictures of a video in order: (time s from the first picture, rgb [H, W, 3] u8 upright with square pixels).

    Times are strictly rising presentation times. After each step `damaged` says whether that picture was decoded
    from broken data (or predicted from such a picture); pictures that do not decode at all are missing.
    Every pass over a file gives the same pictures. Raises UserError like `probe`, and beyond the limits.
    """

    def __init__(self, path: Path | str, max_side: int | None = None) -> None:
        self._path = Path(path)
        self.info = probe(self._path)
        self.damaged = False
        self._max_side = max_side
        self._frames = self._read()

    def __next__(self) -> tuple[float, U8]:
        return next(self._frames)

    def _read(self) -> Iterator[tuple[float, U8]]:
        step = 1 / self.info.fps if self.info.fps else 0.04
        last, damage_end = -1.0, -1.0
        with _Source(self._path) as source:
            source.video.thread_type = "AUTO"
            turn, size = None, (0, 0)
            for frame in _decode(source.container, source.video):
                time = _time(frame, last + step + self.info.video_start_s) - self.info.video_start_s
                if time <= last:
                    continue
                if time > MAX_DURATION_S:
                    raise UserError(f"{self._path}: over {MAX_DURATION_S / 3600:.0f} h long; cut it")
                if turn is None:
                    turn, size = _Turn(frame), self._size(_square_size(source.video, frame))
                if frame.is_corrupt:
                    damage_end = time + DAMAGE_S
                elif frame.key_frame:
                    damage_end = -1.0
                self.damaged = time <= damage_end
                last = time
                yield time, turn(_to_rgb(frame, size))

    def _size(self, size: tuple[int, int]) -> tuple[int, int]:
        scale = min(1.0, self._max_side / max(size)) if self._max_side else 1.0
        return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _to_rgb(frame: Any, size: tuple[int, int]) -> U8:
    """Any pixel format to [height, width, 3] u8 at `size` (width, height), stored orientation."""
    # HD that does not name its colours is BT.709 by convention; swscale would take BT.601.
    hd = frame.colorspace == _UNSPECIFIED_COLOUR and frame.height >= 720
    rgb = frame.reformat(
        width=size[0],
        height=size[1],
        format="rgb24",
        interpolation="AREA" if frame.width > size[0] else "BICUBIC",
        src_colorspace=_BT709 if hd else None,
    )
    array: U8 = rgb.to_ndarray()
    return array


def read_frames(path: Path | str, max_side: int | None = None) -> FrameReader:
    """Pictures of a video, see FrameReader. `max_side`: shrink to at most this many px on the long side."""
    return FrameReader(path, max_side)


def read_audio(path: Path | str, rate: int = AUDIO_RATE) -> tuple[F32, float]:
    """Sound as (mono samples [S] f32 -1..1 at `rate` Hz, time s of the first sample from the first picture).

    Every packet lies at its presentation time: gaps are silence, a late start is kept. Without a sound stream, or
    with nothing in it that decodes, S is 0.
    """
    path = Path(path)
    origin = _video_start(path)
    runs: list[tuple[float, F32]] = []
    with _Source(path) as source:
        if source.audio is None:
            return np.zeros(0, np.float32), 0.0
        run, start, end = _Run(rate), 0.0, None
        for frame in _decode(source.container, source.audio):
            time = _time(frame, end if end is not None else origin)
            if end is None or abs(time - end) > GAP_S:
                _keep(runs, start, run.close())
                run, start, end = _Run(rate), time, time
            run.add(frame)
            end += frame.samples / frame.sample_rate
            if end - origin > MAX_DURATION_S:
                raise UserError(f"{path}: over {MAX_DURATION_S / 3600:.0f} h of sound; cut it")
        _keep(runs, start, run.close())
    if not runs:
        return np.zeros(0, np.float32), 0.0
    first = min(start for start, _ in runs)
    places = [round((start - first) * rate) for start, _ in runs]
    samples = np.zeros(max(place + len(part) for place, (_, part) in zip(places, runs)), np.float32)
    for place, (_, part) in zip(places, runs):
        samples[place : place + len(part)] = part
    return samples, first - origin


def _video_start(path: Path) -> float:
    """Container time of the first picture; 0 for a pure sound file."""
    with _Source(path) as source:
        frames = _first_frames(source, 1) if source.video is not None else []
        return _time(frames[0], 0.0) if frames else 0.0


def _keep(runs: list[tuple[float, F32]], start: float, part: F32) -> None:
    if len(part):
        runs.append((start, part))


class _Run:
    """Resamples one uninterrupted stretch of sound to mono."""

    def __init__(self, rate: int) -> None:
        self._resampler = av.AudioResampler(format="flt", layout="mono", rate=rate)
        self._parts: list[F32] = []

    def add(self, frame: Any) -> None:
        frame.pts = None  # placed by the caller
        self._parts += [out.to_ndarray().ravel() for out in self._resampler.resample(frame)]

    def close(self) -> F32:
        if not self._parts:
            return np.zeros(0, np.float32)
        self._parts += [out.to_ndarray().ravel() for out in self._resampler.resample(None)]
        return np.concatenate(self._parts)


def on_video_clock(samples: F32, start_s: float, duration_s: float, rate: int = AUDIO_RATE) -> F32:
    """Cut or fill with silence so that sample k lies at k / rate s after the first picture: [duration * rate] f32."""
    out = np.zeros(round(duration_s * rate), np.float32)
    place = round(start_s * rate)
    part = samples[max(0, -place) : max(0, len(out) - place)]
    out[max(0, place) : max(0, place) + len(part)] = part
    return out


def write_wav(path: Path, samples: F32, rate: int = AUDIO_RATE) -> None:
    """Write mono f32 -1..1 as 16-bit PCM; louder samples are clipped."""
    pcm = np.round(np.clip(samples, -1, 1) * 32767).astype("<i2")
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(pcm.tobytes())
