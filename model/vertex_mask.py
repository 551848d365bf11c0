"""Parts of the face kept while others are made anew: the overwrite of single vertices, in K dimensions.

In vertex space every denoising step overwrites x0hat <- m known + (1 - m) x0hat, vertex by vertex, m [D] in 0..1
(docs/method.md). The network sees the chain through the basis B [K, 3D] alone, and the reverse rules are linear in
x0hat, x_t and noise; so what it sees is exactly, with x0hat = c B,

    c <- c B diag(1 - m) B' + (m known) B'

for every rule, though the overwritten x0hat leaves the span. The last x0hat is not overwritten here: its free
vertices are the result, beside the known ones. Under `skip` the skipped x_t is projected onto the span, as everywhere
(docs/method.md), so x0hat lies in it: what a kept vertex has outside the span, and noise outside it, are not skipped
along. A skip of the raw x_t would give the free vertices that noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.dataset import Standardization
from model.diffusion import Overwrite
from model.motion import Motion

F64 = NDArray[np.float64]


def masked(basis: NDArray[np.floating], share: NDArray[np.floating]) -> F64:
    """[K, K] B diag(m) B': what coefficients of an orthonormal basis [K, D, 3] become where vertices move by the share
    m [D] of it.
    """
    flat = basis.reshape(len(basis), -1).astype(np.float64)
    return (flat * np.repeat(share.astype(np.float64), 3)) @ flat.T


@dataclass(frozen=True)
class VertexMask:
    """frames [N] bool: where it holds. free [K, K] = B diag(1 - m) B'. kept [N, K] = (m known) B', m."""

    frames: NDArray[np.bool_]
    free: F64
    kept: F64

    @classmethod
    def of(
        cls,
        basis: NDArray[np.floating],
        share: NDArray[np.floating],
        known: Motion,
        frames: NDArray[np.bool_],
    ) -> VertexMask:
        """basis [K, D, 3] orthonormal; share: m [D]; known: N frames of the same mesh in any basis; frames [N]."""
        flat = basis.reshape(len(basis), -1).astype(np.float64)
        m = np.repeat(share.astype(np.float64), 3)
        theirs = known.basis.reshape(len(known.basis), -1).astype(np.float64)
        coefficients = np.where(frames[:, None], known.coefficients, 0).astype(np.float64)
        return cls(frames, masked(basis, 1 - share), coefficients @ (theirs * m @ flat.T))

    def overwrite(self, standardization: Standardization) -> Overwrite:
        """For standardized x0hat [>= N, *b, K] with c = mean + scale x0hat; frames past N stay as they are."""
        mean, scale = (value.astype(np.float64) for value in (standardization.mean, standardization.scale))
        rows = torch.from_numpy(np.flatnonzero(self.frames))
        free = torch.from_numpy(scale[:, None] * self.free / scale)
        kept = torch.from_numpy((mean @ self.free + self.kept[self.frames] - mean) / scale)

        def overwrite(x0: Tensor) -> Tensor:
            batch = (len(rows),) + (1,) * (x0.ndim - 2) + (kept.shape[-1],)
            x0 = x0.clone()
            x0[rows] = x0[rows] @ free.to(x0) + kept.to(x0).view(batch)
            return x0

        return overwrite
