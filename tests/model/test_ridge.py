"""The ridge baseline: recovers a linear map with its context, chooses lambda, holds the ends."""

from __future__ import annotations

import numpy as np
import pytest

from model.dataset import Sequence
from model.errors import ModelError
from model.ridge import LAMBDAS, Ridge, _solutions


def linear(frames: int, seed: int, noise: float = 0.0) -> Sequence:
    """Coefficients that are a fixed linear function of the features 4 frames earlier and now."""
    rng = np.random.default_rng(seed)
    features = rng.standard_normal((frames, 5)).astype(np.float32)
    now, before = np.random.default_rng(7).standard_normal((2, 5, 3))
    motion = features @ now + np.roll(features, 4, axis=0) @ before + 2.0
    motion += noise * rng.standard_normal(motion.shape)
    valid = np.arange(frames) >= 4
    return Sequence((0.01 * motion).astype(np.float32), features, valid)


def test_recovers_a_linear_map() -> None:
    unseen = linear(100, seed=9)
    ridge = Ridge.fit([linear(400, seed) for seed in range(3)], [linear(60, 5)])
    error = (ridge.predict(unseen.features) - unseen.coefficients)[4:]
    assert ridge.penalty == LAMBDAS[0]
    assert error.std() < 0.02 * unseen.coefficients.std()


def test_fewer_rows_than_columns_and_more_solve_the_same_equations() -> None:
    """At the border, 45 columns: 44 rows go one way, the same rows and two zero ones the other."""
    x, y = np.random.default_rng(0).standard_normal((2, 44, 45))
    padded = [np.concatenate([rows, np.zeros((2, 45))]) for rows in (x, y)]
    both = zip(_solutions(x, y, [3.0, 0.5]), _solutions(*padded, [3.0, 0.5]), strict=True)
    for penalty, (one, other) in zip((3.0, 0.5), both, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
        np.testing.assert_allclose(x.T @ x @ one + penalty * one, x.T @ y, atol=1e-9)


def test_noise_asks_for_a_larger_lambda_than_none() -> None:
    noisy = Ridge.fit([linear(80, 0, noise=10)], [linear(300, 1, noise=10)])
    assert LAMBDAS[0] < noisy.penalty
    quiet = Ridge.fit([linear(80, 0)], [linear(300, 1)])
    assert quiet.penalty < noisy.penalty


def test_chooses_the_lambda_that_is_best_on_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    train, val = [linear(60, 0, noise=3)], [linear(300, 1, noise=3)]
    chosen = Ridge.fit(train, val)

    def error(ridge: Ridge) -> float:
        return float(((ridge.predict(val[0].features) - val[0].coefficients)[val[0].valid] ** 2).sum())

    for penalty in LAMBDAS:
        monkeypatch.setattr("model.ridge.LAMBDAS", (penalty,))
        assert error(chosen) <= error(Ridge.fit(train, val)) * (1 + 1e-6)


def test_any_length_is_predicted() -> None:
    ridge = Ridge.fit([linear(80, 0)], [linear(80, 1)])
    assert ridge.predict(np.zeros((1, 5), np.float32)).shape == (1, 3)


def test_nothing_valid_is_refused() -> None:
    sequence = linear(3, 0)  # its four first frames are invalid
    with pytest.raises(ModelError, match="no valid training frame"):
        Ridge.fit([sequence], [linear(80, 0)])
    with pytest.raises(ModelError, match="no valid validation frame"):
        Ridge.fit([linear(80, 0)], [])
