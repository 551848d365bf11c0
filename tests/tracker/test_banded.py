"""Banded systems against dense ones."""

from __future__ import annotations

import numpy as np
import pytest

from tracker.banded import solve_banded


def lower_band(matrix: np.ndarray, width: int) -> np.ndarray:
    """[N, width + 1] as `solve_banded` reads it; what lies beyond the matrix is never read."""
    band = np.full((len(matrix), width + 1), np.nan)
    for offset in range(width + 1):
        band[: len(matrix) - offset, offset] = np.diagonal(matrix, -offset)
    return band


@pytest.mark.parametrize(("size", "width"), [(1, 0), (5, 4), (40, 0), (300, 37)])
def test_the_solution_is_that_of_the_dense_system(size: int, width: int) -> None:
    rng = np.random.default_rng(size)
    root = np.tril(np.triu(rng.normal(size=(size, size)), -width)) + 6 * np.eye(size)
    matrix, right = root @ root.T, rng.normal(size=size)
    assert np.abs(np.tril(matrix, -width - 1)).max(initial=0.0) == 0
    np.testing.assert_allclose(
        solve_banded(lower_band(matrix, width), right), np.linalg.solve(matrix, right), rtol=1e-9
    )


def test_what_is_not_positive_definite_is_told() -> None:
    matrix = np.diag([2.0, 1.0, -1e-3, 1.0])
    with pytest.raises(np.linalg.LinAlgError, match="3 of 4"):
        solve_banded(lower_band(matrix, 1), np.ones(4))
