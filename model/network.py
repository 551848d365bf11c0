"""The paper's denoising network: a full-rate, a half-rate and a restored full-rate block of convolutions."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.denoiser import Condition, Denoiser, NetworkConfig

# An output frame sees at most this many frames to either side, so chunks with this halo (even, because of
# the half rate) evaluate exactly as the whole does.
HALO = 8


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


class Network(Denoiser):
    """The paper's: convolutions over time, each block followed by one that sees the speech beside the motion
    (docs/method.md).
    """

    halo = HALO
    full_audio: nn.Module
    low_audio: nn.Module
    restored_audio: nn.Module

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        width = config.channels
        # A convolution over [features, audio] side by side is the sum of one over each: kept apart, the
        # audio's part is computed once for all diffusion steps.
        self.full, self.full_audio = TimeConv(width, width), TimeConv(width, width, bias=False)
        self.down = Down(width, 2 * width)
        self.middle = TimeConv(2 * width, 2 * width)
        self.low, self.low_audio = TimeConv(2 * width, 2 * width), TimeConv(width, 2 * width, bias=False)
        self.up = Up(2 * width, width)
        self.restored, self.restored_audio = TimeConv(width, width), TimeConv(width, width, bias=False)

    def condition(self, audio: Tensor, keep: Tensor | None = None) -> Condition:
        """What the speech adds to the three condition blocks: the audio half of their convolutions."""
        code = self.hear(audio, keep)
        pairs = (code[0::2] + code[1::2]) / 2
        return Condition((self.full_audio(code), self.low_audio(pairs), self.restored_audio(code)))

    def forward(self, x: Tensor, steps: Tensor, condition: Condition, style: Tensor) -> Tensor:
        """See `Denoiser`."""
        full, half, restored = condition.parts
        h = self.encode(x, steps)
        h = F.silu(self.full(h) + full)
        h = F.silu(self.down(h))
        h = F.silu(self.middle(h))
        h = F.silu(self.low(h) + half)
        h = F.silu(self.up(h))
        h = F.silu(self.restored(h) + restored)
        return self.decode(h, style)
