"""Ablation: FaceFormer's transformer decoder as the denoising network (the paper's Table 3a).

FaceFormer (Fan et al. 2022) decodes frame by frame; a denoiser sees all frames at once, so the bias of its
self-attention is mirrored here instead of causal.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.attention import HEADS, attend
from model.denoiser import Condition, Denoiser, NetworkConfig, sinusoidal

LAYERS = 4
# FaceFormer's positions repeat: a position beyond the longest training crop would be one never seen.
PERIOD = 30


class SelfAttention(nn.Module):
    """Attention over all frames, [N, *b, C] -> [N, *b, C]; a score falls with the distance in time.

    Head i of H loses 2^(-8 i / H) a frame (Press et al. 2022), which holds beyond the length of a training crop;
    FaceFormer's own bias, a step every PERIOD frames, is 0 within a crop and untrained beyond it.
    """

    slopes: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query, self.memory = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, width)
        slopes = 2.0 ** (-8 * torch.arange(1, HEADS + 1) / HEADS)
        self.register_buffer("slopes", slopes[:, None, None], persistent=False)

    def forward(self, h: Tensor) -> Tensor:
        """See the class. Time grows with N^2, memory with N."""
        return self.output(
            attend(self.query(h), self.memory(h), lambda distance: -self.slopes * distance.abs())
        )


class Layer(nn.Module):
    """Self-attention, attention to the speech, feed-forward, each with a residual connection; normalized before."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.attention_norm, self.attention = nn.LayerNorm(width), SelfAttention(width)
        self.feed_forward = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width)
        )

    def forward(self, h: Tensor, speech: Tensor) -> Tensor:
        """h [N, *b, C] and what its attention to the speech gives, b broadcasting -> [N, *b, C]."""
        h = h + self.attention(self.attention_norm(h)) + speech
        return h + self.feed_forward(h)


class TransformerNetwork(Denoiser):
    """A stack of decoder layers over the frames, each with self-attention and attention to the speech."""

    halo = None

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.layers = nn.ModuleList(Layer(config.channels) for _ in range(LAYERS))
        self.norm = nn.LayerNorm(config.channels)
        # FaceFormer's alignment lets a frame attend to its own speech alone, whose weight is 1 whatever query and
        # key are: of the cross-attention the value is left, free of x and t.
        self.speech = nn.Linear(config.channels, LAYERS * config.channels, bias=False)

    def condition(self, audio: Tensor, keep: Tensor | None = None) -> Condition:
        """What the attention to the speech gives in each layer."""
        return Condition(self.speech(self.hear(audio, keep)).chunk(LAYERS, dim=-1))

    def forward(self, x: Tensor, steps: Tensor, condition: Condition, style: Tensor) -> Tensor:
        """See `Denoiser`."""
        h = self.encode(x, steps)
        positions = sinusoidal(torch.arange(len(h), device=h.device) % PERIOD, h.shape[-1]).to(h.dtype)
        h = h + positions.view(len(h), *[1] * (h.ndim - 2), -1)
        for layer, speech in zip(self.layers, condition.parts, strict=True):
            h = layer(h, speech)
        return self.decode(self.norm(h), style)
