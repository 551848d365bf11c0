"""The paper's Table 3a, its ablation of the network: `python -m benchmarks architectures [RUN ...] [options]`.

Trains each architecture from scratch on the train parts of the runs together, a style each, and tests on their test
parts in pieces of at most 5 s, the length of the paper's sentences. The runs must have come as far as `registration`;
without one, a made-up person who says the bundled speech takes their place, the last quarter for the test.

div_e, lip_sync, lip_max, l2_lip (the paper's: over all vertices), l2_face    mm, of 10 samples; docs/method.md
parameters    in thousands, and the milliseconds of wall time that a training step took
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.architectures import ARCHITECTURES
from model.checkpoint import Checkpoint
from model.dataset import Sequence, Standardization
from model.denoiser import Architecture
from model.diffusion import PARAMETRIZATIONS, STEPS, Parametrization
from model.metrics import score
from model.motion import FPS
from model.speech import load_encoder
from model.synthesis import synthesize
from model.trainer import Trainer
from model.training_config import TrainingConfig
from personalize.run import RunFolder
from personalize.sound import SPEECH_RATE, read_audio
from personalize.subject_data import BASE_CHECKPOINT, load_subject_data, speech_features
from personalize.talkers.film import ASSETS
from personalize.talkers.motion import talker_motion
from personalize.talkers.style import Style
from personalize.talkers.visemes import load_phones
from tracker.head import load_head

COLUMNS = ("div_e", "lip_sync", "lip_max", "l2_lip_paper", "l2_face")
SAMPLES = 10
PIECE_FRAMES = round(5 * FPS)
SHORTEST_FRAMES = round(1 * FPS)


def of_runs(runs: list[Path]) -> tuple[list[Sequence], list[Sequence]]:
    """Train and test sequences of runs, their number as their style."""
    data = [load_subject_data(RunFolder.open(run), style, load_encoder()) for style, run in enumerate(runs)]
    return [q for d in data for q in d.sequences("train")], [q for d in data for q in d.sequences("test")]


def made_up(base: Checkpoint, seed: int) -> tuple[list[Sequence], list[Sequence]]:
    """Train and test sequences of a made-up person who says the bundled speech."""
    head = load_head()
    audio, start_s = read_audio(ASSETS / "demo_speech.flac")
    phones = load_phones(ASSETS / "demo_speech.json")
    talker = talker_motion(phones, len(audio) / SPEECH_RATE, FPS, seed, Style.random(seed), audio)
    shapes = np.tensordot(head.expression_basis, base.basis, axes=((1, 2), (1, 2)))
    motion = (talker.expression_for(head.expression_names) @ shapes).astype(np.float32)
    times = start_s + np.arange(len(motion)) / FPS
    features = speech_features(ASSETS / "demo_speech.flac", times, load_encoder())
    whole = Sequence(motion, features, np.ones(len(motion), bool))
    cut = 3 * len(motion) // 4
    return [part(whole, 0, cut)], [part(whole, cut, len(motion))]


def part(sequence: Sequence, first: int, last: int) -> Sequence:
    """Its frames [first, last)."""
    rows = slice(first, last)
    return Sequence(
        sequence.coefficients[rows], sequence.features[rows], sequence.valid[rows], sequence.style
    )


def pieces(sequences: list[Sequence]) -> list[Sequence]:
    """What is tested: stretches short enough for every architecture, with at least a second to judge."""
    cut = [
        part(sequence, first, first + PIECE_FRAMES)
        for sequence in sequences
        for first in range(0, len(sequence.valid), PIECE_FRAMES)
    ]
    return [piece for piece in cut if piece.valid.sum() >= SHORTEST_FRAMES]


def untrained(
    base: Checkpoint, train: list[Sequence], architecture: Architecture, parametrization: Parametrization
) -> Checkpoint:
    """A model of the base's mesh and speech that has learned nothing, with a style for each person."""
    return Checkpoint.initial(
        kind="base",
        encoder=base.encoder,
        styles=tuple(f"person {style}" for style in range(1 + max(q.style for q in train))),
        basis=base.basis,
        template=base.template,
        faces=base.faces,
        standardization=Standardization.of(train),
        regions=base.regions,
        parametrization=parametrization,
        architecture=architecture,
    )


def learn(start: Checkpoint, train: list[Sequence], config: TrainingConfig) -> tuple[Checkpoint, float]:
    """The trained model, and the milliseconds of a step."""
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(start, train, Path(folder), config)
        started = time.perf_counter()
        trainer.train()
        return trainer.checkpoint(), 1e3 * (time.perf_counter() - started) / config.iterations


def draw(checkpoint: Checkpoint, sequence: Sequence, guidance: float, steps: int) -> NDArray[np.float32]:
    """Samples [S, N, K] of a sequence in its own style."""
    style = checkpoint.styles[sequence.style]
    return synthesize(
        checkpoint, sequence.features, style=style, guidance=guidance, samples=SAMPLES, steps=steps
    )


def table_row(label: str, rows: list[dict[str, float]], test: list[Sequence], rest: str = "") -> str:
    """A line of the table: means over the test by valid frames."""
    weights = [sequence.valid.sum() for sequence in test]
    means = [np.average([row[name] for row in rows], weights=weights) for name in COLUMNS]
    return f"{label:<22}" + "".join(f"{mean:9.3f}" for mean in means) + rest


def main() -> None:
    """Train, test and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*", metavar="RUN")
    parser.add_argument("--iterations", type=int, default=TrainingConfig.iterations)
    parser.add_argument("--parametrization", choices=PARAMETRIZATIONS, default="skip")
    parser.add_argument("--guidance", type=float, nargs="+", default=[1.0, 0.5])
    parser.add_argument("--steps", type=int, default=STEPS, help="of the reverse chain")
    parser.add_argument("--threads", type=int, default=TrainingConfig.threads)
    parser.add_argument("--device", default=TrainingConfig.device)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    base = Checkpoint.load(BASE_CHECKPOINT)
    train, whole_test = of_runs(options.runs) if options.runs else made_up(base, options.seed)
    test = pieces(whole_test)
    seconds = [sum(q.valid.sum() for q in sequences) / FPS for sequences in (train, test)]
    print(f"train {seconds[0]:.0f} s, test {seconds[1]:.0f} s in {len(test)} pieces")
    names = "".join(f"{name.removesuffix('_paper'):>9}" for name in COLUMNS)
    print(f"{f'{options.iterations} iterations':<22}{names}   params  ms/step")
    mean = Standardization.of(train).mean
    still = [np.broadcast_to(mean, (1, *q.coefficients.shape)) for q in test]
    print(table_row("mean motion", [score(drawn, q, base) for drawn, q in zip(still, test)], test))
    config = TrainingConfig(
        iterations=options.iterations,
        candidates=1,
        threads=options.threads,
        device=options.device,
        seed=options.seed,
    )
    for architecture in ARCHITECTURES:
        start = untrained(base, train, architecture, options.parametrization)
        trained, ms = learn(start, train, config)
        size = sum(value.numel() for value in trained.network.values()) / 1e3
        for s in options.guidance:
            rows = [score(draw(trained, q, s, options.steps), q, trained) for q in test]
            print(table_row(f"{architecture}, s = {s}", rows, test, f"{size:8.0f}k {ms:8.1f}"), flush=True)


if __name__ == "__main__":
    main()
