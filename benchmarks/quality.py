"""What personalization learns, on real runs: `python -m benchmarks quality RUN [TEST_RUN] [options]`.

Trains on RUN's train part, chooses the checkpoint on its val part, and tests on its test part; given TEST_RUN, it
trains on RUN's test part as well and tests on all of TEST_RUN. The runs must have come as far as `registration`. With
--with-val it trains on the val part too and takes the last checkpoint, and ridge has the same seconds, under the
penalty that val chose before. With --trained nothing is trained: it is the run's own checkpoint that is looked at.

r               of the lip opening with the reference: mean of 10 samples at s = 1, and of the ridge regression from the
                same speech features on the same seconds; `training` is on the training seconds
sd              over samples at s = 0.5 by the motion's own: lip opening, mouth width, eyelid opening; mean over frames
rms             the same as root of the mean variance, as the motion's own is one: what happens in few frames, as a
                blink, counts for little in the mean of deviations
speed           mean change from frame to frame of the same three, by the subject's own: noise is no variety
blinks          a minute, of samples; behind it the subject's own in what is tested and in what is learned from
spread, velocity    of samples, by the subject's own; at s = 0 without the speech

The second table (--curve) is the guidance curve: div_e and lip_sync for s = 0 ... 1.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.blinks import blink_spans
from model.checkpoint import Checkpoint
from model.dataset import Sequence
from model.diffusion import STEPS
from model.finetuning import EARLY_TOLERANCE, SWEEP, choose_checkpoint, subject_of
from model.metrics import eyelid_opening_mm, lip_gap_r, lip_opening_mm, score
from model.motion import FPS
from model.ridge import Ridge
from model.speech import load_encoder
from model.synthesis import synthesize
from model.trainer import Trainer
from model.training_config import TrainingConfig
from personalize.run import RunFolder
from personalize.subject_data import BASE_CHECKPOINT, load_subject_data

F32 = NDArray[np.float32]
SIGNALS = ("lips", "width", "lids")
SAMPLES = 10
CURVE_SAMPLES = 4


def signals(checkpoint: Checkpoint, coefficients: F32) -> dict[str, F32]:
    """Lip opening, mouth width and mean eyelid opening, mm, of coefficients [..., N, K] m: [..., N] each."""
    mesh = checkpoint.template, checkpoint.basis, checkpoint.regions
    left, right = checkpoint.basis[:, checkpoint.regions["inner_lip_upper"][[0, -1]], 0].T
    return {
        "lips": lip_opening_mm(*mesh, coefficients),
        "width": np.abs(1000 * (coefficients @ (left - right))),
        "lids": eyelid_opening_mm(*mesh, coefficients),
    }


def weighted(rows: list[float], sequences: list[Sequence]) -> float:
    """Mean over sequences by their valid frames."""
    return float(np.average(rows, weights=[sequence.valid.sum() for sequence in sequences]))


def together(checkpoint: Checkpoint, drawn: list[F32], sequences: list[Sequence]) -> dict[str, float]:
    """Figures of samples [S, N, K] of each sequence, over the valid frames of all."""
    samples = np.concatenate([d[:, s.valid] for d, s in zip(drawn, sequences)], axis=1)
    reference = np.concatenate([s.coefficients[s.valid] for s in sequences])
    ours, true = signals(checkpoint, samples), signals(checkpoint, reference)
    scores = [score(d, s, checkpoint) for d, s in zip(drawn, sequences)]
    figures = {name: weighted([row[name] for row in scores], sequences) for name in scores[0]}
    figures["r"] = lip_gap_r(ours["lips"].mean(0), true["lips"])
    for name in ours:
        figures[f"sd {name}"] = float(ours[name].std(0).mean() / true[name].std())
        figures[f"rms {name}"] = float(np.sqrt(ours[name].var(0).mean()) / true[name].std())
        figures[f"speed {name}"] = float(
            np.abs(np.diff(ours[name])).mean() / np.abs(np.diff(true[name])).mean()
        )
    return figures


def blinks_a_minute(checkpoint: Checkpoint, drawn: list[F32], sequences: list[Sequence]) -> float:
    """Of samples [S, N, K] of each sequence, over the valid frames of all."""
    count = sum(
        len(blink_spans(signals(checkpoint, sample)["lids"], q.valid))
        for samples, q in zip(drawn, sequences)
        for sample in samples
    )
    return 60 * FPS * count / sum(len(d) * int(q.valid.sum()) for d, q in zip(drawn, sequences))


def draw(checkpoint: Checkpoint, sequences: list[Sequence], s: float, samples: int, steps: int) -> list[F32]:
    """Samples [S, N, K] of each sequence."""
    return [
        synthesize(checkpoint, q.features, guidance=s, samples=samples, seed=1, steps=steps)
        for q in sequences
    ]


def report(
    checkpoint: Checkpoint, ridge: Ridge, train: list[Sequence], test: list[Sequence], steps: int
) -> None:
    """The first table."""
    predicted = together(checkpoint, [ridge.predict(q.features)[None] for q in test], test)
    samples = {s: draw(checkpoint, test, s, SAMPLES, steps) for s in (0.0, 0.5, 1.0)}
    at = {s: together(checkpoint, drawn, test) for s, drawn in samples.items()}
    own, learned = (
        blinks_a_minute(checkpoint, [q.coefficients[None] for q in qs], qs) for qs in (test, train)
    )
    longest = sorted(train, key=lambda q: -len(q.valid))[:4]
    known = together(checkpoint, draw(checkpoint, longest, 1.0, 3, steps), longest)
    print(f"r     mean of {SAMPLES}, s = 1: {at[1.0]['r']:.3f}   ridge {predicted['r']:.3f}", end="   ")
    print(f"single {at[1.0]['lip_gap_r']:.3f}   training {known['r']:.3f}")
    for s, row in at.items():
        sds, rms, speeds = (
            "   ".join(f"{name} {row[f'{kind} {name}']:.2f}" for name in SIGNALS)
            for kind in ("sd", "rms", "speed")
        )
        print(f"s = {s}   sd {sds}   rms {rms}   speed {speeds}", end="   ")
        print(f"spread {row['spread']:.2f}   velocity {row['velocity']:.2f}", end="   ")
        print(f"blinks {blinks_a_minute(checkpoint, samples[s], test):.1f} ({own:.1f}, {learned:.1f})")
    print(f"ridge     spread {predicted['spread']:.2f}   velocity {predicted['velocity']:.2f}", flush=True)


def guidance_curve(checkpoint: Checkpoint, test: list[Sequence], steps: int) -> None:
    """The second table."""
    print(f"{'s':>5} {'div_e':>8} {'lip_sync':>9} {'lip_max':>8} {'l2_lip':>8}")
    for s in SWEEP:
        row = together(checkpoint, draw(checkpoint, test, s, CURVE_SAMPLES, steps), test)
        print(
            f"{s:5.1f} {row['div_e']:8.2f} {row['lip_sync']:9.3f} {row['lip_max']:8.2f} {row['l2_lip']:8.3f}"
        )
    print("", flush=True)


def trained(
    subject: Checkpoint, train: list[Sequence], val: list[Sequence], config: TrainingConfig, last: bool
) -> Checkpoint:
    """The subject's model after training: the candidate that is best on val, or the last."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        candidates = Trainer(subject, train, Path(folder), config).train()
        best, errors = choose_checkpoint(candidates, val, 0, EARLY_TOLERANCE)
        if last:
            best = Checkpoint.load(candidates[-1])
    print(f"{config.iterations} iterations in {time.perf_counter() - started:.0f} s", end="; ")
    print(f"validation error of candidates, mm: {' '.join(f'{e:.2f}' for e in errors)}")
    return best


