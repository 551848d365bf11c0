"""A run's motion and sound as training sequences: speech features at the motion's frames, cut by the split."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.dataset import Sequence
from model.motion import Motion
from model.speech import SpeechEncoder, load_encoder, resample
from personalize.feature_cache import encode_cached
from personalize.run import RunFolder
from personalize.settings import Settings
from personalize.sound import SPEECH_RATE, on_video_clock, read_audio

BASE_CHECKPOINT = Path(__file__).parent.parent / "model" / "assets" / "base.safetensors"
Part = Literal["train", "val", "test"]
# Shorter spans hold no whole word: they are neither learned from nor judged.
SHORTEST_SPAN_S = 1.0
# Stretches of one part that lie closer than this (a cut between them) are one span: speech goes on across a cut.
JOINED_GAP_S = 0.5


@dataclass(frozen=True)
class Span:
    """A stretch of one part of the split: motion frames [first, last) of the run's motion."""

    first: int
    last: int
    sequence: Sequence


@dataclass(frozen=True)
class SubjectData:
    """The run's motion, the speech features [N, W] of its frames, and the spans of each part of the split."""

    motion: Motion
    features: NDArray[np.float32]
    parts: dict[str, list[Span]]

    def sequences(self, part: Part) -> list[Sequence]:
        """The sequences of a part."""
        return [span.sequence for span in self.parts[part]]


def base_path(settings: Settings) -> Path:
    """The checkpoint that fine-tuning starts from."""
    return BASE_CHECKPOINT if settings.base is None else Path(settings.base)


def load_base(settings: Settings) -> Checkpoint:
    """That checkpoint. Raises ModelError where it was not trained with the settings' speech encoder."""
    return Checkpoint.load(base_path(settings), encoder=load_encoder(settings.encoder).name)


def speech_features(sound: Path, at: NDArray[np.float64], encoder: SpeechEncoder) -> NDArray[np.float32]:
    """Features [N, W] of a sound file at times [N] s of its own clock."""
    audio, start_s = read_audio(sound)
    if start_s > 0:  # before it begins it is silent: the first features held would be a sound of that length
        audio, start_s = on_video_clock(audio, start_s, start_s + len(audio) / SPEECH_RATE), 0.0
    features, times = encode_cached(encoder, audio)
    return resample(features, times + start_s, at)


def load_subject_data(run: RunFolder, style: int, encoder: SpeechEncoder) -> SubjectData:
    """Read motion, sound and split of a run. `style`: the row of the style table its sequences get."""
    motion = Motion.load(run.path / "registration/motion.npz")
    offset = float(run.read_json("registration/registration.json")["av_offset_s"])
    times = motion.start_s + np.arange(len(motion.valid)) / motion.fps
    features = speech_features(run.path / "ingest/audio.wav", times + offset, encoder)
    split = run.read_json("ingest/split.json")
    parts: dict[str, list[Span]] = {}
    for part in ("train", "val", "test"):
        parts[part] = []
        for start_s, end_s in joined(split[part]):
            for first, last in tracked(motion, *np.searchsorted(times, [start_s, end_s])):
                rows = slice(first, last)
                sequence = Sequence(motion.coefficients[rows], features[rows], motion.valid[rows], style)
                parts[part].append(Span(first, last, sequence))
    return SubjectData(motion, features, parts)


def tracked(motion: Motion, first: int, last: int) -> list[tuple[int, int]]:
    """Stretches [first, last) of a span without a long gap in the tracking, as long as a word at least."""
    seen = first + np.flatnonzero(motion.valid[first:last])
    runs = np.split(seen, np.flatnonzero(np.diff(seen) > JOINED_GAP_S * motion.fps) + 1)
    return [(int(run[0]), int(run[-1]) + 1) for run in runs if len(run) >= SHORTEST_SPAN_S * motion.fps]


def joined(stretches: list[list[float]]) -> list[list[float]]:
    """[[start, end], …] in s, in order -> the same with small gaps closed."""
    result: list[list[float]] = []
    for start_s, end_s in stretches:
        if result and start_s - result[-1][1] < JOINED_GAP_S:
            result[-1][1] = end_s
        else:
            result.append([start_s, end_s])
    return result
