"""Speech features: the first blocks of Whisper's encoder over a whole clip, one row every 20 ms."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from torch import Tensor
from torch.nn import functional as F

SAMPLE_RATE = 16000  # Hz
N_FFT = 400  # 25 ms window
HOP = 160  # 10 ms a mel frame
N_MELS = 80
STRIDE = 2  # mel frames a feature row: the second convolution halves the rate
RATE = SAMPLE_RATE / (HOP * STRIDE)  # 50 feature rows a second; row k is centred at k / RATE
WINDOW = 1500  # rows the position code was made for: 30 s
OVERLAP = 500  # rows two windows share: 10 s
HEADS = 6
ASSET = Path(__file__).parent / "assets" / "speech_encoder.safetensors"


class SpeechError(ValueError):
    """Sound that cannot be encoded; the message says what is wrong."""


@dataclass(frozen=True)
class SpeechEncoder:
    """A frozen speech encoder.

    name: weights' name and the sha256 of their file; a checkpoint is bound to it. width: channels of a row.
    rate: rows a second; row k is centred at k / rate seconds.
    """

    name: str
    width: int
    rate: float
    tensors: dict[str, Tensor]

    @torch.inference_mode()
    def encode(self, audio: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Features [M, width] f32 of mono sound [S] f32 at 16 kHz, and the rows' times [M] s from its start.

        The level is normalized by the peak, so a gain changes nothing. Sound of any length is encoded whole:
        windows of 30 s share 10 s and fade into each other. Raises SpeechError on empty or non-finite sound.
        """
        if audio.ndim != 1 or len(audio) == 0 or not np.isfinite(audio).all():
            raise SpeechError(f"sound of shape {audio.shape}: one channel of finite samples is needed")
        sound = torch.from_numpy(np.ascontiguousarray(audio, np.float32))
        sound = F.pad(sound / sound.abs().max().clamp(min=1e-8), (0, max(0, N_FFT - len(sound))))
        rows = self._embed(log_mel(sound))
        total = torch.zeros_like(rows)
        weights = torch.zeros(len(rows), 1)
        for start in window_starts(len(rows)):
            window = rows[start : start + WINDOW]
            fade = fade_weights(len(window))
            total[start : start + WINDOW] += fade * self._attend(window)
            weights[start : start + WINDOW] += fade
        return (total / weights).numpy(), np.arange(len(rows)) / self.rate

    def _embed(self, mel: Tensor) -> Tensor:
        """Mel frames [80, L] -> rows [M, width] before positions; the second convolution halves the rate."""
        t = self.tensors
        hidden = F.gelu(F.conv1d(mel[None], t["conv1.weight"], t["conv1.bias"], padding=1))
        hidden = F.gelu(F.conv1d(hidden, t["conv2.weight"], t["conv2.bias"], stride=STRIDE, padding=1))
        return hidden[0].T

    def _attend(self, rows: Tensor) -> Tensor:
        """The transformer blocks over one window: [M <= 1500, width] -> [M, width]."""
        hidden = rows + positions(len(rows), self.width)
        block = 0
        while f"blocks.{block}.qkv.weight" in self.tensors:
            hidden = hidden + self._attention(hidden, block)
            inner = F.gelu(self._linear(self._norm(hidden, f"blocks.{block}.mlp_norm"), f"blocks.{block}.up"))
            hidden = hidden + self._linear(inner, f"blocks.{block}.down")
            block += 1
        return hidden

    def _attention(self, hidden: Tensor, block: int) -> Tensor:
        normed = self._norm(hidden, f"blocks.{block}.attention_norm")
        qkv = self._linear(normed, f"blocks.{block}.qkv").reshape(len(hidden), 3, HEADS, -1)
        query, key, value = qkv.permute(1, 2, 0, 3)[:, None]  # each [1, heads, M, width / heads]
        mixed = F.scaled_dot_product_attention(query, key, value)[0]
        return self._linear(mixed.transpose(0, 1).reshape(hidden.shape), f"blocks.{block}.out")

    def _linear(self, hidden: Tensor, name: str) -> Tensor:
        return F.linear(hidden, self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"])

    def _norm(self, hidden: Tensor, name: str) -> Tensor:
        t = self.tensors
        return F.layer_norm(hidden, (self.width,), t[f"{name}.weight"], t[f"{name}.bias"])


@lru_cache(maxsize=1)
def load_encoder() -> SpeechEncoder:
    """The embedded encoder: Whisper tiny.en to its third block, as tools/build_speech_encoder.py made it."""
    digest = hashlib.sha256(ASSET.read_bytes()).hexdigest()
    with safe_open(ASSET, framework="pt") as stored:
        tensors = {key: stored.get_tensor(key).float() for key in stored.keys()}  # noqa: SIM118
        name = stored.metadata()["name"]
    return SpeechEncoder(f"{name}@{digest}", len(tensors["conv2.bias"]), RATE, tensors)


def resample(
    features: NDArray[np.float32], times: NDArray[np.float64], at: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Features [M, W] at `times` [M] s, interpolated linearly at times [N] s -> [N, W]; ends are held."""
    place = np.interp(at, times, np.arange(len(times)))
    before = np.floor(place).astype(np.int64)
    after = np.minimum(before + 1, len(times) - 1)
    share = (place - before)[:, None].astype(np.float32)
    return features[before] * (1 - share) + features[after] * share


def log_mel(sound: Tensor) -> Tensor:
    """Whisper's log-mel spectrogram of sound [S >= 201] at 16 kHz -> [80, S // 160], centred at j / 100 s."""
    window = torch.hann_window(N_FFT)
    spectrum = torch.stft(sound, N_FFT, HOP, window=window, return_complex=True)[:, :-1]
    energy = mel_filters() @ spectrum.abs().square()
    level = energy.clamp(min=1e-10).log10()
    return (torch.maximum(level, level.max() - 8.0) + 4.0) / 4.0


@lru_cache(maxsize=1)
def mel_filters() -> Tensor:
    """Slaney's triangular mel filters of unit area, [80, 201]: linear below 1 kHz, logarithmic above."""
    break_hz, hz_a_mel, log_step = 1000.0, 200.0 / 3.0, np.log(6.4) / 27.0
    break_mel = break_hz / hz_a_mel
    top = break_mel + np.log(SAMPLE_RATE / 2 / break_hz) / log_step
    mels = np.linspace(0.0, top, N_MELS + 2)
    above = break_hz * np.exp(log_step * np.maximum(mels - break_mel, 0.0))
    edges = np.where(mels < break_mel, mels * hz_a_mel, above)
    bins = np.linspace(0.0, SAMPLE_RATE / 2, N_FFT // 2 + 1)
    rise = (bins - edges[:-2, None]) / (edges[1:-1] - edges[:-2])[:, None]
    fall = (edges[2:, None] - bins) / (edges[2:] - edges[1:-1])[:, None]
    filters = np.maximum(0.0, np.minimum(rise, fall)) * (2.0 / (edges[2:] - edges[:-2]))[:, None]
    return torch.from_numpy(filters.astype(np.float32))


def positions(length: int, width: int) -> Tensor:
    """Whisper's sinusoidal position code [length, width]: sines, then cosines."""
    scales = torch.exp(-np.log(10000.0) / (width // 2 - 1) * torch.arange(width // 2))
    angles = torch.arange(length)[:, None] * scales
    return torch.cat([angles.sin(), angles.cos()], dim=1)


def window_starts(rows: int) -> list[int]:
    """First rows of the windows that cover `rows`; the last window is full too, so context is never short."""
    last = max(0, rows - WINDOW)
    return [*range(0, last, WINDOW - OVERLAP), last]


def fade_weights(rows: int) -> Tensor:
    """Weight [rows, 1] of a window's rows: up over the overlap, flat, down again; never zero."""
    edge = torch.minimum(torch.arange(1, rows + 1), torch.arange(rows, 0, -1))
    return edge.clamp(max=OVERLAP)[:, None].float()
