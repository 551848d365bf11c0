"""The embedded speech encoder: the first blocks of Whisper's over a whole clip, one row every 20 ms."""

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

from model.speech_windows import SAMPLE_RATE, in_windows, peak_normalized

N_FFT = 400  # 25 ms window
HOP = 160  # 10 ms a mel frame
TOGETHER = 6000  # mel frames transformed at once: the spectra of hours fill gigabytes
N_MELS = 80
STRIDE = 2  # mel frames a feature row: the second convolution halves the rate
RATE = SAMPLE_RATE / (HOP * STRIDE)  # 50 feature rows a second; row k is centred at k / RATE
HEADS = 6
ASSET = Path(__file__).parent / "assets" / "speech_encoder.safetensors"


@dataclass(frozen=True)
class WhisperEncoder:
    """A SpeechEncoder; `tensors` are its weights by name. Row k is centred at k / rate seconds."""

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
        rows = self._embed(log_mel(peak_normalized(audio, N_FFT)))
        features = in_windows(len(rows), self.width, lambda first, stop: self._attend(rows[first:stop]))
        return features.numpy(), np.arange(len(rows)) / self.rate

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
def embedded_encoder() -> WhisperEncoder:
    """Whisper tiny.en to its third block, as tools/build_speech_encoder.py made it."""
    digest = hashlib.sha256(ASSET.read_bytes()).hexdigest()
    with safe_open(ASSET, framework="pt") as stored:
        tensors = {key: stored.get_tensor(key).float() for key in stored.keys()}  # noqa: SIM118
        name = stored.metadata()["name"]
    return WhisperEncoder(f"{name}@{digest}", len(tensors["conv2.bias"]), RATE, tensors)


def log_mel(sound: Tensor) -> Tensor:
    """Whisper's log-mel spectrogram of sound [S >= 201] at 16 kHz -> [80, S // 160], centred at j / 100 s."""
    window = torch.hann_window(N_FFT)
    padded = F.pad(sound[None], (N_FFT // 2, N_FFT // 2), mode="reflect")[0]
    parts = []
    for start in range(0, len(sound) // HOP, TOGETHER):
        stop = min(start + TOGETHER, len(sound) // HOP)
        part = padded[start * HOP : (stop - 1) * HOP + N_FFT]
        spectrum = torch.stft(part, N_FFT, HOP, window=window, center=False, return_complex=True)
        parts.append(mel_filters() @ spectrum.abs().square())
    level = torch.cat(parts, dim=1).clamp(min=1e-10).log10()
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
