"""Editing on a run's test split (docs/figures.md): `python -m benchmarks editing talk.personalize [--samples 10]`.

Free synthesis, in-betweening (p % of the frames kept, half of them at each end), and evenly spaced keyframes. The
columns are the metrics over all frames, kept ones included, mean over the samples and the spans of the split by
their frames; `kept` is the share of frames kept, `seam` the jerk at the borders. At the end: does every further kept
frame help?
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.diffusion import RULES, Rule
from model.metrics import isometry, score, seam
from model.motion import FPS
from model.speech import load_encoder
from model.synthesis import Keep, synthesize
from personalize.run import RunFolder
from personalize.subject_data import Span, load_subject_data

COLUMNS = ("div_e", "lip_sync", "lip_max", "l2_lip_paper", "l2_lip", "l2_face", "kept", "seam")
ENDS = (5, 10, 20, 50)  # percent
KEYFRAMES = (1, 2, 3)  # a second


def ends(frames: int, percent: float) -> NDArray[np.bool_]:
    """Half of `percent` of the frames at each end."""
    each = round(frames * percent / 200)
    return (np.arange(frames) < each) | (np.arange(frames) >= frames - each)


def keyframes(frames: int, per_second: int) -> NDArray[np.bool_]:
    """Evenly spaced frames, half a step from the ends."""
    step = round(FPS / per_second)
    return np.arange(frames) % step == step // 2


def score_span(
    checkpoint: Checkpoint, span: Span, kept: NDArray[np.bool_], samples: int, rule: Rule, seed: int
) -> dict[str, float]:
    """The metrics of edits of one span that keep these frames [N]."""
    sequence = span.sequence
    keep = Keep(sequence.coefficients, kept & sequence.valid)
    drawn = synthesize(checkpoint, sequence.features, samples=samples, seed=seed, rule=rule, keep=keep)
    face = isometry(checkpoint.basis, checkpoint.regions["face"])
    valid = sequence.valid
    shot = np.cumsum(np.diff(valid.astype(int), prepend=0) == 1)[valid]
    own = sequence.coefficients[valid] @ face
    seams = [seam(sample @ face, keep.mask, own, shot) for sample in drawn]
    return score(drawn, sequence, checkpoint) | {
        "kept": float(keep.mask.mean()),
        "seam": float(np.mean(seams)),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--samples", type=int, default=10)
    parser.add_argument("--rule", choices=RULES, default="posterior")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    run = RunFolder.open(arguments.run)
    encoder = load_encoder()
    checkpoint = Checkpoint.load(run.path / "checkpoint.safetensors", encoder=encoder.name)
    spans = load_subject_data(run, len(checkpoint.styles) - 1, encoder).parts["test"]
    weights = [int(span.sequence.valid.sum()) for span in spans]
    print(
        f"{sum(weights) / FPS:.0f} s in {len(spans)} spans, {arguments.samples} samples, s = {checkpoint.guidance}"
    )
    print(f"{'':22s}", *(f"{name:>12s}" for name in COLUMNS))

    def row(name: str, kept: list[NDArray[np.bool_]]) -> list[float]:
        options = (arguments.samples, arguments.rule, arguments.seed)
        scores = [score_span(checkpoint, span, mask, *options) for span, mask in zip(spans, kept)]
        values = [float(np.average([s[column] for s in scores], weights=weights)) for column in COLUMNS]
        print(f"{name:22s}", *(f"{value:12.3f}" for value in values), flush=True)
        return values

    lengths = [span.last - span.first for span in spans]
    free = row("free synthesis", [np.zeros(length, bool) for length in lengths])
    series = {
        "both ends": [row(f"both ends, {p} %", [ends(length, p) for length in lengths]) for p in ENDS],
        "keyframes": [row(f"keyframes, {r} a second", [keyframes(n, r) for n in lengths]) for r in KEYFRAMES],
    }
    for name, rows in series.items():
        steps = np.diff([free, *rows], axis=0)[:, : COLUMNS.index("kept")]
        worse = [column for column, step in zip(COLUMNS, steps.T) if (step > 0).any()]
        print(
            f"{name}: more kept frames improve every metric"
            if not worse
            else f"{name}: not monotonic: {worse}"
        )


if __name__ == "__main__":
    main()
