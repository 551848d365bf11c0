"""The denoising network: one encoder layer, a full-rate, a half-rate and a restored full-rate block, one
decoder.

Every tensor has time first, `[N, *batch, channels]`: a convolution is then one matrix product a tap on
contiguous rows (no gathering of windows), and any batch shape works, e.g. `[N, 2, samples, K]` under
guidance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# An output frame sees at most this many frames to either side, so chunks with this halo (even, because of
# the half rate) evaluate exactly as the whole does.
HALO = 8
# Two frames at half rate are the least that can be reflected.
MIN_FRAMES = 4


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network; K coefficients a frame, W speech features a frame."""

    coefficients: int
    audio_width: int
    styles: int
    channels: int = 64


@dataclass(frozen=True)
class Condition:
    """What the speech adds to the three condition blocks: the audio half of their convolutions, free of x
    and t.

    full [N, *b, C], half [N/2, *b, 2C], restored [N, *b, C]; b broadcasts against the batch of x.
    """

    full: Tensor
    half: Tensor
    restored: Tensor

    def frames(self, start: int, stop: int) -> Condition:
        """The frames [start, stop), both even."""
        return Condition(self.full[start:stop], self.half[start // 2 : stop // 2], self.restored[start:stop])

    def with_unconditional(self) -> Condition:
        """[N, *b, C] -> [N, 2, *b, C]: the condition, and the zeroed one beside it."""
        parts = (self.full, self.half, self.restored)
        return Condition(*(torch.stack([part, torch.zeros_like(part)], dim=1) for part in parts))


def reflect(x: Tensor) -> Tensor:
    """[N, ...] -> [N + 2, ...], mirrored about the first and the last frame."""
    return torch.cat([x[1:2], x, x[-2:-1]])


class TimeConv(nn.Module):
    """Convolution over time of three taps, reflect padding: [N, *b, in] -> [N, *b, out].

    The frames of a window stand side by side, so that a convolution is one large matrix product.
    """

    def __init__(self, inputs: int, outputs: int, bias: bool = True, taps: int = 3) -> None:
        super().__init__()
        bound = 1 / math.sqrt(taps * inputs)
        self.weight = nn.Parameter(torch.empty(taps, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(outputs).uniform_(-bound, bound)) if bias else None

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        before, after = torch.cat([x[1:2], x[:-1]]), torch.cat([x[1:], x[-2:-1]])
        return self._product([before, x, after], self.weight)

    def _product(self, frames: list[Tensor], weight: Tensor) -> Tensor:
        """Frames side by side, [.., in] each, times the taps of weight [taps, in, out]."""
        return F.linear(torch.cat(frames, dim=-1), weight.flatten(0, 1).T, self.bias)


class Down(TimeConv):
    """Strided convolution of two taps: [N, *b, in] -> [N/2, *b, out], N even."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, taps=2)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        assert len(x) % 2 == 0
        return self._product([x[0::2], x[1::2]], self.weight)


class Up(TimeConv):
    """Transposed convolution of four taps, stride two: [M, *b, in] -> [2M, *b, out].

    Frame 2m is made from half-rate frames m - 1 and m, frame 2m + 1 from m and m + 1.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, taps=4)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        before, after = torch.cat([x[1:2], x[:-1]]), torch.cat([x[1:], x[-2:-1]])
        even = self._product([before, x], self.weight[:2])
        odd = self._product([x, after], self.weight[2:])
        return torch.stack([even, odd], dim=1).flatten(0, 1)


def sinusoidal(steps: Tensor, channels: int) -> Tensor:
    """Diffusion steps [*b] -> their sinusoidal encoding [*b, channels]."""
    half = channels // 2
    rates = torch.exp(-math.log(10_000.0) * torch.arange(half, device=steps.device) / half)
    angles = steps[..., None].float() * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Network(nn.Module):
    """x_t, step, speech and style -> the raw output, of x_t's shape; `Diffusion.x0` turns it into x0hat."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        width = config.channels
        self.encoder = nn.Linear(config.coefficients, width)
        self.step = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.audio = nn.Linear(config.audio_width, width)
        # A convolution over [features, audio] side by side is the sum of one over each: kept apart, the
        # audio's part is computed once for all diffusion steps.
        self.full, self.full_audio = TimeConv(width, width), TimeConv(width, width, bias=False)
        self.down = Down(width, 2 * width)
        self.middle = TimeConv(2 * width, 2 * width)
        self.low, self.low_audio = TimeConv(2 * width, 2 * width), TimeConv(width, 2 * width, bias=False)
        self.up = Up(2 * width, width)
        self.restored, self.restored_audio = TimeConv(width, width), TimeConv(width, width, bias=False)
        self.style = nn.Embedding(config.styles, width)
        self.decoder = nn.Linear(width, config.coefficients)
        nn.init.normal_(self.style.weight, std=0.02)
        nn.init.zeros_(self.decoder.weight)
        nn.init.zeros_(self.decoder.bias)

    def condition(self, audio: Tensor, keep: Tensor | None = None) -> Condition:
        """Standardized speech features [N, *b, W], N even -> what they add to the blocks.

        keep [*b] f32: 0 zeroes the audio condition of that element (the unconditional case), 1 keeps it.
        """
        code = self.audio(audio)
        if keep is not None:
            code = code * keep[..., None]
        pairs = (code[0::2] + code[1::2]) / 2
        return Condition(self.full_audio(code), self.low_audio(pairs), self.restored_audio(code))

    def forward(self, x: Tensor, steps: Tensor, condition: Condition, style: Tensor) -> Tensor:
        """x [N, *b, K] standardized, steps and style integers broadcasting to [*b] -> [N, *b, K]; N even,
        >= 4.
        """
        h = F.silu(self.encoder(x)) + self.step(sinusoidal(steps, self.config.channels).to(x.dtype))
        h = F.silu(self.full(h) + condition.full)
        h = F.silu(self.down(h))
        h = F.silu(self.middle(h))
        h = F.silu(self.low(h) + condition.half)
        h = F.silu(self.up(h))
        h = F.silu(self.restored(h) + condition.restored)
        return self.decoder(h + self.style(style))
