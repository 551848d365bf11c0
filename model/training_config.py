"""What a training is told, and what this machine answers where it is told nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch

from model.errors import ModelError


@dataclass(frozen=True)
class TrainingConfig:
    """The paper's settings; what the paper is silent about says so."""

    iterations: int = 30_000
    batch: int = 64
    frames: int = 30
    """Length of a crop."""
    learning_rate: float = 1e-3
    """The paper's is 1e-4, in vertex space; standardized coefficients bear more and need it (docs/method.md)."""
    unconditional: float = 0.1
    """Share of the batch whose audio condition is zeroed."""
    velocity: float = 10.0
    """Weight of the velocity term."""
    metric_power: float = 0.5
    """A coefficient weighs scale^power: 2 is the paper's vertex metric; see `coefficient_weights` (ours)."""
    ema: float = 0.999
    """Decay of the averaged weights (ours)."""
    feature_dropout: float = 0.3
    """Share of the speech channels zeroed in a crop: less is learned by heart (ours; docs/method.md)."""
    weight_decay: float = 0.3
    """AdamW's, decoupled from the gradient: keeps samples from agreeing too much (ours; docs/method.md)."""
    anchor: float = 0.5
    """A subject's motion weights decay to this share of those they start from: calms samples (ours; docs/method.md)."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the matrix products; weights, loss and sums stay in float32. auto: bfloat16 where it is fast (ours)."""
    device: str = "cpu"
    """`cpu`, `cuda`, `cuda:1`, … ; one device and one seed repeat to the byte (ours)."""
    candidates: int = 10
    """Checkpoints kept on the way, evenly spaced, for the choice on validation."""
    seed: int = 0
    threads: int = 2
    """Each takes its share of the batch, since a layer is too small to be shared out itself (ours)."""
    save_seconds: float = 20.0
    """A killed run loses at most this much (ours)."""
    log_every: int = 50


def settled(config: TrainingConfig) -> TrainingConfig:
    """The settings with this machine's answer where they leave the precision open, and no threads on a GPU."""
    cuda = available_device(config.device).type == "cuda"
    threads = 1 if cuda else config.threads
    if config.precision != "auto":
        return replace(config, threads=threads)
    fast = torch.cuda.is_bf16_supported() if cuda else _multiplies_bfloat16()
    return replace(config, threads=threads, precision="bfloat16" if fast else "float32")


def _multiplies_bfloat16() -> bool:
    """Whether the processor has tiles for it (AMX); elsewhere it is slower than float32."""
    return bool(torch.cpu.get_capabilities().get("amx_bf16"))


def available_device(name: str) -> torch.device:
    """The device of that name. Raises ModelError where this machine has none."""
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ModelError(f"device {name!r} is not known; use cpu or cuda") from None
    cards = torch.cuda.device_count() if device.type == "cuda" and torch.cuda.is_available() else 0
    if device.type != "cpu" and (device.index or 0) >= cards:
        raise ModelError(f"device {name!r} is not there; use cpu{' or cuda' if cards else ''}")
    return device
