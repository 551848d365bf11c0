"""Opening a video or sound file. Files are untrusted: local only, limited in size and duration."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np
from av.sidedata.sidedata import Type as SideData
from numpy.typing import NDArray

from personalize.errors import UserError
from personalize.recorded_lens import recorded_focal_mm

MAX_DURATION_S = 4 * 3600.0
MATROSKA = "matroska,webm"
MAX_SIDE_PX = 16_384
# FFmpeg's AVVideoEncParams: how many blocks from where, of what size, and the steps that theirs, which stand behind
# place and size of each, are beyond.
_CODED_BLOCKS = np.dtype(
    {
        "names": ["count", "at", "size", "steps"],
        "formats": ["<u4", "<u8", "<u8", "<i4"],
        "offsets": [0, 8, 16, 28],
    }
)
QUANTIZER_FRAMES = 40  # that tell of it
STILL_FORMATS = ("_pipe", "image2", "gif")  # ends of the names of FFmpeg's readers of pictures


@dataclass(frozen=True)
class MediaInfo:
    """What a file holds. Everything is JSON-able.

    width, height: px of the upright picture with square pixels. rotation_deg: counter-clockwise turn that the
    file asks for. fps: nominal rate. duration_s: as the container states it, 0 when it does not.
    video_start_s: presentation time of the first picture on the container's clock.
    audio_codec, audio_rate (Hz), audio_channels: of the first sound that
    can be decoded, nothing without. focal_mm: what the camera wrote of its lens, on film 36 mm wide;
    0 where it wrote nothing.
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
    focal_mm: float

    def as_json(self) -> dict[str, Any]:
        """Plain dictionary for media.json."""
        return asdict(self)


class Source:
    """An opened container: of what can be decoded its `video` stream, None where there is none, and its `sounds`.

    Of several video streams it is the one that players show, or the largest. A phone may put sound of a format of its
    own before, or behind, one that others can read. `lost`: how many packets of the video FFmpeg
    refused so far.

    It reads through one file handle with no protocols allowed, so that a playlist cannot open other files.
    """

    def __init__(self, path: Path, wanted: str = "video") -> None:
        """Raises UserError when the file is not there or FFmpeg cannot read it; wanted: what it should be."""
        self._file = _open_file(path, wanted)
        try:
            options = {"protocol_whitelist": "none"}
            # A title in the letters of an old system makes no film unreadable.
            self.container: Any = av.open(
                self._file, mode="r", container_options=options, metadata_errors="replace"
            )
        except (av.FFmpegError, OSError, ValueError) as error:
            self._file.close()
            reason = str(getattr(error, "strerror", None) or error).splitlines()[0]
            raise UserError(f"{path}: not a {wanted} that can be read ({reason}); is it complete?") from None
        streams = self.container.streams
        shown = [s for s in streams.video if _is_known(s) and not _is_cover(s)]
        self.video: Any = max(shown, key=_prominence, default=None)
        self.sounds: list[Any] = [s for s in streams.audio if _is_known(s)]
        self.lost = 0
        self._guesses = self.container.format.name == "avi"
        self._late: int | None = None

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *exc: object) -> None:
        self.container.close()
        self._file.close()

    def decode(self, stream: Any) -> Iterator[Any]:
        """Frames of a stream in presentation order.

        What does not decode is passed over, and a file that breaks off just ends.
        """
        packets = self.container.demux(stream)
        while True:
            try:
                packet = next(packets)
            # IndexError: PyAV's own at the end of a file in which a stream began that was not there before, as where
            # recordings were joined byte by byte.
            except (StopIteration, av.FFmpegError, IndexError):
                return
            try:
                frames = packet.decode()
            except av.FFmpegError:
                self.lost += stream is self.video
                continue
            for frame in frames:
                if self._guesses and stream is self.video:
                    self._as_stored(frame)
                yield frame

    def _as_stored(self, frame: Any) -> None:
        """Give a picture the time at which it is stored, from the first one's on.

        AVI knows no other. FFmpeg guesses when pictures are shown that are stored in another order, and is wrong.
        """
        if frame.dts is None:
            frame.pts = None
            return
        self._late = frame.dts - (frame.pts or 0) if self._late is None else self._late
        frame.pts = frame.dts - self._late


def _open_file(path: Path, wanted: str) -> BinaryIO:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise UserError(f"{path}: not a file; give a {wanted} file")
        if status.st_size == 0:
            raise UserError(f"{path}: the file is empty; give a complete {wanted}")
        return path.open("rb")
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; check the name") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None


def _is_known(stream: Any) -> bool:
    """Whether FFmpeg knows how a stream is coded."""
    return stream.codec_context is not None


def _is_cover(stream: Any) -> bool:
    """Whether a video stream is only the cover picture of a sound file."""
    return bool(stream.disposition & av.stream.Disposition.attached_pic)


def _prominence(stream: Any) -> tuple[bool, int]:
    """By default shown, and area in px: of a video stream."""
    return bool(stream.disposition & av.stream.Disposition.default), stream.width * stream.height


def frame_time(frame: Any, fallback: float) -> float:
    """Presentation time of a decoded frame on the container's clock, s; `fallback` without one."""
    return fallback if frame.pts is None else float(frame.pts * frame.time_base)


