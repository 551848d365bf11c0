"""The sound of a video on the clock of its pictures, and WAV files."""

from __future__ import annotations

import wave
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from personalize.container import MAX_DURATION_S, Source, frame_time
from personalize.errors import UserError

F32 = NDArray[np.float32]

SPEECH_RATE = 16_000  # Hz, of sound that is measured and learnt from: the speech encoders want it
FILM_RATE = 48_000  # Hz, of sound that people listen to
# Sound is placed anew where its times leave the running count by more. Some containers round times to 1 ms.
GAP_S = 0.01
# Of the loudest channel: a mean that is quieter holds channels of opposite sign, or silent ones for the most part.
CANCELLED = 0.3


def read_audio(path: Path | str, rate: int = SPEECH_RATE) -> tuple[F32, float]:
    """Sound as (mono samples [S] f32 -1..1 at `rate` Hz, time s of the first sample from the first picture).

    Every packet lies at its presentation time: gaps are silence, a late start is kept. Of several sound streams it is
    the loudest. S is 0 without one, or when nothing in it decodes. In a pure sound file times start at 0. Raises
    UserError like `Source`.
    """
    path = Path(path)
    origin = _picture_start(path)
    with Source(path) as source:
        count = len(source.sounds)
    tracks = [_placed(_runs(path, number, origin, rate), rate) for number in range(count)]
    return max(tracks, key=lambda track: _loudness(track[0]), default=_placed([], rate))


def _runs(path: Path, number: int, origin: float, rate: int) -> list[tuple[float, F32]]:
    """The uninterrupted stretches of one of a file's sounds: s after `origin`, and samples."""
    runs: list[tuple[float, F32]] = []
    with Source(path) as source:
        run: _Run | None = None
        for frame in source.decode(source.sounds[number]):
            time = frame_time(frame, run.end if run else origin)
            if run is None or abs(time - run.end) > GAP_S or not run.goes_on(frame):
                runs += [run.close()] if run else []
                run = _Run(rate, time)
            run.add(frame)
            if run.end - origin > MAX_DURATION_S:
                raise UserError(f"{path}: over {MAX_DURATION_S / 3600:.0f} h of sound; cut it")
        runs += [run.close()] if run else []
    return [(start - origin, part) for start, part in runs if len(part)]


def _placed(runs: list[tuple[float, F32]], rate: int) -> tuple[F32, float]:
    """All stretches in one, silence between them, and when it begins, s."""
    if not runs:
        return np.zeros(0, np.float32), 0.0
    first = min(start for start, _ in runs)
    placed = [(round((start - first) * rate), part) for start, part in runs]
    samples = np.zeros(max(place + len(part) for place, part in placed), np.float32)
    for place, part in placed:
        samples[place : place + len(part)] = part
    return samples, first


def _loudness(samples: F32) -> float:
    """Root mean square of [.., S]; 0 of none."""
    return float(np.linalg.norm(samples.ravel())) / samples.size**0.5 if samples.size else 0.0


def _one_channel(channels: F32) -> F32:
    """[C, S] -> [S]: their mean, or the loudest where they cancel each other, or one of many speaks."""
    mean = np.asarray(channels.mean(0), np.float32)
    loudest = channels[int(np.argmax([_loudness(channel) for channel in channels]))]
    return mean if _loudness(mean) > CANCELLED * _loudness(loudest) else loudest


def _picture_start(path: Path) -> float:
    """Container time of the first picture; 0 for a pure sound file. Of all that read sound it opens the file first."""
    with Source(path, wanted="sound or video") as source:
        first = next(source.decode(source.video), None) if source.video is not None else None
        return frame_time(first, 0.0) if first is not None else 0.0


class _Run:
    """Resamples one uninterrupted stretch of sound to mono; `end` is the container time it reaches, s."""

    def __init__(self, rate: int, start: float) -> None:
        # The channels as they are: FFmpeg's own mixing makes what both of them hold louder than either, and clips.
        self._resampler = av.AudioResampler(format="fltp", rate=rate)
        self._parts: list[F32] = []
        self._kind: tuple[str, str, int] | None = None
        self._start = start
        self.end = start

    def goes_on(self, frame: Any) -> bool:
        """Whether a frame has the format of those before."""
        return self._kind in (None, _kind(frame))

    def add(self, frame: Any) -> None:
        self._kind = _kind(frame)
        self.end += frame.samples / frame.sample_rate
        frame.pts = None  # placed by the caller, not by the resampler
        self._parts += [out.to_ndarray() for out in self._resampler.resample(frame)]

    def close(self) -> tuple[float, F32]:
        """(start on the container's clock s, samples)."""
        self._parts += [out.to_ndarray() for out in self._resampler.resample(None)]
        if not self._parts:
            return self._start, np.zeros(0, np.float32)
        # Sound stored as numbers with a point may hold ones that are none.
        channels = np.concatenate(self._parts, axis=1)
        self._parts = []  # hours of sound fill gigabytes
        return self._start, _one_channel(np.nan_to_num(channels, copy=False, nan=0.0, posinf=0.0, neginf=0.0))


def _kind(frame: Any) -> tuple[str, str, int]:
    return frame.format.name, frame.layout.name, frame.sample_rate


def on_video_clock(samples: F32, start_s: float, duration_s: float, rate: int = SPEECH_RATE) -> F32:
    """Cut or fill with silence to [duration * rate]: sample k is at k / rate s after the first picture."""
    out = np.zeros(round(duration_s * rate), np.float32)
    place = round(start_s * rate)
    part = samples[max(0, -place) : max(0, len(out) - place)]
    out[max(0, place) : max(0, place) + len(part)] = part
    return out


def write_wav(path: Path, samples: F32, rate: int = SPEECH_RATE) -> None:
    """Write mono f32 -1..1 as 16-bit PCM; louder samples are clipped."""
    pcm = np.round(np.clip(samples, -1, 1) * 32767).astype("<i2")
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(pcm.tobytes())
