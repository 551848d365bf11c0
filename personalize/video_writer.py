"""Writing an MP4 that browsers play: H.264 in yuv420p with AAC sound, its index at the front."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from personalize.sound import SPEECH_RATE

_TIME_BASE = Fraction(1, 90_000)
_BT709 = 1
# Without B pictures: with them this encoder's bytes differ from run to run, and a remade file would not be the same.
_X264 = {"bf": "0"}


class VideoWriter:
    """Writes pictures (and sound) to `path`; the file appears there when complete, or not at all.

    Use as a context manager. Pictures are at n / fps s, or at the times given to `write`.
    """

    def __init__(
        self,
        path: Path,
        fps: float,
        size: tuple[int, int],
        audio: NDArray[np.float32] | None = None,
        audio_rate: int = SPEECH_RATE,
        crf: int = 20,
        preset: str = "veryfast",
    ) -> None:
        """fps: nominal rate. size: (width, height) px; an odd side gets one more row or column.

        audio: mono [S] -1..1, its first sample at time 0. crf: quality of x264, lower is better. preset: its speed.
        """
        self._path = path
        self._partial = path.with_name(f".{path.name}.partial")
        self._fps = fps
        self._size = size
        self._count, self._last = 0, -1
        self._partial.touch()  # where it may not be written, PyAV's own error does not say which
        self._container = av.open(str(self._partial), "w", format="mp4", options={"movflags": "+faststart"})
        rate = Fraction(fps).limit_denominator(1001)
        options = _X264 | {"crf": str(crf), "preset": preset}
        self._video = self._container.add_stream("libx264", rate=rate, options=options)
        self._video.width, self._video.height = size[0] + size[0] % 2, size[1] + size[1] % 2
        self._video.pix_fmt = "yuv420p"
        self._video.codec_context.time_base = _TIME_BASE
        self._video.codec_context.colorspace = _BT709
        self._video.codec_context.color_primaries = _BT709
        self._video.codec_context.color_trc = _BT709
        self._video.codec_context.color_range = ColorRange.MPEG
        self._audio = None if audio is None else np.clip(audio, -1, 1).astype(np.float32)
        self._audio_rate = audio_rate
        self._audio_done = 0
        if self._audio is not None:
            self._sound = self._container.add_stream("aac", rate=audio_rate, layout="mono")

    def write(self, rgb: NDArray[np.uint8], time_s: float | None = None) -> None:
        """Add a picture [H, W, 3] u8 of the stated size; times must rise."""
        assert rgb.shape == (self._size[1], self._size[0], 3), rgb.shape
        time = self._count / self._fps if time_s is None else time_s
        self._count += 1
        self._write_audio(time)
        odd = [(0, side % 2) for side in rgb.shape[:2]]
        picture = np.pad(rgb, [*odd, (0, 0)], mode="edge") if any(self._size[i] % 2 for i in (0, 1)) else rgb
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24").reformat(
            format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        # Of two pictures nearer than the clock tells apart the later one comes a tick behind.
        self._last = max(round(time / _TIME_BASE), self._last + 1)
        frame.pts, frame.time_base = self._last, _TIME_BASE
        self._container.mux(self._video.encode(frame))

    def _write_audio(self, until_s: float) -> None:
        """Sound goes along with the pictures, so that a player need not seek."""
        if self._audio is None:
            return
        block = self._sound.codec_context.frame_size or 1024
        while self._audio_done < min(len(self._audio), until_s * self._audio_rate):
            part = self._audio[self._audio_done : self._audio_done + block]
            frame = av.AudioFrame.from_ndarray(part[None], format="fltp", layout="mono")
            frame.sample_rate, frame.time_base = self._audio_rate, Fraction(1, self._audio_rate)
            frame.pts = self._audio_done
            self._container.mux(self._sound.encode(frame))
            self._audio_done += len(part)

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._write_audio(np.inf)
                self._container.mux(self._video.encode(None))
                if self._audio is not None:
                    self._container.mux(self._sound.encode(None))
            self._container.close()
            if kind is None:
                self._partial.replace(self._path)
        finally:
            self._partial.unlink(missing_ok=True)
