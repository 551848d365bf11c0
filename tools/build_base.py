"""Build model/assets/base.safetensors: the base model, trained on synthetic talkers with synthetic voices.

Needs the program flite (Debian: apt-get install flite) for the voices; all else is the project's own. Continues
where it stopped when run again with the same --work folder.

    python -m tools.build_base [--work build/base]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.dataset import Sequence, Standardization
from model.motion import FPS
from model.speech import SpeechEncoder, load_encoder, resample
from model.trainer import Trainer
from model.training_config import TrainingConfig
from personalize.sound import SPEECH_RATE
from personalize.talkers.motion import talker_motion
from personalize.talkers.style import Style
from tools.flite_voices import VOICES, monologue, record
from tracker.head import ASSET as HEAD_ASSET
from tracker.head import HeadModel, read_head

F32 = NDArray[np.float32]

OUTPUT = Path(__file__).parent.parent / "model" / "assets" / "base.safetensors"
SENTENCES = Path(__file__).parent / "base_sentences.txt"
TALKERS = 16
SENTENCES_EACH = 28
TRAINING = TrainingConfig(
    iterations=24_000, candidates=1, feature_dropout=0.0, weight_decay=0.0, precision="float32"
)
TAKES = 3  # the same sound, moved to differently and recorded differently
REGIONS = (
    "lips",
    "inner_lip_upper",
    "inner_lip_lower",
    "face",
    "eyelids",
    "left_eyelid_upper",
    "left_eyelid_lower",
    "right_eyelid_upper",
    "right_eyelid_lower",
    "eyes",
    "forehead",
    "neck",
    "scalp",
    "teeth",
)
# Movement that the talkers never make still gets a place in the basis, behind all that they make.
UNSEEN_SD = 0.003  # weight


def talker_data(seed: int, encoder: SpeechEncoder, names: tuple[str, ...]) -> list[tuple[F32, F32]]:
    """Takes of one talker at 30 fps: (weights [N, Ke], features [N, W]) each."""
    random = np.random.default_rng((seed, 2))
    sentences = random.permutation(SENTENCES.read_text().splitlines())[:SENTENCES_EACH]
    speech = monologue([str(s) for s in sentences], VOICES[seed % len(VOICES)], seed)
    duration = len(speech.audio) / SPEECH_RATE
    takes = []
    for take in range(TAKES):
        motion = talker_motion(
            speech.phones, duration, FPS, seed * TAKES + take, Style.random(seed), speech.audio
        )
        weights = motion.expression_for(names)
        features, times = encoder.encode(record(speech.audio, seed * TAKES + take))
        takes.append((weights, resample(features, times, np.arange(len(weights)) / FPS)))
    return takes


def principal_basis(expression_basis: F32, weights: F32) -> F32:
    """Orthonormal basis [K, D, 3] of all expression shapes [K, D, 3], in the order of what `weights` [N, K] move."""
    shapes = expression_basis.reshape(len(expression_basis), -1).astype(np.float64)
    span, triangle = np.linalg.qr(shapes.T)
    spread = np.cov(weights.T.astype(np.float64)) + UNSEEN_SD**2 * np.eye(len(shapes))
    _, axes = np.linalg.eigh(triangle @ spread @ triangle.T)
    basis = (span @ axes[:, ::-1]).T
    largest = np.take_along_axis(basis, np.abs(basis).argmax(axis=1)[:, None], axis=1)
    return (basis * np.sign(largest)).reshape(expression_basis.shape).astype(np.float32)


def untrained(head: HeadModel, encoder: SpeechEncoder) -> tuple[Checkpoint, list[Sequence]]:
    """The model before training, and the sequences of all talkers."""
    takes = []
    for seed in range(TALKERS):
        started = time.monotonic()
        takes += [(seed, *take) for take in talker_data(seed, encoder, head.expression_names)]
        print(f"talker {seed + 1}/{TALKERS}: {time.monotonic() - started:.0f} s", flush=True)
    basis = principal_basis(head.expression_basis, np.concatenate([weights for _, weights, _ in takes]))
    flat = basis.reshape(len(basis), -1)
    to_coefficients = head.expression_basis.reshape(len(flat), -1) @ flat.T
    sequences = [
        Sequence(weights @ to_coefficients, features, np.ones(len(weights), bool), seed)
        for seed, weights, features in takes
    ]
    seconds = sum(len(sequence.valid) for sequence in sequences) / FPS
    print(f"{len(sequences)} sequences, {seconds / 60:.1f} min")
    checkpoint = Checkpoint.initial(
        kind="base",
        encoder=encoder.name,
        styles=tuple(f"talker_{seed:02d}" for seed in range(TALKERS)),
        basis=basis,
        template=head.template,
        faces=head.faces,
        standardization=Standardization.of(sequences),
        regions={name: head.regions[name] for name in REGIONS},
        provenance={"synthetic": True, "source": "tools/build_base.py", "seconds": round(seconds)},
    )
    return checkpoint, sequences


def main() -> None:
    """Make the data, train, write."""
    parser = argparse.ArgumentParser(description="Build the embedded base model.")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--work", type=Path, default=Path("build/base"), help="folder for a continuation")
    arguments = parser.parse_args()
    checkpoint, sequences = untrained(read_head(HEAD_ASSET), load_encoder())

    def say(done: int, total: int) -> None:
        if done % 500 == 0:
            print(f"{done}/{total} iterations", flush=True)

    trainer = Trainer(checkpoint, sequences, arguments.work, replace(TRAINING, threads=arguments.threads))
    trainer.train(say)
    provenance = checkpoint.provenance | {"iterations": TRAINING.iterations}
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    trainer.checkpoint(provenance=provenance).save(OUTPUT)
    print(f"{OUTPUT}: {OUTPUT.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
