"""What a head on film truly did: read from the shared data, or written beside the bench's own films."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.files import write_npz
from personalize.files import read_npz
from tracker.track import F64


@dataclass(frozen=True)
class GroundTruth:
    """A head of T frames.

    neutral: [V, 3] m. faces: [F, 3]. displacement: [T, V, 3] m. rotation: [T, 3, 3] and translation: [T, 3] m take
    the head frame to the camera frame (OpenCV). focal: px. lip_gap_mm: [T], between the vertices of `HeadModel`'s
    opening; of another mesh what is free between the lips in the face's middle: from the lowest point of the upper one
    to the highest of the lower one. covered: [T] 0..1, share of the lips that something hides. vertices: [V] those of
    the embedded head that these are; None where the mesh is another. eyes: [T, 2, 3] axis-angle rad in the head frame,
    left then right; None where they are not known.
    """

    neutral: F64
    faces: NDArray[np.int32]
    displacement: F64
    rotation: F64
    translation: F64
    focal: float
    lip_gap_mm: F64
    covered: F64
    vertices: NDArray[np.int32] | None = None
    eyes: F64 | None = None

    def write(self, path: Path) -> None:
        """As npz; whole or not at all. The displacement in halves of floats: to 4 µm."""
        arrays = {name: np.asarray(value) for name, value in vars(self).items() if value is not None}
        write_npz(path, **arrays | {"displacement": self.displacement.astype(np.float16)})

    @classmethod
    def read(cls, path: Path) -> GroundTruth:
        """What `write` wrote."""
        arrays = read_npz(path)
        focal, moved = float(arrays.pop("focal")), arrays.pop("displacement").astype(np.float64)
        return cls(focal=focal, displacement=moved, **arrays)

    @classmethod
    def load(cls, path: Path) -> GroundTruth:
        """Read `NAME.npz` of the shared ground truth."""
        file = read_npz(path)
        return cls(
            neutral=file["neutral"].astype(np.float64),
            faces=file["faces"],
            displacement=file["displacement_q"] * float(file["displacement_scale"]),
            rotation=np.diag([1.0, -1.0, -1.0]) @ file["rotation"].astype(np.float64),
            translation=file["translation"].astype(np.float64),
            focal=float(file["focal_px"]),
            lip_gap_mm=file["lip_gap_mm"].astype(np.float64),
            covered=np.zeros(len(file["lip_gap_mm"])),
        )
