"""The metrics on the test split for mean motion, ridge, base and personalized; one clip to look at and hear."""

from __future__ import annotations

from collections.abc import Callable
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
System = Callable[[F32], F32]

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


def built(system: str, data: SubjectData, subject: Checkpoint, base: Checkpoint, seed: int) -> System:
    """A system by its name: from speech features [n, W] to coefficients [S, n, K] m.

    S is 1 for the two that cannot vary.
    """
    if system == "mean_motion":
        mean = np.concatenate([s.coefficients[s.valid] for s in data.sequences("train")]).mean(0)
        return lambda features: np.tile(mean, (1, len(features), 1))
    if system == "ridge":
        ridge = Ridge.fit(data.sequences("train"), data.sequences("val"))
        return lambda features: ridge.predict(features)[None]
    if system == "base":
        return lambda features: _in_all_styles(base, features, subject.guidance, seed)
    return lambda features: synthesize(subject, features, samples=SAMPLES, seed=seed)


def _in_all_styles(base: Checkpoint, features: F32, guidance: float, seed: int) -> F32:
    """Nobody's style is known before personalization: each sample speaks in another of the base's."""
    styles = [base.styles[index % len(base.styles)] for index in range(SAMPLES)]
    drawn = [
        synthesize(base, features, style=style, guidance=guidance, seed=seed + index)
        for index, style in enumerate(styles)
    ]
    return np.concatenate(drawn)


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
    for done, name in enumerate(SYSTEMS):
        system, rows = built(name, data, subject, base, settings.seed), []
        for span in spans:
            samples = system(data.features[span.first : span.last])
            rows.append((score(samples, span.sequence, subject), int(span.sequence.valid.sum())))
            if name == "personalized" and span is clip_span:
                clip_samples = samples
        weights = np.array([weight for _, weight in rows], float)
        systems[name] = {
            metric: float(np.average([metrics[metric] for metrics, _ in rows], weights=weights))
            for metric in rows[0][0]
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
