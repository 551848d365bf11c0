"""Speed and memory of training: `python -m benchmarks training [--steps 200] [--threads 1 2]`.

One line a thread count: milliseconds a step at the product's sizes, minutes for 30 000 steps, peak memory.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.dataset import Sequence, Standardization
from model.trainer import Trainer
from model.training_config import TrainingConfig

MODES, WIDTH, VERTICES, FRAMES = 56, 384, 4754, 1800
ITERATIONS = TrainingConfig.iterations


def random_sequence(seed: int) -> Sequence:
    """A minute of noise: speed does not depend on what is learned."""
    rng = np.random.default_rng(seed)
    motion = 0.01 * rng.standard_normal((FRAMES, MODES)).astype(np.float32)
    return Sequence(motion, rng.standard_normal((FRAMES, WIDTH)).astype(np.float32), np.ones(FRAMES, bool))


def untrained(sequence: Sequence) -> Checkpoint:
    """A model at the product's sizes, on a mesh that nothing looks at."""
    basis: NDArray[np.float32] = np.zeros((MODES, VERTICES, 3), np.float32)
    basis.reshape(MODES, -1)[np.arange(MODES), np.arange(MODES)] = 1
    return Checkpoint.initial(
        kind="base",
        encoder="none",
        styles=("noise",),
        basis=basis,
        template=np.zeros((VERTICES, 3), np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        standardization=Standardization.of([sequence]),
        regions={},
    )


def peak_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument(
        "--precision", choices=("auto", "float32", "bfloat16"), default=TrainingConfig.precision
    )
    parser.add_argument("--device", default=TrainingConfig.device)
    arguments = parser.parse_args()
    sequence = random_sequence(0)
    checkpoint = untrained(sequence)
    defaults = TrainingConfig()
    print(f"batch {defaults.batch} x {defaults.frames} frames, {MODES} coefficients, {WIDTH} speech features")
    print(f"{'threads':>7} {'ms/step':>8} {'CPU ms':>8} {f'min for {ITERATIONS:,}':>15} {'peak MB':>8}")
    for threads in arguments.threads:
        with tempfile.TemporaryDirectory() as folder:
            config = TrainingConfig(
                iterations=arguments.steps,
                candidates=1,
                threads=threads,
                precision=arguments.precision,
                device=arguments.device,
            )
            trainer = Trainer(checkpoint, [sequence], Path(folder), config)
            wall, cpu = time.perf_counter(), time.process_time()
            trainer.train()
            ms = 1e3 * (time.perf_counter() - wall) / arguments.steps
            cpu_ms = 1e3 * (time.process_time() - cpu) / arguments.steps
        print(f"{threads:7d} {ms:8.1f} {cpu_ms:8.1f} {ms * ITERATIONS / 6e4:15.1f} {peak_mb():8.0f}")
