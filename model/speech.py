"""Speech features behind one interface: the embedded encoder, or one that the user gives."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from model.transformers_encoder import user_encoder
from model.whisper_encoder import embedded_encoder


class SpeechEncoder(Protocol):
    """A frozen speech encoder.

    name: the weights' family and the sha256 of their files; a checkpoint is bound to it. width: channels of a row.
    rate: rows a second.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def width(self) -> int: ...  # noqa: D102
    @property
    def rate(self) -> float: ...  # noqa: D102

    def encode(self, audio: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Features [M, width] f32 of mono sound [S] f32 at 16 kHz, and the rows' times [M] s from its start.

        Sound of any length is encoded whole, in bounded memory beside the result. A gain changes nothing.
        Raises SpeechError on empty or non-finite sound.
        """


def load_encoder(source: str | Path | None = None) -> SpeechEncoder:
    """The embedded encoder; or, given a folder or a hub name, that one (see `model.transformers_encoder`).

    Raises ModelError for a source that is no such encoder.
    """
    return embedded_encoder() if source is None else user_encoder(str(source))


def resample(
    features: NDArray[np.float32], times: NDArray[np.float64], at: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Features [M, W] at `times` [M] s, interpolated linearly at times [N] s -> [N, W]; ends are held."""
    place = np.interp(at, times, np.arange(len(times)))
    before = np.floor(place).astype(np.int64)
    after = np.minimum(before + 1, len(times) - 1)
    share = (place - before)[:, None].astype(np.float32)
    return features[before] * (1 - share) + features[after] * share
