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

AUDIO_RATE = 16_000
# Sound is placed anew where its times leave the running count by more. Some containers round times to 1 ms.
GAP_S = 0.01


def read_audio(path: Path | str, rate: int = AUDIO_RATE) -> tuple[F32, float]:
    """Sound as (mono samples [S] f32 -1..1 at `rate` Hz, time s of the first sample from the first picture).

    Every packet lies at its presentation time: gaps are silence, a late start is kept. S is 0 without a sound
    stream, or when nothing in it decodes. In a pure sound file times start at 0. Raises UserError like
    `Source`.
    """
    path = Path(path)
    origin = _picture_start(path)
    runs: list[tuple[float, F32]] = []
    with Source(path) as source:
        frames = source.decode(source.audio) if source.audio is not None else iter(())
        run: _Run | None = None
        for frame in frames:
            time = frame_time(frame, run.end if run else origin)
            if run is None or abs(time - run.end) > GAP_S:
                runs += [run.close()] if run else []
                run = _Run(rate, time)
            run.add(frame)
            if run.end - origin > MAX_DURATION_S:
                raise UserError(f"{path}: over {MAX_DURATION_S / 3600:.0f} h of sound; cut it")
        runs += [run.close()] if run else []
    runs = [(start - origin, part) for start, part in runs if len(part)]
    if not runs:
        return np.zeros(0, np.float32), 0.0
    first = min(start for start, _ in runs)
    placed = [(round((start - first) * rate), part) for start, part in runs]
    samples = np.zeros(max(place + len(part) for place, part in placed), np.float32)
    for place, part in placed:
        samples[place : place + len(part)] = part
    return samples, first


def _picture_start(path: Path) -> float:
    """Container time of the first picture; 0 for a pure sound file."""
    with Source(path) as source:
        first = next(source.decode(source.video), None) if source.video is not None else None
        return frame_time(first, 0.0) if first is not None else 0.0


class _Run:
    """Resamples one uninterrupted stretch of sound to mono; `end` is the container time it reaches, s."""

    def __init__(self, rate: int, start: float) -> None:
        self._resampler = av.AudioResampler(format="flt", layout="mono", rate=rate)
        self._parts: list[F32] = []
        self._start = start
        self.end = start

    def add(self, frame: Any) -> None:
        self.end += frame.samples / frame.sample_rate
        frame.pts = None  # placed by the caller, not by the resampler
        self._parts += [out.to_ndarray().ravel() for out in self._resampler.resample(frame)]

    def close(self) -> tuple[float, F32]:
        """(start on the container's clock s, samples)."""
        if not self._parts:
            return self._start, np.zeros(0, np.float32)
        self._parts += [out.to_ndarray().ravel() for out in self._resampler.resample(None)]
        return self._start, np.concatenate(self._parts)


def on_video_clock(samples: F32, start_s: float, duration_s: float, rate: int = AUDIO_RATE) -> F32:
    """Cut or fill with silence to [duration * rate]: sample k is at k / rate s after the first picture."""
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
