"""The objective: the loss of one random batch, and its gradient."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from model.dataset import Batch
from model.denoiser import Denoiser
from model.diffusion import Diffusion
from model.training_config import TrainingConfig

# What is still for longer than this is not made important.
SMALLEST_SPREAD = 0.25

# Sets every parameter's `grad` to that of the batch's mean loss, which is returned: a scalar.
Gradient = Callable[[Batch, "Draws"], Tensor]


def coefficient_weights(scale: Tensor, spread: Tensor, power: float) -> Tensor:
    """[K]: what a standardized squared residual weighs in the loss, so that a squared residual in the coefficient's own
    standard deviations, scale spread, weighs their power.

    Power 2 is the vertex metric: the basis is orthonormal, so sum_k scale_k^2 r_k^2 is the squared vertex distance.
    There the small coefficients get no gradient to speak of, and are sampled as white noise that shakes the face; a
    power of 1/2 measured best (docs/method.md). Without the velocity's part a loss of 1 is what predicting the mean
    motion costs.
    """
    seen = spread.clamp(min=SMALLEST_SPREAD)
    weights = (scale * seen) ** power / seen**2
    return weights / (weights * spread**2).sum()


def objective(x0: Tensor, predicted: Tensor, weights: Tensor, velocity: float) -> Tensor:
    """||x0 - x0hat||^2 + velocity ||dx0 - dx0hat||^2, each a mean over its frames; [N, B, K] -> scalar."""
    residual = x0 - predicted
    change = residual[1:] - residual[:-1]
    frames, batch = x0.shape[0], x0.shape[1]
    position = (residual.square() @ weights).sum() / (frames * batch)
    return position + velocity * (change.square() @ weights).sum() / ((frames - 1) * batch)


@dataclass(frozen=True)
class Draws:
    """The randomness of one step but the crops: t [B] diffusion steps, noise [N, B, K], keep [B], channels [B, W or 1].

    keep: 0 where the speech is zeroed. channels: 0 where a speech channel is, the rest scaled to the same mean.
    """

    t: Tensor
    noise: Tensor
    keep: Tensor
    channels: Tensor

    def part(self, rows: slice) -> Draws:
        """Of some of the batch."""
        return Draws(self.t[rows], self.noise[:, rows], self.keep[rows], self.channels[rows])

    def to(self, device: torch.device) -> Draws:
        """On a device."""
        return Draws(*(value.to(device) for value in vars(self).values()))

    @classmethod
    def of(cls, batch: Batch, steps: int, config: TrainingConfig, generator: torch.Generator) -> Draws:
        """For a batch, from the generator."""
        count, width = batch.audio.shape[1:]
        t = torch.randint(steps, (count,), generator=generator)
        keep = (torch.rand(count, generator=generator) >= config.unconditional).float()
        noise = torch.randn(batch.motion.shape, generator=generator)
        channels = torch.ones(count, 1)
        if config.feature_dropout:
            channels = (torch.rand((count, width), generator=generator) >= config.feature_dropout).float()
            channels = channels / (1 - config.feature_dropout)
        return cls(t, noise, keep, channels)


class Objective(nn.Module):
    """The loss of a batch under given draws: one module, so that it can be spread over processes as a whole."""

    def __init__(
        self, network: Denoiser, diffusion: Diffusion, weights: Tensor, config: TrainingConfig
    ) -> None:
        super().__init__()
        self.network = network
        self._diffusion, self._velocity, self._precision = diffusion, config.velocity, config.precision
        self.weights: Tensor
        self.register_buffer("weights", weights, persistent=False)

    def forward(self, batch: Batch, draws: Draws) -> Tensor:
        """Scalar; see `objective`."""
        kind, lower = batch.motion.device.type, self._precision == "bfloat16"
        # Casts are kept for all threads together: which of two finds the other's would decide the rounding.
        with torch.autocast(kind, torch.bfloat16, enabled=lower, cache_enabled=False):
            x_t = self._diffusion.add_noise(batch.motion, draws.t, draws.noise)
            condition = self.network.condition(batch.audio * draws.channels, draws.keep)
            output = self.network(x_t, draws.t, condition, batch.style).float()
        predicted = self._diffusion.x0(output, x_t, draws.t)
        return objective(batch.motion, predicted, self.weights, self._velocity)


class SharedGradient:
    """The gradient of an objective as the sum over shares of the batch, each made by a thread of its own.

    A layer of this network is too small to gain from torch's own threads; half a batch on each of two is 1.3 to 1.7
    times as fast as the whole on one (benchmarks/training.py). The same number of threads gives the same bytes.
    """

    def __init__(self, objective: Objective, threads: int) -> None:
        self._objective = objective
        self._parameters = list(objective.parameters())
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads)

    def __call__(self, batch: Batch, draws: Draws) -> Tensor:
        """Sets every parameter's `grad` to that of the batch's mean loss, which is returned: a scalar."""
        shares = [slice(first, None, self._threads) for first in range(min(self._threads, len(draws.t)))]
        weights = [len(draws.t[rows]) / len(draws.t) for rows in shares]
        futures = [
            self._pool.submit(self._share, batch.part(rows), draws.part(rows), weight)
            for rows, weight in zip(shares, weights)
        ]
        losses, gradients = zip(*(future.result() for future in futures))
        total = gradients[0]
        for gradient in gradients[1:]:
            torch._foreach_add_(total, gradient)
        for parameter, value in zip(self._parameters, total):
            parameter.grad = value
        return torch.stack(losses).sum()

    def _share(self, batch: Batch, draws: Draws, weight: float) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Loss and gradient of a part that is `weight` of the whole."""
        loss = weight * self._objective(batch, draws)
        return loss.detach(), torch.autograd.grad(loss, self._parameters)


class GraphedGradient:
    """The gradient of an objective on a CUDA device, recorded once and replayed: a step is hundreds of kernels, too
    small to be worth starting one by one.
    """

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        self._parameters = list(objective.parameters())
        self._graph = torch.cuda.CUDAGraph()
        self._inputs: list[Tensor] = []
        self._loss: Tensor | None = None

    def __call__(self, batch: Batch, draws: Draws) -> Tensor:
        """As `SharedGradient`; every batch has the first one's size."""
        with torch.cuda.device(batch.motion.device):
            if self._loss is None:
                self._loss = self._record(batch, draws)
            for tensor, value in zip(self._inputs, [*vars(batch).values(), *vars(draws).values()]):
                tensor.copy_(value)
            self._graph.replay()
            return self._loss.clone()

    def _record(self, batch: Batch, draws: Draws) -> Tensor:
        """The loss and the parameters' gradients as tensors that every replay fills anew."""
        batch = Batch(*(value.clone() for value in vars(batch).values()))
        draws = Draws(*(value.clone() for value in vars(draws).values()))
        self._inputs = [*vars(batch).values(), *vars(draws).values()]
        # What a library sets up in its first runs cannot be recorded.
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(3):
                torch.autograd.grad(self._objective(batch, draws), self._parameters)
        torch.cuda.current_stream().wait_stream(aside)
        with torch.cuda.graph(self._graph):
            loss = self._objective(batch, draws)
            gradients = torch.autograd.grad(loss, self._parameters)
        for parameter, value in zip(self._parameters, gradients):
            parameter.grad = value
        return loss.detach()


def gradient_of(objective: Objective, threads: int) -> Gradient:
    """The quickest way to it where the objective is."""
    return GraphedGradient(objective) if objective.weights.is_cuda else SharedGradient(objective, threads)
