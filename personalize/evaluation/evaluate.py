"""METHOD's metrics on the test split for mean motion, ridge, base and personalized; one clip to look at and hear."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.files import write_npz
from model.metrics import lip_opening_mm, score
from model.ridge import Ridge
from model.speech import load_encoder
from model.synthesis import synthesize
from personalize.evaluation.clip import write_clip
from personalize.files import write_json
from personalize.reporter import Reporter
from personalize.run import RunFolder
from personalize.settings import Settings
from personalize.subject_data import Span, SubjectData, base_path, load_subject_data

F32 = NDArray[np.float32]

SYSTEMS = ("mean_motion", "ridge", "base", "personalized")
SAMPLES = 10
LONGEST_CLIP_S = 12.0


@dataclass(frozen=True)
class Evaluation:
    """What the report shows. metrics: the content of metrics.json. clip: motion frames [first, last) of the film.

    reference [n], samples [S, n]: lip opening in mm of the clip's frames at `clip_time` [n] s.
    """

    metrics: dict[str, Any]
    clip_time: NDArray[np.float64]
    reference: F32
    samples: F32


def predict(
    system: str, data: SubjectData, span: Span, subject: Checkpoint, base: Checkpoint, seed: int
) -> F32:
    """Coefficients [S, n, K] m that a system synthesizes for a span; S is 1 for the two that cannot vary."""
    rows = slice(span.first, span.last)
    train = np.concatenate([s.coefficients[s.valid] for s in data.sequences("train")])
    if system == "mean_motion":
        return np.broadcast_to(train.mean(0), (1, span.last - span.first, train.shape[1])).astype(np.float32)
    if system == "ridge":
        return Ridge.fit(data.sequences("train"), data.sequences("val")).predict(data.features[rows])[None]
    if system == "personalized":
        return synthesize(subject, data.features[rows], samples=SAMPLES, seed=seed)
    # Nobody's style is known before personalization: each sample speaks in another of the base's.
    styles = [base.styles[index % len(base.styles)] for index in range(SAMPLES)]
    drawn = [
        synthesize(base, data.features[rows], style=style, guidance=subject.guidance, seed=seed + index)[0]
        for index, style in enumerate(styles)
    ]
    return np.stack(drawn)


def evaluate_run(run: RunFolder, settings: Settings, folder: Path, report: Reporter) -> Evaluation:
    """Write metrics.json and the samples of a run; returns what the report shows.

    A metric is the mean over the test spans, weighted by their frames; over samples where a system draws several.
    """
    encoder = load_encoder(settings.encoder)
    subject = Checkpoint.load(run.path / "checkpoint.safetensors", encoder=encoder.name)
    base = Checkpoint.load(base_path(settings), topology=subject.topology, encoder=encoder.name)
    data = load_subject_data(run, style=len(subject.styles) - 1, encoder=encoder)
    spans = data.parts["test"]
    systems: dict[str, dict[str, float]] = {}
    clip_span = max(spans, key=lambda span: int(span.sequence.valid.sum()))
    clip_samples: F32 = np.zeros(0, np.float32)
    for done, system in enumerate(SYSTEMS):
        rows = []
        for span in spans:
            samples = predict(system, data, span, subject, base, settings.seed)
            rows.append((score(samples, span.sequence, subject), int(span.sequence.valid.sum())))
            if system == "personalized" and span is clip_span:
                clip_samples = samples
        weights = np.array([weight for _, weight in rows], float)
        systems[system] = {
            name: float(np.average([metrics[name] for metrics, _ in rows], weights=weights))
            for name in rows[0][0]
        }
        report.progress(done + 1, len(SYSTEMS) + 1)
    metrics = {
        "schema": 1,
        "unit": "mm",
        "split": "test",
        "seconds": float(sum(span.sequence.valid.sum() for span in spans) / data.motion.fps),
        "guidance": subject.guidance,
        "systems": systems,
    }
    write_json(folder / "metrics.json", metrics)
    return _write_samples(run, folder, data, subject, metrics, clip_span, clip_samples)


def _write_samples(
    run: RunFolder,
    folder: Path,
    data: SubjectData,
    subject: Checkpoint,
    metrics: dict[str, Any],
    span: Span,
    samples: F32,
) -> Evaluation:
    """The film of one test stretch and its samples, and their lip openings for the report."""
    length = min(span.last - span.first, round(LONGEST_CLIP_S * data.motion.fps))
    frames = np.arange(span.first, span.first + length)
    time = data.motion.start_s + frames / data.motion.fps
    reference = data.motion.coefficients[frames]
    (folder / "samples").mkdir()
    write_npz(folder / "samples/test.npz", time=time, reference=reference, samples=samples[:, :length])
    write_clip(run, folder / "samples/test.mp4", data.motion, subject, time, reference, samples[0, :length])
    both = np.concatenate([reference[None], samples[:, :length]])
    gaps = lip_opening_mm(data.motion.template, subject.basis, subject.regions, both)
    return Evaluation(metrics, time, gaps[0], gaps[1:])