def square_size(stream: Any, frame: Any) -> tuple[int, int]:
    """(width, height) as stored, px, the width corrected for pixels that are not square."""
    aspect = float(stream.sample_aspect_ratio or 1)
    return (round(frame.width * aspect) if 0.1 < aspect < 10 else frame.width), frame.height


def display_matrix(frame: Any) -> NDArray[np.int64]:
    """[2, 2] of -1, 0, 1 that takes a row (x, y) as stored upright: quarter turns and mirrors.

    Mirrors are lost where something unknown lies beside the picture too.
    """
    beside = _beside(frame)
    if beside is None:
        quarters = round(frame.rotation / 90) % 4
        return np.asarray(np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), quarters), np.int64)
    for side in beside:
        if side.type == SideData.DISPLAYMATRIX:
            numbers = np.frombuffer(bytes(memoryview(side)), dtype="<i4")
            matrix = np.round(numbers[[0, 1, 3, 4]].reshape(2, 2) / 65536).clip(-1, 1).astype(np.int64)
            if abs(round(float(np.linalg.det(matrix)))) == 1 and np.abs(matrix).sum() == 2:
                return matrix
    return np.eye(2, dtype=np.int64)


def _beside(frame: Any) -> list[Any] | None:
    """What is stored beside a picture; None where FFmpeg knows a kind of it that PyAV does not, as EXIF."""
    try:
        return list(frame.side_data)
    except ValueError:
        return None


def quantizer(path: Path) -> float:
    """How coarsely a film begins to be coded, 0 to 51, in the median picture; NaN unless it is H.264."""
    with Source(path) as source:
        if source.video.codec_context.name != "h264":
            return np.nan
        # By one thread: with several, a picture is handed out while the steps of its blocks are still filled in.
        source.video.thread_type, source.video.codec_context.thread_count = "NONE", 1
        source.video.codec_context.options = {"export_side_data": "venc_params"}
        steps = [_quantizer(frame) for frame in islice(source.decode(source.video), QUANTIZER_FRAMES)]
    known = [value for value in steps if value is not None]
    return float(np.median(known)) if known else np.nan


def _quantizer(frame: Any) -> float | None:
    """Of a picture of H.264, the mean of its blocks; None if it does not tell."""
    for side in _beside(frame) or []:
        if side.type == SideData.VIDEO_ENC_PARAMS:
            data = memoryview(side)
            blocks = np.frombuffer(data, _CODED_BLOCKS, count=1)[0]
            each = np.frombuffer(data, np.uint8, blocks["count"] * blocks["size"], blocks["at"])
            beyond = each.reshape(blocks["count"], -1)[:, 16:20].copy().view("<i4")
            return float(blocks["steps"] + beyond.mean()) - 6 * (frame.format.components[0].bits - 8)
    return None


def probe(path: Path | str) -> MediaInfo:
    """Look at a video without decoding more than its first two pictures.

    Raises UserError when there is no such file, it is not a video, has no picture stream, is a still picture,
    has no length, or is beyond the limits on size and duration.
    """
    path = Path(path)
    with Source(path) as source:
        video, audio = source.video, next(iter(source.sounds), None)
        if video is None:
            raise UserError(f"{path}: no picture in it that can be read; give a video of a talking face")
        if max(video.width, video.height) > MAX_SIDE_PX:
            raise UserError(
                f"{path}: {video.width}x{video.height} px; scale it to at most {MAX_SIDE_PX} px a side"
            )
        first = _first_pictures(path, source)
        width, height = square_size(video, first)
        upright = display_matrix(first)[0, 0] != 0
        return MediaInfo(
            path=str(path),
            bytes=path.stat().st_size,
            container=source.container.format.name,
            video_codec=video.codec_context.name,
            pixel_format=first.format.name,
            width=width if upright else height,
            height=height if upright else width,
            rotation_deg=int(first.rotation),
            fps=float(video.average_rate or video.guessed_rate or 0),
            duration_s=_duration(path, source),
            video_start_s=frame_time(first, 0.0),
            has_audio=audio is not None,
            audio_codec=audio.codec_context.name if audio else "",
            audio_rate=audio.rate if audio else 0,
            audio_channels=audio.channels if audio else 0,
            focal_mm=recorded_focal_mm(path) if "mov" in source.container.format.name.split(",") else 0.0,
        )


def _duration(path: Path, source: Source) -> float:
    if source.video.duration:
        duration = float(source.video.duration * source.video.time_base)
    else:
        length = source.container.duration or 0
        if source.container.format.name == MATROSKA:  # the time of its end, which need not begin at zero
            length = max(length - max(source.container.start_time or 0, 0), 0)
        duration = float(length) / av.time_base
    if duration > MAX_DURATION_S:
        raise UserError(
            f"{path}: {duration / 3600:.1f} h long; cut it to under {MAX_DURATION_S / 3600:.0f} h"
        )
    return duration


def _first_pictures(path: Path, source: Source) -> Any:
    """The first picture, once it is sure that there is a second one."""
    frames = source.decode(source.video)
    first, second = next(frames, None), next(frames, None)
    if first is None:
        raise UserError(f"{path}: no picture in it can be decoded; record or export it again")
    if second is None and source.container.format.name.endswith(STILL_FORMATS):
        raise UserError(f"{path}: a still picture; give a video of a talking face")
    if second is None:
        raise UserError(f"{path}: only one picture long; give a video of a talking face, 30 s or more")
    return first
