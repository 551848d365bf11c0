"""Personalization: the base model becomes one person's; choice of checkpoint and guidance on validation."""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from model.checkpoint import Checkpoint, State
from model.dataset import Sequence, Standardization
from model.diffusion import Progress
from model.errors import ModelError
from model.metrics import score
from model.synthesis import synthesize

CHOICE_GUIDANCE = 0.99
CHOICE_STEPS = 50
# Of a person's candidates the first that costs no more than this over the best: what is trained on only learns the clip
# by heart, and its samples agree ever more (docs/method.md).
EARLY_TOLERANCE = 1.05
SWEEP = tuple(round(0.1 * i, 1) for i in range(11))
SWEEP_SAMPLES = 3
SWEEP_FRAMES = 450
# The chosen s is the smallest that costs no more lip synchrony than this over the best: diversity is free up to there.
SYNC_TOLERANCE = 1.05


def subject_of(base: Checkpoint, name: str, train: Many[Sequence], provenance: dict[str, Any]) -> Checkpoint:
    """The base model with a style row of the subject's own, the mean of the others, ready for fine-tuning.

    The coefficients are standardized anew, since the skip assumes their variance, and the ratio of the scales goes
    into encoder and decoder, so that the network still says the same in metres. Speech keeps the base's scale.
    """
    own, old = Standardization.of(train), base.standardization
    standardization = replace(own, audio_mean=old.audio_mean, audio_scale=old.audio_scale)
    ratio = torch.from_numpy(own.scale / old.scale)
    config = replace(base.config, styles=len(base.styles) + 1)

    def adapt(state: State) -> State:
        styles = state["style.weight"]
        return state | {
            "style.weight": torch.cat([styles, styles.mean(0, keepdim=True)]),
            "encoder.weight": state["encoder.weight"] * ratio,
            "decoder.weight": state["decoder.weight"] / ratio[:, None],
            "decoder.bias": state["decoder.bias"] / ratio,
        }

    # Both start from the averaged weights: they are the base model as it is used.
    return base.with_weights(
        adapt(base.ema),
        adapt(base.ema),
        kind="subject",
        styles=(*base.styles, name),
        config=config,
        standardization=standardization,
        provenance=provenance,
    )


def choose_checkpoint(
    candidates: Many[Path], validation: Many[Sequence], seed: int, tolerance: float = 1.0
) -> tuple[Checkpoint, list[float]]:
    """The first candidate within `tolerance` of the smallest lip error on validation at s = 0.99, and all errors, mm.

    The error is lip_sync + l2_lip, both in mm: timing and place of the lips.
    """
    if not validation:
        raise ModelError("no validation span: the clip is too short to choose a checkpoint on")
    loaded = [Checkpoint.load(path) for path in candidates]
    errors = []
    for checkpoint in loaded:
        rows = [
            validation_metrics(checkpoint, sequence, CHOICE_GUIDANCE, 1, seed, CHOICE_STEPS)
            for sequence in validation
        ]
        frames = [int(sequence.valid.sum()) for sequence in validation]
        errors.append(float(np.average([row["lip_sync"] + row["l2_lip"] for row in rows], weights=frames)))
    return loaded[int(np.argmax(np.array(errors) <= tolerance * min(errors)))], errors


def validation_metrics(
    checkpoint: Checkpoint,
    sequence: Sequence,
    s: float,
    samples: int,
    seed: int,
    ddim_steps: int | None = None,
) -> dict[str, float]:
    """The metrics of synthesized samples of one sequence."""
    drawn = synthesize(
        checkpoint,
        sequence.features,
        guidance=s,
        samples=samples,
        seed=seed,
        rule="posterior" if ddim_steps is None else "ddim",
        steps=ddim_steps,
    )
    return score(drawn, sequence, checkpoint)


def sweep_guidance(
    checkpoint: Checkpoint, validation: Many[Sequence], seed: int, progress: Progress | None = None
) -> tuple[list[dict[str, float]], float]:
    """Rows {s, lip_sync, lip_max, l2_lip, l2_face, div_e} for s = 0 … 1 on validation, and the chosen s."""
    longest = max(validation, key=lambda sequence: int(sequence.valid.sum()))
    rows = slice(0, SWEEP_FRAMES)
    part = Sequence(longest.coefficients[rows], longest.features[rows], longest.valid[rows], longest.style)
    sweep = []
    for done, s in enumerate(SWEEP):
        metrics = validation_metrics(checkpoint, part, s, SWEEP_SAMPLES, seed)
        sweep.append(
            {"s": s} | {n: metrics[n] for n in ("lip_sync", "lip_max", "l2_lip", "l2_face", "div_e")}
        )
        if progress is not None:
            progress(done + 1, len(SWEEP))
    best = min(row["lip_sync"] for row in sweep)
    chosen = next(row["s"] for row in sweep if row["lip_sync"] <= SYNC_TOLERANCE * best)
    return sweep, chosen
