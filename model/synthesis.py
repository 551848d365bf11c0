"""Speech features to motion: guided sampling of any length, in bounded memory, with frames that may be
kept.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.checkpoint import Checkpoint
from model.dataset import Standardization
from model.denoiser import MIN_FRAMES, Condition, Denoiser
from model.diffusion import Diffusion, Overwrite, Progress, Rule
from model.errors import ModelError
from model.vertex_mask import VertexMask

# Frames x samples of one evaluation: small enough for the processor's cache, large enough for its matrix
# products.
CHUNK_ROWS = 1024
# Two cores are what everyone has, and a chunk is too small to be shared out itself.
WORKERS = 2


@dataclass(frozen=True)
class Keep:
    """What to keep: coefficients [N, K] m, and which of them are known, [N] or [N, K] bool.

    vertices: parts of the face to keep in other frames. What single vertices look like in the end is outside the
    basis: `model.editing.edit` puts them back, `synthesize` returns the coefficients of the free ones.
    """

    coefficients: NDArray[np.float32]
    mask: NDArray[np.bool_]
    vertices: VertexMask | None = None

    @property
    def where(self) -> NDArray[np.bool_]:
        """The mask, [N, 1] or [N, K]."""
        return self.mask if self.mask.ndim == 2 else self.mask[:, None]

    def overwrite(self, standardization: Standardization) -> Overwrite:
        """Puts the known values into a standardized x0hat [>= N, S, K], leaving a padded tail alone."""
        mask = torch.from_numpy(self.where)[:, None]
        known = standardization.motion(np.nan_to_num(self.coefficients))[:, None]
        keep_vertices = None if self.vertices is None else self.vertices.overwrite(standardization)

        def overwrite(x0: Tensor) -> Tensor:
            x0 = x0.clone() if keep_vertices is None else keep_vertices(x0)
            x0[: len(mask)] = torch.where(mask, known, x0[: len(mask)])
            return x0

        return overwrite


class Guided:
    """x0hat = u + s (c - u) for one audio, any number of samples; long motions in chunks with an exact halo, where the
    network has one, side by side on the processor's cores.
    """

    def __init__(
        self, network: Denoiser, diffusion: Diffusion, audio: Tensor, style: int, guidance: float, chunk: int
    ) -> None:
        """audio [N, W] standardized, N even; chunk: frames evaluated together, even, at least four halos."""
        self._network, self._diffusion = network, diffusion
        self._condition = network.condition(audio[:, None]).with_unconditional()
        self._style = torch.tensor(style)
        self._guidance = guidance
        self._halo = network.halo or 0
        self._chunk = len(audio) if network.halo is None else max(chunk, 4 * network.halo)
        self._workers = ThreadPoolExecutor(WORKERS)

    def __call__(self, x: Tensor, t: int) -> Tensor:
        """x [N, S, K] at diffusion step t -> x0hat [N, S, K]."""
        return torch.cat(list(self._workers.map(partial(self._piece, x, t), range(0, len(x), self._chunk))))

    @torch.inference_mode()
    def _piece(self, x: Tensor, t: int, start: int) -> Tensor:
        """x0hat of the chunk that begins at frame `start`."""
        stop = min(start + self._chunk, len(x))
        first, last = max(start - self._halo, 0), min(stop + self._halo, len(x))
        piece = self._evaluate(x[first:last], t, self._condition.frames(first, last))
        return piece[start - first : stop - first]

    def _evaluate(self, x: Tensor, t: int, condition: Condition) -> Tensor:
        """Both branches in one batch; what comes before the first condition is the same for both, and made once."""
        step, both = torch.tensor(t), x[:, None]
        output = self._network(both, step, condition, self._style)
        conditional, unconditional = self._diffusion.x0(output, both, step).unbind(dim=1)
        return unconditional + self._guidance * (conditional - unconditional)


class Sampling(TypedDict, total=False):
    """How `synthesize` draws; what is left out is its default."""

    style: str | None
    guidance: float | None
    samples: int
    seed: int
    rule: Rule
    steps: int | None
    progress: Progress | None


@torch.inference_mode()
def synthesize(
    checkpoint: Checkpoint,
    features: NDArray[np.float32],
    *,
    style: str | None = None,
    guidance: float | None = None,
    samples: int = 1,
    seed: int = 0,
    rule: Rule = "posterior",
    steps: int | None = None,
    keep: Keep | None = None,
    progress: Progress | None = None,
) -> NDArray[np.float32]:
    """Speech features [N, W] at the motion's frames -> coefficients [samples, N, K] m.

    style: a name of the checkpoint's styles; None for the subject. guidance: s; None for the checkpoint's
    own.
    keep: known values, put into every step's x0hat and returned exactly.
    The same arguments give the same bytes. Raises ModelError for features of another width, an unknown
    style or rule.
    """
    if features.ndim != 2 or features.shape[1] != checkpoint.config.audio_width or len(features) == 0:
        width = checkpoint.config.audio_width
        raise ModelError(
            f"speech features of shape {features.shape}; this checkpoint takes [frames, {width}]"
        )
    if samples < 1:
        raise ModelError(f"{samples} samples asked for; at least one is possible")
    length = len(features)
    padded = max(length + length % 2, MIN_FRAMES)
    audio = checkpoint.standardization.audio(features)
    audio = torch.cat([audio, audio[-1:].expand(padded - length, -1)])
    diffusion = checkpoint.diffusion()
    predict = Guided(
        checkpoint.model(),
        diffusion,
        audio,
        checkpoint.style(style),
        checkpoint.guidance if guidance is None else guidance,
        chunk=min(CHUNK_ROWS // samples, -(-padded // WORKERS)) // 2 * 2 + 2,
    )
    overwrite = None
    if keep is not None:
        if keep.coefficients.shape != (length, checkpoint.config.coefficients):
            raise ModelError(f"kept motion of shape {keep.coefficients.shape} for {length} frames of speech")
        overwrite = keep.overwrite(checkpoint.standardization)
    x = diffusion.sample(
        predict,
        (padded, samples, checkpoint.config.coefficients),
        torch.Generator().manual_seed(seed),
        rule,
        steps,
        overwrite,
        progress,
    )
    drawn = checkpoint.standardization.metres(x[:length]).transpose(1, 0, 2)
    if keep is not None:
        # In metres: the way through the standardization and back would round.
        drawn = np.where(keep.where, keep.coefficients, drawn)
    return np.ascontiguousarray(drawn, np.float32)