def main() -> None:
    """Train and print."""
    defaults = TrainingConfig()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("test_run", type=Path, nargs="?")
    parser.add_argument("--iterations", type=int, default=defaults.iterations)
    parser.add_argument("--learning-rate", type=float, default=defaults.learning_rate)
    parser.add_argument("--feature-dropout", type=float, default=defaults.feature_dropout)
    parser.add_argument("--weight-decay", type=float, default=defaults.weight_decay)
    parser.add_argument("--anchor", type=float, default=defaults.anchor)
    parser.add_argument("--unconditional", type=float, default=defaults.unconditional)
    parser.add_argument("--ema", type=float, default=defaults.ema)
    parser.add_argument("--metric-power", type=float, default=defaults.metric_power)
    parser.add_argument("--precision", choices=("auto", "float32", "bfloat16"), default=defaults.precision)
    parser.add_argument("--device", default=defaults.device)
    parser.add_argument("--parametrization", choices=("skip", "plain"), default="skip")
    parser.add_argument("--scratch", action="store_true", help="do not start from the base model's weights")
    parser.add_argument("--steps", type=int, default=STEPS, help="of sampling")
    parser.add_argument("--curve", action="store_true", help="print the guidance curve as well")
    parser.add_argument(
        "--trained", action="store_true", help="RUN's own checkpoint, trained on its train part"
    )
    parser.add_argument(
        "--with-val", action="store_true", help="train on the val part as well; implies --last"
    )
    parser.add_argument("--last", action="store_true", help="take the last checkpoint, not validation's")
    options = parser.parse_args()
    base, encoder = Checkpoint.load(BASE_CHECKPOINT), load_encoder()
    data = load_subject_data(RunFolder.open(options.run), len(base.styles), encoder)
    val = data.sequences("val")
    train = data.sequences("train")
    if options.test_run and not options.trained:
        train += data.sequences("test")
    test = data.sequences("test")
    if options.test_run:
        other = load_subject_data(RunFolder.open(options.test_run), len(base.styles), encoder)
        test = [q for part in ("train", "val", "test") for q in other.sequences(part)]
    ridge = Ridge.fit(train, val)
    if options.with_val:
        train += val
        ridge = Ridge.fit(train, val, (ridge.penalty,))
    subject = subject_of(base, "subject", train, {})
    if options.scratch or options.parametrization != base.parametrization:
        subject = Checkpoint.initial(
            kind="subject",
            encoder=base.encoder,
            styles=subject.styles,
            basis=base.basis,
            template=base.template,
            faces=base.faces,
            standardization=subject.standardization,
            regions=base.regions,
            parametrization=options.parametrization,
        )
    if options.trained:
        best = Checkpoint.load(options.run / "checkpoint.safetensors")
    else:
        names = vars(defaults).keys() & vars(options).keys()
        config = TrainingConfig(**{name: getattr(options, name) for name in names})
        best = trained(subject, train, val, config, options.last or options.with_val)
    report(best, ridge, train, test, options.steps)
    if options.curve:
        guidance_curve(best, test, options.steps)


if __name__ == "__main__":
    main()
