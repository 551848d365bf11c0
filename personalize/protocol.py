"""The paper's comparison on VOCAset: Table 1 and the ablations 3b (seconds to adapt on) and 3c (noise on the audio)."""

from __future__ import annotations

import json
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.dataset import Sequence
from model.finetuning import choose_checkpoint, subject_of
from model.metrics import score
from model.motion import FPS
from model.speech import SpeechEncoder, resample
from model.synthesis import synthesize
from model.trainer import Trainer, TrainingDivergedError
from model.training_config import TrainingConfig
from personalize.feature_cache import encode_cached
from personalize.files import write_json
from personalize.reporter import Reporter

F32 = NDArray[np.float32]

ADAPTATION_ITERATIONS = 30_000
SAMPLES = 10
METRICS = ("div_e", "lip_sync", "lip_max", "l2_lip_paper", "l2_face")


@dataclass(frozen=True)
class System:
    """One row. seconds: of the subject that it is adapted on, 0 for none. noise_db: against the test's speech."""

    table: str
    name: str
    seconds: float
    guidance: float = 0.5
    noise_db: float | None = None
    paper: tuple[float, ...] = ()
    """The paper's figures, in the order of METRICS."""


WHOLE = float("inf")
SYSTEMS = (
    System("1", "no style, s = 0.5", 0, paper=(2.57, 1.71, 5.20, 0.15, 0.86)),
    System("1", "no style, s = 1", 0, guidance=1.0, paper=(0.64, 1.62, 5.13, 0.15, 0.84)),
    System("1", "personalized", WHOLE, paper=(1.57, 1.56, 4.01, 0.11, 0.78)),
    System("3b", "adapted on 5 s", 5, paper=(29.95, 4.89, 13.05, 0.37, 1.95)),
    System("3b", "adapted on 30 s", 30, paper=(0.18, 1.81, 4.90, 0.13, 0.86)),
    System("3b", "adapted on 60 s", 60, paper=(0.67, 1.69, 4.18, 0.12, 0.83)),
    System("3b", "adapted on 100 s", 100, paper=(1.57, 1.56, 4.01, 0.11, 0.78)),
    System("3c", "noise at -12 dB", WHOLE, noise_db=-12, paper=(6.41, 2.56, 6.68, 0.19, 0.94)),
    System("3c", "noise at -24 dB", WHOLE, noise_db=-24, paper=(2.54, 1.97, 4.93, 0.13, 0.84)),
    System("3c", "noise at -36 dB", WHOLE, noise_db=-36, paper=(1.85, 1.78, 4.40, 0.12, 0.77)),
)


@dataclass(frozen=True)
class Reference:
    """A test sentence as it was captured.

    sequence: its part in the model's basis. outside [R, D, 3]: an orthonormal basis of the rest, orthogonal to the
    model's, and outside_coefficients [N, R] m. audio [S] at 16 kHz.
    """

    sequence: Sequence
    outside: F32
    outside_coefficients: F32
    audio: F32

    def score(self, samples: F32, checkpoint: Checkpoint) -> dict[str, float]:
        """The metrics of samples [S, N, K] m against the captured motion, off the model's basis as well."""
        rest = np.zeros((*samples.shape[:2], len(self.outside)), np.float32)
        whole = replace(checkpoint, basis=np.concatenate([checkpoint.basis, self.outside]))
        captured = np.concatenate([self.sequence.coefficients, self.outside_coefficients], axis=1)
        reference = replace(self.sequence, coefficients=captured)
        return score(np.concatenate([samples, rest], axis=2), reference, whole)


@dataclass(frozen=True)
class Subject:
    """A test subject: template [D, 3] m, the parts 18/2/20 of its sentences, and what encodes their sound."""

    name: str
    template: F32
    encoder: SpeechEncoder
    train: list[Sequence]
    val: list[Sequence]
    test: list[Reference]


def speech_at(audio: F32, frames: int, encoder: SpeechEncoder) -> F32:
    """Features [frames, W] of sound [S] at 16 kHz at the motion's frames."""
    features, times = encode_cached(encoder, audio)
    return resample(features, times, np.arange(frames) / FPS)


def first_seconds(sequences: Many[Sequence], seconds: float) -> list[Sequence]:
    """The sequences from the first on, up to so many seconds in all; the last one is cut."""
    chosen, left = [], seconds * FPS
    for sequence in sequences:
        rows = slice(0, int(min(left, len(sequence.valid))))
        if rows.stop > 0:
            part = (sequence.coefficients[rows], sequence.features[rows], sequence.valid[rows])
            chosen.append(Sequence(*part, sequence.style))
        left -= rows.stop
    return chosen


