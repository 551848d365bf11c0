"""Frames and followed faces, made up."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from personalize.people import (
    Sighting,
    Tracklet,
)
from personalize.shots import (
    REASONS,
    Frames,
)


def frames_of(time: np.ndarray, usable: np.ndarray, segment: np.ndarray | None = None) -> Frames:
    shots = np.zeros(len(time), np.int32) if segment is None else segment.astype(np.int32)
    box = np.zeros((len(time), 4), np.float32)
    return Frames(time, usable, (~usable).astype(np.uint8), REASONS, shots, box)


def tracklet(
    person: int,
    frames: Iterable[int],
    width: float = 50,
    seed: int = 0,
    light: float = 120.0,
    burnt: float = 0.0,
    moves: float = 0.01,
) -> Tracklet:
    """A face whose shape and portrait are those of `person`, with some noise and in another pose."""
    own, noise = np.random.default_rng(person), np.random.default_rng(seed + 1000)
    shape = np.random.default_rng(99).normal(size=(478, 3)) + 0.15 * own.normal(size=(478, 3))
    portrait = own.integers(0, 255, (14, 12))

    def sample() -> tuple[np.ndarray, np.ndarray]:
        points = 100 * (shape + moves * noise.normal(size=shape.shape)) + 7
        grey = 0.7 * portrait + noise.integers(0, 20, portrait.shape)
        return points.astype(np.float32), grey.astype(np.uint8)

    box = np.array([0, 0, width, width], np.float32)
    return Tracklet(
        [
            Sighting(f, f / 25, box.copy(), 60.0, light, burnt, 0.5, None if f % 10 else sample())
            for f in frames
        ]
    )
