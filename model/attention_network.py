"""Ablation: the paper's network with attention to the speech in place of concatenation (its Table 3a)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.attention import HEADS, attend
from model.denoiser import Condition, NetworkConfig
from model.network import Network

# A frame attends to the speech of this many frames to either side of it, at half rate twice as far.
REACH = 4


class SpeechAttention(nn.Module):
    """Attention of motion [N, *b, C] to the speech around each frame, with a residual connection.

    The window moves with the frame: what is learned on short crops holds anywhere in a long motion, which attention
    over the whole clip would not give. Without biases on the speech's side, speech of zeros adds nothing.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.query = nn.Linear(width, width)
        self.offset = nn.Parameter(torch.zeros(HEADS, 2 * REACH + 1))
        self.output = nn.Linear(width, width, bias=False)

    def forward(self, h: Tensor, memory: Tensor) -> Tensor:
        """h [N, *b, C], memory [N, *b, 2C] keys and values, b broadcasting -> [N, *b, C]."""
        return h + self.output(attend(self.query(self.norm(h)), memory, self._bias, REACH))

    def _bias(self, distance: Tensor) -> Tensor:
        """A learned number for each distance of the window: scores themselves know nothing of time."""
        bias = self.offset[:, distance.clamp(-REACH, REACH) + REACH]
        return bias.masked_fill(distance.abs() > REACH, -math.inf)


class AttentionNetwork(Network):
    """`Network`, each of whose condition blocks attends to the speech at its own rate before it convolves."""

    # Beyond what is convolved, attention reaches 4 frames at full rate and 4 pairs at half rate: 13, made even.
    halo = 14

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        width = config.channels
        # Keys and values are free of x and t: they are what the condition holds.
        self.full_audio = nn.Linear(width, 2 * width, bias=False)
        self.low_audio = nn.Linear(width, 4 * width, bias=False)
        self.restored_audio = nn.Linear(width, 2 * width, bias=False)
        self.full_attention = SpeechAttention(width)
        self.low_attention = SpeechAttention(2 * width)
        self.restored_attention = SpeechAttention(width)

    def forward(self, x: Tensor, steps: Tensor, condition: Condition, style: Tensor) -> Tensor:
        """See `Denoiser`."""
        full, half, restored = condition.parts
        h = self.encode(x, steps)
        h = F.silu(self.full(self.full_attention(h, full)))
        h = F.silu(self.down(h))
        h = F.silu(self.middle(h))
        h = F.silu(self.low(self.low_attention(h, half)))
        h = F.silu(self.up(h))
        h = F.silu(self.restored(self.restored_attention(h, restored)))
        return self.decode(h, style)
