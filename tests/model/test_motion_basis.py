"""The basis of motion in chunks equals the exact SVD of all of it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from model.errors import ModelError
from model.motion_basis import motion_basis

D = 200


def motion(frames: int = 700, rank: int = 60) -> np.ndarray:
    """[N, D, 3] m: modes that fall off as those of faces do, about a mean that is not zero."""
    rng = np.random.default_rng(0)
    modes = np.linalg.qr(rng.standard_normal((3 * D, rank)))[0].T
    sizes = 0.05 * 0.85 ** np.arange(rank)
    flat = (rng.standard_normal((frames, rank)) + 0.5) * sizes @ modes
    return flat.reshape(frames, D, 3).astype(np.float32)


def chunked(displacements: np.ndarray, size: int) -> Iterator[np.ndarray]:
    yield from (displacements[start : start + size] for start in range(0, len(displacements), size))


def test_it_equals_the_exact_svd() -> None:
    displacements = motion()
    found = motion_basis(lambda: chunked(displacements, 64), modes=30)
    _, values, right = np.linalg.svd(displacements.reshape(700, -1).astype(np.float64), full_matrices=False)
    flat = found.basis.reshape(30, -1).astype(np.float64)
    assert np.allclose(flat @ flat.T, np.eye(30), atol=1e-6)
    assert np.allclose(found.sizes, values[:30] / np.sqrt(700), rtol=1e-4)
    assert found.held == pytest.approx((values[:30] ** 2).sum() / (values**2).sum(), rel=1e-7)
    assert np.abs((flat * right[:30]).sum(axis=1))[:20] == pytest.approx(np.ones(20), abs=1e-4)
    cosines = np.linalg.svd(flat @ right[:30].T)[1]
    assert cosines.min() > 0.999, "the spans agree"


def test_chunks_do_not_matter_and_the_same_seed_gives_the_same_signs() -> None:
    displacements = motion(300)
    one, many = (motion_basis(lambda n=n: chunked(displacements, n), modes=20) for n in (300, 7))
    assert np.allclose(one.basis, many.basis, atol=1e-5)
    other = motion_basis(lambda: chunked(displacements, 50), modes=20, seed=5)
    assert np.allclose(one.basis[:15], other.basis[:15], atol=1e-3)


def test_motion_of_few_modes_is_held_whole() -> None:
    displacements = motion(200, rank=4)
    found = motion_basis(lambda: chunked(displacements, 64))
    assert found.held == pytest.approx(1, abs=1e-9)
    strong = found.sizes > 1e-4
    assert strong.sum() == 4
    back = np.tensordot(found.coefficients(displacements), found.basis, axes=1)
    assert np.abs(back - displacements).max() < 1e-6


def test_stillness_is_refused() -> None:
    for chunks in (lambda: iter(()), lambda: iter([np.zeros((5, D, 3), np.float32)])):
        with pytest.raises(ModelError, match="does not move"):
            motion_basis(chunks)