def with_noise(audio: F32, level_db: float, seed: int) -> F32:
    """Sound [S] with white noise whose power is `level_db` of the sound's own."""
    size = float(np.sqrt((audio.astype(np.float64) ** 2).mean())) * 10 ** (level_db / 20)
    noise = np.random.default_rng(seed).standard_normal(len(audio))
    return (audio + size * noise).astype(np.float32)


def compare_systems(
    base: Checkpoint,
    train: Many[Sequence],
    subjects: Many[Subject],
    work: Path,
    config: TrainingConfig,
    report: Reporter,
) -> list[dict[str, Any]]:
    """The rows of SYSTEMS, means over the subjects: {"table", "system", "seconds", "paper", and each of METRICS}.

    None without a subject. base was trained on `train`; without adaptation a subject gets the mean of its styles.
    Adaptation takes 30 000 iterations, or the base's own where these are less. seconds: what a subject really gave for
    it. A metric is the mean over 10 samples of each test sentence, weighted by frames; null where the adaptation
    diverged. Noise is on the audio of the test. Everything finished stays in `work`, and is not done again.
    """
    if not subjects:
        return []
    config = replace(config, iterations=min(ADAPTATION_ITERATIONS, config.iterations))
    tables = []
    for subject in subjects:
        with report.stage(subject.name):
            tables.append(_subject_table(base, train, subject, work / subject.name, config, report))
    rows = []
    for index, system in enumerate(SYSTEMS):
        parts = [table[index] for table in tables]
        row: dict[str, Any] = {"table": system.table, "system": system.name, "paper": list(system.paper)}
        for name in ("seconds", *METRICS):
            values = [value for part in parts if (value := part[name]) is not None]
            row[name] = float(np.mean(values)) if len(values) == len(parts) else None
        rows.append(row)
    return rows


def _subject_table(
    base: Checkpoint,
    train: Many[Sequence],
    subject: Subject,
    work: Path,
    config: TrainingConfig,
    report: Reporter,
) -> list[dict[str, float | None]]:
    """One subject's rows. Systems that come to the same (all seconds there are) are trained and judged once."""
    work.mkdir(parents=True, exist_ok=True)
    scores = _Scores(work / "scores.json")
    models: dict[int, Checkpoint | None] = {}
    rows: list[dict[str, float | None]] = []
    for done, system in enumerate(SYSTEMS):
        learned = first_seconds(subject.train, system.seconds)
        frames = sum(len(sequence.valid) for sequence in learned)
        key = f"{frames} frames, s = {system.guidance}, noise {system.noise_db} dB"
        if key not in scores.known:
            if frames not in models:
                models[frames] = _model(base, train, learned, subject, work / f"{frames}_frames", config)
            model = models[frames]
            scores.add(key, _judge(model, subject, system, config.seed) if model else dict.fromkeys(METRICS))
        rows.append(scores.known[key] | {"seconds": frames / FPS})
        report.progress(done + 1, len(SYSTEMS))
    return rows


class _Scores:
    """Metrics by system in a file that survives an interruption."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.known: dict[str, dict[str, float | None]] = (
            json.loads(path.read_text()) if path.is_file() else {}
        )

    def add(self, key: str, metrics: dict[str, float | None]) -> None:
        self.known[key] = metrics
        write_json(self._path, self.known)


def _model(
    base: Checkpoint,
    train: Many[Sequence],
    learned: list[Sequence],
    subject: Subject,
    folder: Path,
    config: TrainingConfig,
) -> Checkpoint | None:
    """The base model adapted to what is learned of the subject, chosen on validation; None where training diverged.

    Where nothing is learned: the base model in the mean of its styles.
    """
    if not learned:
        return subject_of(base, "mean of styles", train, {})
    start = subject_of(
        base, subject.name, learned, base.provenance | {"adapted_iterations": config.iterations}
    )
    try:
        candidates = Trainer(start, learned, folder, config).train()
    except TrainingDivergedError:
        return None
    best, _ = choose_checkpoint(candidates, subject.val, config.seed)
    best = replace(best, template=subject.template)
    best.save(folder / "checkpoint.safetensors")
    return best


def _judge(model: Checkpoint, subject: Subject, system: System, seed: int) -> dict[str, float | None]:
    """METRICS over the subject's test sentences."""
    model = replace(model, template=subject.template)
    rows, frames = [], []
    for index, sentence in enumerate(subject.test):
        features = sentence.sequence.features
        if system.noise_db is not None:
            noisy = with_noise(sentence.audio, system.noise_db, seed + index)
            features = speech_at(noisy, len(features), subject.encoder)
        samples = synthesize(model, features, guidance=system.guidance, samples=SAMPLES, seed=seed + index)
        rows.append(sentence.score(samples, model))
        frames.append(len(features))
    return {name: float(np.average([row[name] for row in rows], weights=frames)) for name in METRICS}
