"""Multi-head attention over time whose scores have a bias by distance in time, in blocks of frames."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

HEADS = 4
# Frames whose scores are held at the same time: memory grows with the number of frames, not with its square.
BLOCK = 64

# Distances in time, key - query [Q, M] int64 -> what is added to the scores, [HEADS, Q, M]; -inf: unseen.
Bias = Callable[[Tensor], Tensor]


def attend(query: Tensor, memory: Tensor, bias: Bias, reach: int | None = None) -> Tensor:
    """query [N, *b, C], memory [N, *b, 2C] (keys, then values), b broadcasting -> [N, *b, C].

    reach: frames farther away than this are unseen whatever the bias is; None: all are seen.
    """
    length = len(query)
    keys, values = memory.chunk(2, dim=-1)
    shape = torch.broadcast_shapes(query.shape, keys.shape)
    q, k, v = (_heads(part.expand(shape)) for part in (query, keys, values))
    frames = torch.arange(length, device=query.device)
    blocks = []
    for start in range(0, length, BLOCK):
        rows = slice(start, min(start + BLOCK, length))
        seen = slice(0, length) if reach is None else slice(max(start - reach, 0), rows.stop + reach)
        scores = bias(frames[seen] - frames[rows, None]).to(q.dtype)
        blocks.append(F.scaled_dot_product_attention(q[:, :, rows], k[:, :, seen], v[:, :, seen], scores))
    return torch.cat(blocks, dim=2).permute(2, 0, 1, 3).reshape(shape)


def _heads(x: Tensor) -> Tensor:
    """[N, *b, C] -> [B, HEADS, N, C / HEADS], B the product of b."""
    return x.flatten(1, -2).unflatten(-1, (HEADS, -1)).permute(1, 2, 0, 3)
