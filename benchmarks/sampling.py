"""Speed and memory of synthesis: `python -m benchmarks sampling [--threads 1 2]`.

A minute of motion by the full chain of 500 steps with guidance, two seconds by deterministic DDIM, as an editor wants
them, and ten minutes, whose memory must not be ten times a minute's.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from benchmarks.training import WIDTH, peak_mb, random_sequence, untrained
from model.diffusion import DDIM_STEPS, STEPS, Rule
from model.motion import FPS
from model.synthesis import synthesize

CASES: tuple[tuple[Rule, int, float, int], ...] = (  # rule, steps, seconds of motion, samples
    ("posterior", STEPS, 60.0, 1),
    ("posterior", STEPS, 10.0, 10),
    ("ddim", DDIM_STEPS, 2.0, 1),
    ("posterior", STEPS, 600.0, 1),
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    arguments = parser.parse_args()
    checkpoint = untrained(random_sequence(0))
    noise = np.random.default_rng(0).standard_normal((round(600 * FPS), WIDTH)).astype(np.float32)
    print(
        f"{'threads':>7} {'rule':>10} {'steps':>6} {'motion s':>9} {'samples':>8} {'took s':>8} {'peak MB':>8}"
    )
    for threads in arguments.threads:
        torch.set_num_threads(threads)
        for rule, steps, seconds, samples in CASES:
            start = time.perf_counter()
            synthesize(checkpoint, noise[: round(seconds * FPS)], samples=samples, rule=rule, steps=steps)
            took = time.perf_counter() - start
            print(
                f"{threads:7d} {rule:>10} {steps:6d} {seconds:9.0f} {samples:8d} {took:8.2f} {peak_mb():8.0f}"
            )
