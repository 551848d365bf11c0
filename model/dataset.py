"""Training sequences: motion coefficients with speech features, their statistics, and random crops of
them.
"""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.errors import ModelError

# A coefficient that hardly moves is not blown up to unit variance: its scale is at least this share of the
# largest.
SMALLEST_SCALE = 0.01


@dataclass(frozen=True)
class Sequence:
    """One stretch of motion at 30 fps with the speech features of the same frames.

    coefficients [N, K] f32 m. features [N, W] f32. valid [N] bool, frames that may be learned from and
    judged.
    style: row of the style table.
    """

    coefficients: NDArray[np.float32]
    features: NDArray[np.float32]
    valid: NDArray[np.bool_]
    style: int = 0

    def __post_init__(self) -> None:
        """Raises ModelError where the lengths disagree or a valid frame is not finite."""
        lengths = len(self.coefficients), len(self.features), len(self.valid)
        if len(set(lengths)) != 1:
            raise ModelError(
                f"coefficients, features and valid must have as many frames each; they have {lengths}"
            )
        if not (np.isfinite(self.coefficients[self.valid]).all() and np.isfinite(self.features).all()):
            raise ModelError("the motion or the speech features hold values that are not finite")


@dataclass(frozen=True)
class Standardization:
    """What maps a person's numbers to the network's: coefficients [K] m and speech features [W], mean and scale.

    spread: [K] standard deviation of the standardized coefficients, 1 where the scale is their own.
    """

    mean: NDArray[np.float32]
    scale: NDArray[np.float32]
    spread: NDArray[np.float32]
    audio_mean: NDArray[np.float32]
    audio_scale: NDArray[np.float32]

    @classmethod
    def of(cls, sequences: Many[Sequence]) -> Standardization:
        """Statistics over the valid frames of all sequences; ModelError where there are none."""
        motion = np.concatenate([s.coefficients[s.valid] for s in sequences]).astype(np.float64)
        audio = np.concatenate([s.features[s.valid] for s in sequences]).astype(np.float64)
        if len(motion) < 2:
            raise ModelError(f"{len(motion)} valid frames of motion: there is nothing to learn from")
        mean, sd, audio_scale = motion.mean(axis=0), motion.std(axis=0), audio.std(axis=0)
        if sd.max() <= 0:
            raise ModelError("the motion does not move at all: there is nothing to learn from")
        scale = np.maximum(sd, SMALLEST_SCALE * sd.max())
        return cls(
            mean=mean.astype(np.float32),
            scale=scale.astype(np.float32),
            spread=(sd / scale).astype(np.float32),
            audio_mean=audio.mean(axis=0).astype(np.float32),
            audio_scale=np.maximum(audio_scale, 1e-6 + SMALLEST_SCALE * audio_scale.max()).astype(np.float32),
        )

    def motion(self, coefficients: NDArray[np.float32]) -> Tensor:
        """Coefficients [..., K] m -> standardized, f32."""
        return torch.from_numpy(((coefficients - self.mean) / self.scale).astype(np.float32))

    def metres(self, standardized: Tensor) -> NDArray[np.float32]:
        """Standardized [..., K] -> coefficients, m."""
        return standardized.numpy() * self.scale + self.mean

    def audio(self, features: NDArray[np.float32]) -> Tensor:
        """Speech features [..., W] -> standardized, f32."""
        return torch.from_numpy(((features - self.audio_mean) / self.audio_scale).astype(np.float32))


@dataclass(frozen=True)
class Batch:
    """Time first, as the network wants it: motion [N, B, K], audio [N, B, W], style [B] int64."""

    motion: Tensor
    audio: Tensor
    style: Tensor

    def part(self, rows: slice) -> Batch:
        """Some of its crops."""
        return Batch(self.motion[:, rows], self.audio[:, rows], self.style[rows])


class Crops:
    """All crops of `length` frames that lie inside runs of valid frames, equally likely."""

    def __init__(
        self,
        sequences: Many[Sequence],
        standardization: Standardization,
        length: int,
        device: str | torch.device = "cpu",
        blinks: NDArray[np.float32] | None = None,
    ) -> None:
        """device: that batches are made on. blinks: [S, N, K] m by style, of which each crop gets some moment's added
        (`model.blinks`). Raises ModelError where no run of valid frames is long enough."""
        starts, offset = [], 0
        for sequence in sequences:
            runs = np.convolve(sequence.valid, np.ones(length, dtype=int), mode="full")[length - 1 :]
            starts.append(offset + np.flatnonzero(runs[: len(sequence.valid) - length + 1] == length))
            offset += len(sequence.valid)
        self._starts = torch.from_numpy(np.concatenate(starts))
        if len(self._starts) == 0:
            raise ModelError(
                f"no {length} consecutive valid frames: too little of the face was tracked to learn from"
            )
        motion = standardization.motion(np.nan_to_num(np.concatenate([s.coefficients for s in sequences])))
        audio = standardization.audio(np.concatenate([s.features for s in sequences]))
        style = torch.from_numpy(np.concatenate([np.full(len(s.valid), s.style) for s in sequences]))
        self._motion, self._audio, self._style = motion.to(device), audio.to(device), style.to(device)
        self._within = torch.arange(length)[:, None]
        self._blinks = None
        if blinks is not None:
            self._blinks = torch.from_numpy(blinks / standardization.scale).to(device)

    def __len__(self) -> int:
        return len(self._starts)

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        """`count` random crops."""
        first = self._starts[torch.randint(len(self._starts), (count,), generator=generator)]
        index = (first + self._within).to(self._motion.device)
        motion, style = self._motion[index], self._style[index[0]]
        if self._blinks is not None:
            last = self._blinks.shape[1] - len(self._within)
            moment = torch.randint(last + 1, (count,), generator=generator) + self._within
            motion = motion + self._blinks[style, moment.to(motion.device)]
        return Batch(motion, self._audio[index], style)
