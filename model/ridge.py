"""Ridge regression from speech features with context to motion: the baseline a learned model must beat."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve

from model.dataset import Sequence
from model.errors import ModelError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Frames around the predicted one whose features are regressed on: +-0.27 s, every second frame.
CONTEXT = np.arange(-8, 9, 2)
# lambda in units of the (standardized) features' variance.
LAMBDAS = tuple(float(value) for value in np.logspace(-2, 4, 13))


@dataclass(frozen=True)
class Ridge:
    """coefficients = (features in context - mean) / scale @ weights + offset.

    mean, scale [9 W]; weights [9 W, K] m; offset [K] m; penalty: the lambda chosen on validation.
    """

    mean: F64
    scale: F64
    weights: F64
    offset: F64
    penalty: float

    @classmethod
    def fit(cls, train: Many[Sequence], val: Many[Sequence], lambdas: Many[float] = LAMBDAS) -> Ridge:
        """Least squares with every lambda on the valid frames of train; the best on val is kept.

        The error is the squared vertex distance, since the basis is orthonormal. Raises ModelError where either
        has no valid frame.
        """
        x, y = _rows(train, "training")
        x_val, y_val = _rows(val, "validation")
        mean, scale, offset = x.mean(axis=0), x.std(axis=0) + 1e-6, y.mean(axis=0)
        x, x_val = (x - mean) / scale, (x_val - mean) / scale
        errors, best = [], np.zeros(0)
        for weights in _solutions(x, y - offset, [penalty * len(x) for penalty in lambdas]):
            errors.append(float(((x_val @ weights + offset - y_val) ** 2).sum()))
            best = weights if errors[-1] == min(errors) else best
        return cls(mean, scale, best, offset, lambdas[int(np.argmin(errors))])

    def predict(self, features: F32) -> F32:
        """Speech features [N, W] at the motion's frames -> coefficients [N, K] m."""
        standardized = (_in_context(features) - self.mean) / self.scale
        return (standardized @ self.weights + self.offset).astype(np.float32)


def _solutions(x: F64, y: F64, penalties: Many[float]) -> Iterator[F64]:
    """(x'x + penalty I)^-1 x'y of each penalty, by whichever of the two equal forms has the smaller system."""
    rows, columns = x.shape
    few = rows < columns
    gram, right = (x @ x.T, y) if few else (x.T @ x, x.T @ y)
    for penalty in penalties:
        system = gram.copy()
        system[np.diag_indices_from(system)] += penalty
        solution: F64 = solve(system, right, assume_a="pos", overwrite_a=True)
        yield x.T @ solution if few else solution


def _rows(sequences: Many[Sequence], what: str) -> tuple[F64, F64]:
    """Features in context and coefficients of all valid frames, f64."""
    if not any(sequence.valid.any() for sequence in sequences):
        raise ModelError(f"no valid {what} frame: the clip is too short for the ridge baseline")
    x = [_in_context(sequence.features)[sequence.valid] for sequence in sequences]
    y = [sequence.coefficients[sequence.valid] for sequence in sequences]
    return np.concatenate(x), np.concatenate(y).astype(np.float64)


def _in_context(features: F32) -> F64:
    """[N, W] -> [N, 9 W]: each frame with its neighbours of CONTEXT, the ends held."""
    index = np.arange(len(features))[:, None] + CONTEXT
    return features[np.clip(index, 0, len(features) - 1)].reshape(len(features), -1).astype(np.float64)
