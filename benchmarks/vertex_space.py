"""The basis form against the paper's vertex space: `python -m benchmarks vertex_space [--threads 1]`.

The reference is the same network, objective and sampler on all 3D vertex coordinates; production is the same on the
K coefficients. Times are medians of single steps, so that the slow reference is not run to the end; the last column
is the ratio. Below it, where production's step goes.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from benchmarks.training import MODES, VERTICES, WIDTH, peak_mb
from model.dataset import Batch
from model.denoiser import NetworkConfig
from model.diffusion import STEPS, Diffusion
from model.motion import FPS
from model.network import Network
from model.objective import Draws, Objective
from model.synthesis import CHUNK_ROWS, Guided
from model.training_config import TrainingConfig

SECONDS = 60.0
PARTS = 8


def median_ms(step: Callable[[], object], times: int) -> float:
    """Median milliseconds of a step, the first one left out."""
    took = []
    for _ in range(times + 1):
        start = time.perf_counter()
        step()
        took.append(1e3 * (time.perf_counter() - start))
    return statistics.median(took[1:])


def training_step(width: int) -> Callable[[], Tensor]:
    """One iteration of the paper's batch on `width` coordinates a frame: draws, loss, gradients, Adam."""
    config, generator = TrainingConfig(), torch.Generator().manual_seed(0)
    network = Network(NetworkConfig(width, WIDTH, 1))
    loss_of = Objective(network, Diffusion(), torch.full((width,), 1 / width), config)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, fused=True)
    shape = config.frames, config.batch
    batch = Batch(
        torch.randn(*shape, width), torch.randn(*shape, WIDTH), torch.zeros(shape[1], dtype=torch.int64)
    )

    def step() -> Tensor:
        loss: Tensor = loss_of(batch, Draws.of(batch, STEPS, config, generator))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return loss

    return step


def sampling_step(width: int) -> Callable[[], Tensor]:
    """One reverse step with guidance over SECONDS of motion of `width` coordinates a frame."""
    frames, generator = round(SECONDS * FPS), torch.Generator().manual_seed(0)
    network = Network(NetworkConfig(width, WIDTH, 1)).eval().requires_grad_(False)
    diffusion = Diffusion()
    predict = Guided(network, diffusion, torch.randn(frames, WIDTH), 0, 0.5, CHUNK_ROWS)
    x = torch.randn(frames, 1, width)
    return lambda: diffusion.reverse(x, predict(x, 250), 250, 249, "posterior", generator)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    torch.set_num_threads(parser.parse_args().threads)
    print(
        f"{3 * VERTICES} vertex coordinates against {MODES} coefficients, {torch.get_num_threads()} thread(s)"
    )
    print(f"{'ms a step':>22} {'vertex space':>13} {'basis form':>11} {'ratio':>7}")
    rows = (
        ("training, 64 x 30", training_step, 2, 30),
        (f"sampling, {SECONDS:.0f} s", torch.inference_mode()(sampling_step), 3, 30),
    )
    for name, make, few, many in rows:
        fast = median_ms(make(MODES), many)
        slow = median_ms(make(3 * VERTICES), few)
        print(f"{name:>22} {slow:13.1f} {fast:11.1f} {slow / fast:7.1f}", flush=True)
    print(f"peak memory, vertex space included: {peak_mb():.0f} MB\n")
    step = training_step(MODES)
    step()
    with profile(activities=[ProfilerActivity.CPU]) as found:
        for _ in range(10):
            step()
    parts = sorted(found.key_averages(), key=lambda part: -part.self_cpu_time_total)
    total = sum(part.self_cpu_time_total for part in parts)
    print("where a training step of the basis form goes")
    for part in parts[:PARTS]:
        print(
            f"{part.key:>32} {part.self_cpu_time_total / 1e4:7.2f} ms {part.self_cpu_time_total / total:6.1%}"
        )


if __name__ == "__main__":
    main()
