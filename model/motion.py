"""A facial motion: displacements of a subject's vertices from the neutral template, and its file."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FPS = 30.0


class MotionError(ValueError):
    """A motion file or array that cannot be used; the message says what is wrong and what is needed."""


def topology_hash(vertex_count: int, faces: NDArray[np.int32]) -> str:
    """sha256 of D and the faces: two motions are comparable when these agree."""
    digest = hashlib.sha256(str(int(vertex_count)).encode())
    digest.update(np.ascontiguousarray(faces, dtype="<i4").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Motion:
    """Head-fixed vertex displacements at 30 fps, in basis form.

    start_s: time of the first motion frame, s of presentation time; frame n is at start_s + n / fps.
    template: [D, 3] f32 m, the subject's neutral. faces: [F, 3] i32.
    basis: [K, D, 3] f32, orthonormal in R^{3D}. coefficients: [N, K] f32 m; displacement = coefficients · basis.
    valid: [N] bool, frames that were really seen.
    provenance: tool, version, synthetic true/false, source, checkpoint, seed, guidance.
    """

    fps: float
    start_s: float
    template: NDArray[np.float32]
    faces: NDArray[np.int32]
    basis: NDArray[np.float32]
    coefficients: NDArray[np.float32]
    valid: NDArray[np.bool_]
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def topology(self) -> str:
        """sha256 of D and the faces."""
        return topology_hash(len(self.template), self.faces)

    def displacements(self, vertices: NDArray[np.integer] | None = None) -> NDArray[np.float32]:
        """[N, D, 3] m, or [N, len(vertices), 3] for some vertices only."""
        basis = self.basis if vertices is None else self.basis[:, vertices]
        return np.tensordot(self.coefficients, basis, axes=1)

    def save(self, path: Path) -> None:
        """Write `motion.npz` atomically (temporary name, fsync, rename)."""
        temporary = path.with_name(f".{path.name}.partial")
        with temporary.open("wb") as stream:
            np.savez_compressed(
                stream,
                fps=np.float64(self.fps),
                start_s=np.float64(self.start_s),
                template=self.template,
                faces=self.faces,
                basis=self.basis,
                coefficients=self.coefficients,
                valid=self.valid,
                topology=np.str_(self.topology),
                provenance=np.str_(json.dumps(self.provenance)),
            )
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
