"""Orthonormal bases of vertex displacements: of any set of them, and one that holds two others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Directions this small against the largest are rounding of float32: a face moves by centimetres, so they hold
# less than a ten-thousandth of a millimetre.
RANK_TOLERANCE = 1e-6


def orthonormal(rows: NDArray[np.floating]) -> tuple[F32, F64]:
    """Displacement fields [J, D, 3] -> (basis [K, D, 3] orthonormal in R^{3D}, mixing [J, K]), K <= J their rank.

    rows = mixing · basis, so coefficients c of the rows are c · mixing in the basis.
    """
    flat = rows.reshape(len(rows), -1).astype(np.float64)
    # By way of a small square: the decomposition of the whole takes ten times as long.
    frame, triangle = np.linalg.qr(flat.T)
    left, values, right = np.linalg.svd(triangle.T, full_matrices=False)
    rank = max(1, int((values > RANK_TOLERANCE * values[0]).sum()))
    basis = (right[:rank] @ frame.T).reshape(rank, *rows.shape[1:]).astype(np.float32)
    return basis, left[:, :rank] * values[:rank]


def common_basis(a: F32, b: F32) -> tuple[F32, F64, F64]:
    """An orthonormal basis of the span of a [K, D, 3] and b [J, D, 3], and the two in it: a = mix_a · basis.

    Equal bases stay as they are, bit for bit.
    """
    if np.array_equal(a, b):
        return a, np.eye(len(a)), np.eye(len(a))
    basis, mixing = orthonormal(np.concatenate([a, b]))
    return basis, mixing[: len(a)], mixing[len(a) :]
