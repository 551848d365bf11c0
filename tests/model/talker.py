"""A tiny mesh that moves as its features say: generated data for the tests of this package."""

from __future__ import annotations

import numpy as np
import torch

from model.checkpoint import Checkpoint, State
from model.dataset import Sequence, Standardization

K, D, W = 6, 20, 12
REGIONS = {
    "lips": np.arange(6, dtype=np.int32),
    "face": np.arange(D, dtype=np.int32),
    "inner_lip_upper": np.array([0, 1, 2], np.int32),
    "inner_lip_lower": np.array([0, 3, 2], np.int32),
}
FACES = np.array([[i, i + 1, i + 2] for i in range(D - 2)], np.int32)


def basis(seed: int = 0) -> np.ndarray:
    """Orthonormal [K, D, 3]."""
    random = np.random.default_rng(seed).standard_normal((3 * D, K))
    return np.linalg.qr(random)[0].T.reshape(K, D, 3).astype(np.float32)


def sequence(frames: int, seed: int, style: int = 0, uncertain: float = 0.3) -> Sequence:
    """Smooth random features; coefficients (mm sizes falling by mode) follow them, a share by chance."""
    rng = np.random.default_rng(seed)
    window = np.hanning(9) / np.sqrt((np.hanning(9) ** 2).sum())

    def smooth(count: int) -> np.ndarray:
        noise = rng.standard_normal((frames + 8, count))
        return np.stack([np.convolve(column, window, "valid") for column in noise.T], axis=1)

    features = smooth(W)
    mixing = np.random.default_rng(99).standard_normal((W, K)) / np.sqrt(W)
    motion = np.sqrt(1 - uncertain**2) * np.tanh(features @ mixing) + uncertain * smooth(K)
    sizes = 0.02 * 0.6 ** np.arange(K)
    return Sequence(
        (motion * sizes).astype(np.float32), features.astype(np.float32), np.ones(frames, bool), style
    )


def checkpoint(
    sequences: list[Sequence], parametrization: str = "skip", styles: int = 1, architecture: str = "conv"
) -> Checkpoint:
    """Untrained, fitting the sequences."""
    return Checkpoint.initial(
        kind="base",
        encoder="test",
        styles=tuple(f"person{i}" for i in range(styles)),
        basis=basis(),
        template=np.zeros((D, 3), np.float32),
        faces=FACES,
        standardization=Standardization.of(sequences),
        regions=REGIONS,
        parametrization=parametrization,
        architecture=architecture,
    )


def shaken(untrained: Checkpoint, seed: int = 0) -> Checkpoint:
    """With every weight moved at random: a network whose output depends on all of its inputs."""
    generator = torch.Generator().manual_seed(seed)
    state: State = {
        name: value + 0.2 * torch.randn(value.shape, generator=generator) / max(value.shape[0], 8) ** 0.5
        for name, value in untrained.network.items()
    }
    return untrained.with_weights(state, {name: value.clone() for name, value in state.items()})
