"""Bases of displacement fields."""

from __future__ import annotations

import numpy as np
import pytest

from model.basis import common_basis, orthonormal
from tests.model import talker


def test_fields_are_their_mixing_of_an_orthonormal_basis_of_their_rank() -> None:
    fields = np.random.default_rng(0).standard_normal((5, talker.D, 3))
    fields[3], fields[4] = 2 * fields[0] - fields[1], 0
    basis, mixing = orthonormal(fields)
    flat = basis.reshape(len(basis), -1)
    assert basis.shape == (3, talker.D, 3) and basis.dtype == np.float32 and mixing.shape == (5, 3)
    np.testing.assert_allclose(flat @ flat.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.tensordot(mixing, basis, axes=1), fields, atol=1e-5)


@pytest.mark.parametrize("seed", [0, 4])
def test_a_common_basis_holds_both(seed: int) -> None:
    a, b = talker.basis(), talker.basis(seed)
    basis, mix_a, mix_b = common_basis(a, b)
    assert len(basis) == (talker.K if seed == 0 else 2 * talker.K)
    assert (basis is a) == (seed == 0)
    np.testing.assert_allclose(np.tensordot(mix_a, basis, axes=1), a, atol=1e-6)
    np.testing.assert_allclose(np.tensordot(mix_b, basis, axes=1), b, atol=1e-6)
