"""Gaussian diffusion over standardized coefficients: schedule, forward process, x0 parametrization,
reverse rules.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from model.errors import ModelError

SCHEDULES = ("cosine", "linear")
PARAMETRIZATIONS = ("skip", "plain")
RULES = ("posterior", "renoise", "ddim")
Schedule = Literal["cosine", "linear"]
Parametrization = Literal["skip", "plain"]
Rule = Literal["posterior", "renoise", "ddim"]

STEPS = 500
# Deterministic DDIM follows a smooth path, which a tenth of the steps resolves.
DDIM_STEPS = 50
# Every step of renoise shows the network nothing but its own last guess. One that makes a guess a little larger does so
# again at each step: at 500 of them samples run away to 1e5 times the motion's size (docs/method.md).
RENOISE_STEPS = 25

# (x_t [N, *b, K], t) -> x0hat [N, *b, K].
Predict = Callable[[Tensor, int], Tensor]
Overwrite = Callable[[Tensor], Tensor]
Progress = Callable[[int, int], None]


def cosine_alphas(steps: int) -> Tensor:
    """abar_t of Nichol & Dhariwal 2021, eq. 17, betas clipped at 0.999: [steps] f64."""
    t = torch.arange(steps + 1, dtype=torch.float64) / steps
    f = torch.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2
    betas = torch.clamp(1 - f[1:] / f[:-1], max=0.999)
    return torch.cumprod(1 - betas, dim=0)


def linear_alphas(steps: int) -> Tensor:
    """abar_t for betas from 1e-4 to 0.02 at 1 000 steps (Ho et al. 2020), scaled to `steps`: [steps] f64."""
    betas = torch.linspace(0.1 / steps, 20.0 / steps, steps, dtype=torch.float64)
    return torch.cumprod(1 - torch.clamp(betas, max=0.999), dim=0)


def preconditioning(alphas: Tensor, spread: Tensor) -> tuple[Tensor, Tensor]:
    """Skip and gain [steps, K] f32, from abar_t [steps, 1] and the data's standard deviation [K], both f64.

    skip x_t is the best linear guess of x0, gain the standard deviation of what it misses (Karras et al. 2022, eq. 7,
    in variance-preserving form): sqrt(abar_t) and sqrt(1 - abar_t) for unit variance.
    """
    variance = spread**2
    total = variance * alphas + 1 - alphas
    skip = variance * alphas.sqrt() / total
    gain = spread * ((1 - alphas) / total).sqrt()
    return skip.float(), gain.float()


class Diffusion:
    """T steps, t = 0 (almost clean) .. T - 1 (almost pure noise)."""

    def __init__(
        self,
        schedule: Schedule = "cosine",
        parametrization: Parametrization = "skip",
        steps: int = STEPS,
        spread: Tensor | None = None,
    ) -> None:
        """spread: [K] standard deviation of the data; None for 1."""
        if schedule not in SCHEDULES:
            raise ModelError(f"schedule {schedule!r} is not known; use one of {', '.join(SCHEDULES)}")
        if parametrization not in PARAMETRIZATIONS:
            known = ", ".join(PARAMETRIZATIONS)
            raise ModelError(f"parametrization {parametrization!r} is not known; use one of {known}")
        self.schedule: Schedule = schedule
        self.parametrization: Parametrization = parametrization
        self.steps = steps
        self.alphas = cosine_alphas(steps) if schedule == "cosine" else linear_alphas(steps)
        self._signal = self.alphas.sqrt().float()
        self._noise = (1 - self.alphas).sqrt().float()
        sd = torch.ones(1) if spread is None else spread
        self._skip, self._gain = preconditioning(self.alphas[:, None], sd.double())

    def to(self, device: torch.device) -> Diffusion:
        """Itself, with its tables on a device."""
        for name in ("_signal", "_noise", "_skip", "_gain"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def add_noise(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """q(x_t | x0) = N(sqrt(abar_t) x0, (1 - abar_t) I), at the given unit noise; t [*b], x0 [N, *b,
        K].
        """
        signal, level = self._levels(t)
        return signal * x0 + level * noise

    def x0(self, output: Tensor, x_t: Tensor, t: Tensor) -> Tensor:
        """The network's output [N, *b, K] as x0hat.

        `plain` is the paper's: the output itself. `skip`: skip_t x_t + gain_t output, see `preconditioning`: the
        network need not learn a gain that depends on t.
        """
        if self.parametrization == "plain":
            return output
        return self._skip[t] * x_t + self._gain[t] * output

    def _levels(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """sqrt(abar_t) and sqrt(1 - abar_t) of steps t [*b], [*b, 1] each."""
        return self._signal[t][..., None], self._noise[t][..., None]

    def times(self, steps: int | None, rule: Rule) -> list[int]:
        """The diffusion steps that a reverse chain visits, from noise to clean."""
        usual = {"posterior": self.steps, "renoise": RENOISE_STEPS, "ddim": DDIM_STEPS}
        count = usual[rule] if steps is None else steps
        if not 1 <= count <= self.steps:
            raise ModelError(f"{count} sampling steps asked for; a number from 1 to {self.steps} is possible")
        return torch.linspace(self.steps - 1, 0, count).round().int().tolist()

    def reverse(
        self, x_t: Tensor, x0: Tensor, t: int, s: int, rule: Rule, generator: torch.Generator
    ) -> Tensor:
        """x_s from x_t and x0hat, s < t; s = -1 is the clean end, where every rule gives x0hat.

        renoise    the paper's: x_s ~ N(sqrt(abar_s) x0hat, (1 - abar_s) I)
        posterior  q(x_s | x_t, x0hat) of DDPM (Ho et al. 2020, eq. 6-7, for a stride of t - s)
        ddim       deterministic: the noise that x0hat implies is kept (Song et al. 2021, eq. 12, sigma = 0)
        """
        if s < 0:
            return x0
        abar_t, abar_s = float(self.alphas[t]), float(self.alphas[s])
        if rule == "ddim":
            noise = (x_t - math.sqrt(abar_t) * x0) / math.sqrt(1 - abar_t)
            return math.sqrt(abar_s) * x0 + math.sqrt(1 - abar_s) * noise
        noise = torch.randn(x_t.shape, generator=generator)
        if rule == "renoise":
            return math.sqrt(abar_s) * x0 + math.sqrt(1 - abar_s) * noise
        alpha = abar_t / abar_s
        from_x0 = math.sqrt(abar_s) * (1 - alpha) / (1 - abar_t)
        from_xt = math.sqrt(alpha) * (1 - abar_s) / (1 - abar_t)
        variance = (1 - alpha) * (1 - abar_s) / (1 - abar_t)
        return from_x0 * x0 + from_xt * x_t + math.sqrt(variance) * noise

    def sample(
        self,
        predict: Predict,
        shape: tuple[int, ...],
        generator: torch.Generator,
        rule: Rule = "posterior",
        steps: int | None = None,
        overwrite: Overwrite | None = None,
        progress: Progress | None = None,
    ) -> Tensor:
        """Run the whole reverse chain from unit noise of `shape` [N, *b, K].

        overwrite: applied to every x0hat that a step goes on from, e.g. to put known values back into the frames to
        keep (docs/method.md, Editing). The last x0hat is the result as predicted: the caller puts known values back
        exactly. Raises ModelError for an unknown rule or an impossible number of steps.
        """
        if rule not in RULES:
            raise ModelError(f"sampling rule {rule!r} is not known; use one of {', '.join(RULES)}")
        times = self.times(steps, rule)
        x = torch.randn(shape, generator=generator)
        for index, t in enumerate(times):
            x0 = predict(x, t)
            s = times[index + 1] if index + 1 < len(times) else -1
            if overwrite is not None and s >= 0:
                x0 = overwrite(x0)
            x = self.reverse(x, x0, t, s, rule, generator)
            if progress is not None:
                progress(index + 1, len(times))
        return x
