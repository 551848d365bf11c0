"""Sound of any length for an encoder of bounded context: one level, and windows that fade into each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

SAMPLE_RATE = 16000  # Hz
WINDOW = 1500  # rows: 30 s, what Whisper's position code was made for
OVERLAP = 500  # rows two windows share: 10 s


class SpeechError(ValueError):
    """Sound that cannot be encoded; the message says what is wrong."""


def peak_normalized(audio: NDArray[np.float32], shortest: int) -> Tensor:
    """Mono sound [S] f32 -> [max(S, shortest)] with a peak of 1, silence behind it.

    Raises SpeechError on empty or non-finite sound, and on more than one channel.
    """
    if audio.ndim != 1 or len(audio) == 0 or not np.isfinite(audio).all():
        raise SpeechError(f"sound of shape {audio.shape}: one channel of finite samples is needed")
    sound = torch.from_numpy(np.ascontiguousarray(audio, np.float32))
    return F.pad(sound / sound.abs().max().clamp(min=1e-8), (0, max(0, shortest - len(sound))))


def in_windows(
    rows: int,
    width: int,
    encode: Callable[[int, int], Tensor],
    window: int = WINDOW,
    overlap: int = OVERLAP,
) -> Tensor:
    """Features [rows, width] of which `encode(first, stop)` gives at most `window` rows at a time."""
    total = torch.zeros(rows, width)
    weights = torch.zeros(rows, 1)
    for start in window_starts(rows, window, overlap):
        stop = min(start + window, rows)
        fade = fade_weights(stop - start, overlap)
        total[start:stop] += fade * encode(start, stop)
        weights[start:stop] += fade
    return total / weights


def window_starts(rows: int, window: int = WINDOW, overlap: int = OVERLAP) -> list[int]:
    """First rows of the windows that cover `rows`; the last window is full too, so context is never short."""
    last = max(0, rows - window)
    return [*range(0, last, window - overlap), last]


def fade_weights(rows: int, overlap: int = OVERLAP) -> Tensor:
    """Weight [rows, 1] of a window's rows: up over the overlap, flat, down again; never zero."""
    edge = torch.minimum(torch.arange(1, rows + 1), torch.arange(rows, 0, -1))
    return edge.clamp(max=overlap)[:, None].float()
