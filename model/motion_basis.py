"""The motion basis: principal modes of more motion than memory holds, by a randomized SVD in two passes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.errors import ModelError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

MODES = 100
# Random directions beyond the modes asked for: the error falls fast with them (Halko et al. 2011, sec. 4.2).
OVERSAMPLING = 20


@dataclass(frozen=True)
class MotionBasis:
    """basis [K, D, 3] f32, orthonormal, strongest mode first.

    sizes [K] f64 m: root mean square coefficient of each mode. held: share of the squared displacement in its span.
    """

    basis: F32
    sizes: F64
    held: float

    def coefficients(self, displacements: F32) -> F32:
        """Displacements [N, D, 3] m -> the coefficients [N, K] m of their projection on the basis."""
        flat = self.basis.reshape(len(self.basis), -1)
        projected: F32 = displacements.reshape(len(displacements), -1) @ flat.T
        return projected


def motion_basis(chunks: Callable[[], Iterable[F32]], modes: int = MODES, seed: int = 0) -> MotionBasis:
    """The first `modes` right singular vectors of all displacements, fewer where the motion has fewer.

    chunks: gives an iterator over displacements [n, D, 3] m; asked twice, for the same chunks. Not centred: the mean
    displacement is held as well. With A all frames stacked, [N, 3D], the first pass makes A'A Omega of a random
    Omega, whose orthonormal Q spans the strong modes (Halko et al. 2011, algorithms 4.3 with one power iteration and
    5.3); the second makes Q'A'A Q, whose eigenvectors turn Q into the modes. Memory: one chunk and 3D x (modes + 20).

    Raises ModelError where there is no motion.
    """
    sketch: F64 | None = None
    omega = np.zeros((0, 0))
    for flat in _rows(chunks):
        if sketch is None:
            omega = np.random.default_rng(seed).standard_normal((flat.shape[1], modes + OVERSAMPLING))
            sketch = np.zeros_like(omega)
        sketch += flat.T @ (flat @ omega)
    if sketch is None or not sketch.any():
        raise ModelError("the motion does not move at all: there is nothing to learn from")
    span, _ = np.linalg.qr(sketch)
    gram, total, frames = np.zeros((span.shape[1], span.shape[1])), 0.0, 0
    for flat in _rows(chunks):
        inside = flat @ span
        gram += inside.T @ inside
        total += float(np.vdot(flat, flat))
        frames += len(flat)
    energy, axes = np.linalg.eigh(gram)
    # What is below rounding is no motion, and would be a mode of noise.
    kept = np.flatnonzero(energy > 1e-12 * energy[-1])[::-1][:modes]
    basis = (span @ axes[:, kept]).T
    largest = np.take_along_axis(basis, np.abs(basis).argmax(axis=1)[:, None], axis=1)
    basis *= np.sign(largest)  # an eigenvector's sign is arbitrary: two runs agree
    return MotionBasis(
        basis=basis.reshape(len(basis), -1, 3).astype(np.float32),
        sizes=np.sqrt(energy[kept] / frames),
        held=float(energy[kept].sum() / total),
    )


def _rows(chunks: Callable[[], Iterable[F32]]) -> Iterable[F64]:
    """The chunks as matrices [n, 3D] in double precision: squares of small modes must not drown."""
    for chunk in chunks():
        yield chunk.reshape(len(chunk), -1).astype(np.float64)
