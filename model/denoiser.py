"""What all denoising networks share: sizes, the condition that speech becomes, and the layers at both ends.

Every tensor has time first, `[N, *batch, channels]`: any batch shape works, e.g. `[N, 2, samples, K]` under
guidance.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Architecture = Literal["conv", "attention", "transformer"]

# Two frames at half rate are the least that can be reflected.
MIN_FRAMES = 4


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network; K coefficients a frame, W speech features a frame.

    architecture: `conv` is the paper's; `attention` and `transformer` are those of its ablation.
    """

    coefficients: int
    audio_width: int
    styles: int
    channels: int = 64
    architecture: Architecture = "conv"


@dataclass(frozen=True)
class Condition:
    """What the speech gives to each block that hears it, in their order; free of x and t.

    parts: each [N, *b, .], or [N/2, *b, .] for a block at half rate, the first at full rate; b broadcasts
    against the batch of x.
    """

    parts: tuple[Tensor, ...]

    def frames(self, start: int, stop: int) -> Condition:
        """The frames [start, stop), both even."""
        rates = (len(self.parts[0]) // len(part) for part in self.parts)
        return Condition(
            tuple(part[start // rate : stop // rate] for part, rate in zip(self.parts, rates, strict=True))
        )

    def with_unconditional(self) -> Condition:
        """[N, *b, .] -> [N, 2, *b, .]: the condition, and the zeroed one beside it."""
        return Condition(tuple(torch.stack([part, torch.zeros_like(part)], dim=1) for part in self.parts))


def sinusoidal(numbers: Tensor, channels: int) -> Tensor:
    """Diffusion steps or frame numbers [*b] -> their sinusoidal encoding [*b, channels]."""
    half = channels // 2
    rates = torch.exp(-math.log(10_000.0) * torch.arange(half, device=numbers.device) / half)
    angles = numbers[..., None].float() * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Denoiser(nn.Module, ABC):
    """x_t, step, speech and style -> the raw output, of x_t's shape; `Diffusion.x0` turns it into x0hat.

    halo: an output frame sees at most this many frames to either side, even: chunks with this halo evaluate
    exactly as the whole does. None where it sees all frames, so that a motion must be evaluated whole.
    """

    halo: int | None

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        width = config.channels
        self.encoder = nn.Linear(config.coefficients, width)
        self.step = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.audio = nn.Linear(config.audio_width, width)
        self.style = nn.Embedding(config.styles, width)
        self.decoder = nn.Linear(width, config.coefficients)
        nn.init.normal_(self.style.weight, std=0.02)
        nn.init.zeros_(self.decoder.weight)
        nn.init.zeros_(self.decoder.bias)

    @abstractmethod
    def condition(self, audio: Tensor, keep: Tensor | None = None) -> Condition:
        """Standardized speech features [N, *b, W], N even -> what they give to the blocks.

        keep [*b] f32: 0 zeroes the audio condition of that element (the unconditional case), 1 keeps it.
        """

    @abstractmethod
    def forward(self, x: Tensor, steps: Tensor, condition: Condition, style: Tensor) -> Tensor:
        """x [N, *b, K] standardized, steps and style integers broadcasting to [*b] -> [N, *b, K]; N even,
        >= MIN_FRAMES.
        """

    def moving_parameters(self) -> list[nn.Parameter]:
        """All but those through which the speech passes on its way to the motion."""
        hearing = ("audio", "speech")
        named = self.named_parameters()
        return [value for name, value in named if not any(part in name for part in hearing)]

    def encode(self, x: Tensor, steps: Tensor) -> Tensor:
        """Motion [N, *b, K] and its diffusion step -> [N, *b, C]."""
        return F.silu(self.encoder(x)) + self.step(sinusoidal(steps, self.config.channels).to(x.dtype))

    def hear(self, audio: Tensor, keep: Tensor | None) -> Tensor:
        """Speech features [N, *b, W] -> the audio condition [N, *b, C], zeroed where keep [*b] is 0."""
        code = self.audio(audio)
        return code if keep is None else code * keep[..., None]

    def decode(self, h: Tensor, style: Tensor) -> Tensor:
        """[N, *b, C], in this style -> [N, *b, K]."""
        return self.decoder(h + self.style(style))
