"""Small videos with known pictures, times and sound, written with PyAV."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from tracker.track import F32

RATE = 48_000
MS = Fraction(1, 1000)


def corner_picture(width: int = 96, height: int = 64, level: int = 40) -> np.ndarray:
    """Grey, with the top left quarter red and the top right quarter green."""
    rgb = np.full((height, width, 3), level, np.uint8)
    rgb[: height // 2, : width // 2] = (200, 30, 30)
    rgb[: height // 2, width // 2 :] = (30, 180, 30)
    return rgb


def clicks(times: Sequence[float], seconds: float) -> F32:
    """Mono sound at RATE, 10 ms of tone at each time."""
    sound = np.zeros(round(seconds * RATE), np.float32)
    tone = 0.8 * np.sin(2 * np.pi * 1000 * np.arange(RATE // 100) / RATE)
    for time in times:
        start = round(time * RATE)
        sound[start : start + len(tone)] = tone
    return sound


def write_video(
    path: Path,
    pictures: Sequence[np.ndarray],
    times: Sequence[float],
    sound: F32 | None = None,
    sound_start: float = 0.0,
    sound_gap: tuple[float, float] | None = None,
    rotation: int = 0,
    aspect: Fraction | None = None,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    keys: int = 250,
    options: dict[str, str] | None = None,
    colours: int | None = None,
) -> Path:
    """Pictures at `times` s; sound from `sound_start`, without the packets that begin inside `sound_gap`.

    options: of the encoder. colours: FFmpeg's number of the colour space that the film is said to have.
    """
    with av.open(str(path), "w") as out:
        video: Any = out.add_stream(codec, rate=25, options={"g": str(keys), "crf": "12", **(options or {})})
        if colours is not None:
            video.codec_context.colorspace = colours
        video.height, video.width = pictures[0].shape[:2]
        video.pix_fmt = pixels
        video.codec_context.time_base = MS
        if aspect is not None:
            video.codec_context.sample_aspect_ratio = aspect
        if rotation:
            video.set_display_rotation(rotation)
        audio: Any = out.add_stream("pcm_s16le", rate=RATE, layout="mono") if sound is not None else None
        for picture, time in zip(pictures, times):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = round(time * 1000), MS
            out.mux(video.encode(frame))
        out.mux(video.encode(None))
        block = RATE // 50
        for start in range(0, len(sound) if sound is not None else 0, block):
            assert sound is not None
            if sound_gap and sound_gap[0] <= sound_start + start / RATE < sound_gap[1]:
                continue
            pcm = np.round(sound[start : start + block] * 32767).astype(np.int16)
            frame = av.AudioFrame.from_ndarray(pcm[None], format="s16", layout="mono")
            frame.sample_rate, frame.time_base = RATE, Fraction(1, RATE)
            frame.pts = start + round(sound_start * RATE)
            out.mux(audio.encode(frame))
    return path


def write_sounds(
    path: Path, sounds: Sequence[F32], rate: int = RATE, start: float = 0.0, codec: str = "mp2"
) -> Path:
    """Sound streams one beside another, each [C, S], of one or two channels, from `start` s on."""
    with av.open(str(path), "w") as out:
        streams: list[Any] = [
            out.add_stream(codec, rate=rate, layout="mono" if len(sound) == 1 else "stereo")
            for sound in sounds
        ]
        for stream, sound in zip(streams, sounds):
            block = stream.codec_context.frame_size or 1152
            for begin in range(0, sound.shape[1], block):
                pcm = np.round(sound[:, begin : begin + block] * 32767).astype(np.int16)
                frame = av.AudioFrame.from_ndarray(
                    pcm.T.reshape(1, -1), format="s16", layout=stream.layout.name
                )
                frame.sample_rate, frame.time_base = rate, Fraction(1, rate)
                frame.pts = begin + round(start * rate)
                out.mux(stream.encode(frame))
            out.mux(stream.encode(None))
    return path


def moving(count: int, seed: int = 0) -> list[np.ndarray]:
    """Pictures of a smooth texture that drifts: no two are equal."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(40, 200, (8, 8, 3)).astype(np.float32)
    big = np.kron(coarse, np.ones((16, 16, 1), np.float32)).astype(np.uint8)
    return [np.ascontiguousarray(np.roll(big, i, 1)[:64, :96]) for i in range(count)]
