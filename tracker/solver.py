"""Bounded Levenberg-Marquardt for a face clip: identity by elimination, smooth time lines by a band."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tracker.banded import solve_banded
from tracker.energy import POSE, LandmarkModel, Quadratic, Weights
from tracker.threads import side_by_side
from tracker.track import F64, STEP_S

ROUNDS = 4  # of fixing what passes a bound
GIVE_UP = 1e6  # damping at which no step can help
CONVERGED = 1e-4  # of the energy
LEAST_STEP = 0.05  # of STEP_S: nearer frames are taken to be so far apart
PART, SHARED = 4000, 100  # frames of a long clip that are solved at once, and how many more on both sides
CHUNK = 32  # frames linearized at once: their Jacobian stays near the cache

Result = TypeVar("Result")


class FrameEnergy(Protocol):
    """The energy of n frames that `solve_frames` minimizes."""

    @property
    def model(self) -> LandmarkModel:
        """The head, whose modes have bounds."""

    def select(self, frames: slice) -> Self:
        """That of some of the frames."""

    def value(self, shape: F64, x: F64) -> F64:
        """[n] at x [n, P] of the subject with landmarks `shape` [L, 3] at rest."""

    def linearize(self, shape: F64, x: F64) -> Quadratic:
        """Gauss-Newton model at x [n, P]."""


@dataclass(frozen=True)
class PosesHeld:
    """The energy of n frames whose poses stay as they are."""

    energy: FrameEnergy

    @property
    def model(self) -> LandmarkModel:
        """The head, whose modes have bounds."""
        return self.energy.model

    def select(self, frames: slice) -> PosesHeld:
        """That of some of the frames."""
        return PosesHeld(self.energy.select(frames))

    def value(self, shape: F64, x: F64) -> F64:
        """See `FrameEnergy`."""
        return self.energy.value(shape, x)

    def linearize(self, shape: F64, x: F64) -> Quadratic:
        """See `FrameEnergy`."""
        free = self.energy.linearize(shape, x)
        pose = np.arange(x.shape[1]) >= x.shape[1] - POSE
        return Quadratic(free.value, *freeze(free.gradient, free.hessian, np.broadcast_to(pose, x.shape)))


Progress = Callable[[int, int], None]
Step = tuple[F64, F64]  # of the identity [Ki] and of the frames [n, P]


@dataclass(frozen=True)
class Bounds:
    """Lowest and highest weights, [P - POSE] each."""

    lower: F64
    upper: F64

    def clamp(self, x: F64) -> F64:
        """The weights of x [n, P] cut to the bounds."""
        out = x.copy()
        np.clip(out[:, :-POSE], self.lower, self.upper, out=out[:, :-POSE])
        return out

    def held(self, x: F64, gradient: F64) -> NDArray[np.bool_]:
        """[n, P] weights at a bound that the energy pushes further out: they stay where they are in this step."""
        out = np.zeros(x.shape, bool)
        w, g = x[:, :-POSE], gradient[:, :-POSE]
        out[:, :-POSE] = ((w <= self.lower) & (g > 0)) | ((w >= self.upper) & (g < 0))
        return out


def freeze(gradient: F64, hessian: F64, fixed: NDArray[np.bool_]) -> tuple[F64, F64]:
    """Gradient and Hessian [n, P(, P)] whose solution leaves the fixed unknowns unmoved."""
    free = ~fixed
    hessian = hessian * (free[:, :, None] & free[:, None, :])
    index = np.arange(hessian.shape[1])
    hessian[:, index, index] += fixed
    return gradient * free, hessian


def bounded_step(
    bounds: Bounds, x: F64, gradient: F64, solve: Callable[[NDArray[np.bool_], F64], Step]
) -> Step:
    """The step of `solve` whose weights stay within the bounds.

    `solve(fixed, move)` minimizes the quadratic model with the fixed unknowns displaced by `move`. What passes a bound
    is moved onto it and the rest solved again: cutting the step alone would leave the rest tuned to the uncut one.
    """
    fixed, move = bounds.held(x, gradient), np.zeros_like(x)
    step = solve(fixed, move)
    for _ in range(ROUNDS):
        inside = bounds.clamp(x + step[1]) - x
        out = (np.abs(inside - step[1]) > 1e-12) & ~fixed
        if not out.any():
            break
        fixed = fixed | out
        move = np.where(out, inside, move)
        step = solve(fixed, move)
    return step


@dataclass(frozen=True)
class Solution:
    """identity [Ki]; x [n, P]; value: the energy."""

    identity: F64
    x: F64
    value: float


class SharedEnergy(Protocol):
    """The energy of n key frames that `solve_subject` minimizes over their subject too."""

    @property
    def model(self) -> LandmarkModel:
        """The head, whose modes have bounds."""

    @property
    def weights(self) -> Weights:
        """The identity's prior among them."""

    def shape(self, identity: F64) -> F64:
        """[.., 3] m, the subject's points at rest."""

    def value(self, shape: F64, x: F64) -> F64:
        """[n] at x [n, P] of the subject `shape`."""

    def linearize(self, shape: F64, x: F64, with_identity: bool) -> Quadratic:
        """Gauss-Newton model of the unknowns [identity (Ki), x]."""


def solve_subject(energy: SharedEnergy, identity: F64, x: F64, steps: int = 20) -> Solution:
    """Identity and the n key frames together: Levenberg-Marquardt, per-frame blocks eliminated (Schur)."""
    prior = energy.weights.identity * len(x)
    bounds = _bounds(energy)

    def total(identity: F64, x: F64) -> float:
        return float(energy.value(energy.shape(identity), x).sum() + 0.5 * prior * identity @ identity)

    damping, value = 1e-3, total(identity, x)
    for _ in range(steps):
        quadratic = energy.linearize(energy.shape(identity), x, True)
        while True:
            solve = partial(schur_step, quadratic, identity, prior, damping)
            step_identity, step = bounded_step(bounds, x, quadratic.gradient[:, len(identity) :], solve)
            trial_identity, trial = identity + step_identity, bounds.clamp(x + step)
            trial_value = total(trial_identity, trial)
            if trial_value < value or damping > GIVE_UP:
                break
            damping *= 10
        if not trial_value < value:
            break
        gain, value = value - trial_value, trial_value
        identity, x, damping = trial_identity, trial, max(damping / 5, 1e-6)
        if gain < CONVERGED * value:
            break
    return Solution(identity, x, value)


def schur_step(
    quadratic: Quadratic, identity: F64, prior: float, damping: float, fixed: NDArray[np.bool_], move: F64
) -> Step:
    """Step of identity and frames, per-frame blocks eliminated; the fixed unknowns are displaced by `move`."""
    k = len(identity)
    shifted = quadratic.gradient + np.einsum("npq,nq->np", quadratic.hessian[:, :, k:], move)
    gradient, block = freeze(shifted[:, k:], quadratic.hessian[:, k:, k:], fixed)
    cross = quadratic.hessian[:, :k, k:] * ~fixed[:, None]
    index = np.arange(block.shape[1])
    block[:, index, index] *= 1 + damping
    solved = np.linalg.solve(block, np.concatenate([cross.transpose(0, 2, 1), gradient[..., None]], axis=2))
    shared = quadratic.hessian[:, :k, :k].sum(0) + prior * np.eye(k)
    shared[np.arange(k), np.arange(k)] *= 1 + damping
    shared -= (cross @ solved[..., :k]).sum(0)
    right = np.einsum("nkp,np->k", cross, solved[..., k]) - shifted[:, :k].sum(0) - prior * identity
    step_identity = np.linalg.solve(shared, right)
    return step_identity, move - solved[..., k] - solved[..., :k] @ step_identity


@dataclass(frozen=True)
class Smoothness:
    """Bends along time, inside unbroken runs: their precisions [n-2, P].

    bend: [n-2, 3] by which three frames in a row are added up to one. It is their second difference where frames are
    STEP_S apart; what is farther apart may bend more, as the integral of white noise does: by the power 1.5 of time.
    tolerated: a pose's squared bend, in standard deviations, at which it counts half (Cauchy's loss over all six of its
    numbers): a head that is jerked bends hundreds of times more than usual, and must not be followed late for it.
    """

    precision: F64
    bend: F64
    tolerated: float = np.inf

    @classmethod
    def none(cls, frames: int, unknowns: int) -> Smoothness:
        """Each frame is on its own."""
        count = max(frames - 2, 0)
        return cls(np.zeros((count, unknowns)), np.zeros((count, 3)))

    @classmethod
    def between(
        cls, run: NDArray[np.integer], time: F64, precision: F64, tolerated: float = np.inf
    ) -> Smoothness:
        """Of frames at `time` [n] s, ascending; those of the same number `run` [n] follow each other without a break.

        precision: [P].
        """
        triple = (run[2:] == run[1:-1]) & (run[1:-1] == run[:-2])
        step = np.maximum(np.diff(time) / STEP_S, LEAST_STEP)
        before, after = step[:-1], step[1:]
        bend = np.stack([1 / before, -1 / before - 1 / after, 1 / after], axis=1)
        bend *= np.sqrt(2 / (before + after))[:, None]
        return cls(triple[:, None] * precision, bend, tolerated)

    def select(self, frames: slice) -> Smoothness:
        """That of some frames in a row."""
        start, stop, _ = frames.indices(len(self.bend) + 2)
        bends = slice(start, max(stop - 2, start))
        return replace(self, precision=self.precision[bends], bend=self.bend[bends])

    def value(self, x: F64) -> float:
        """Energy of x [n, P]."""
        square = self.precision * self._bends(x) ** 2
        pose = square[:, -POSE:].sum(1)
        if np.isfinite(self.tolerated):
            pose = self.tolerated * np.log1p(pose / self.tolerated)
        return 0.5 * float(square[:, :-POSE].sum() + pose.sum())

    def at(self, x: F64) -> Smoothness:
        """The quadratic that touches it at x [n, P] and is nowhere below."""
        pose = (self.precision * self._bends(x) ** 2)[:, -POSE:].sum(1)
        precision = self.precision.copy()
        precision[:, -POSE:] /= 1 + pose[:, None] / self.tolerated
        return replace(self, precision=precision, tolerated=np.inf)

    def gradient(self, x: F64) -> F64:
        """[n, P]."""
        pull = self.at(x).precision * self._bends(x)
        out = np.zeros_like(x)
        for rows, weight in self._parts():
            out[rows] += weight * pull
        return out

    def bands(self, n: int) -> tuple[F64, F64, F64]:
        """[n, P] each: a quadratic's Hessian, its diagonal and its couplings of frame i with i + 1 and i + 2."""
        diagonal, first, second = np.zeros((3, n, self.precision.shape[1]))
        for rows, weight in self._parts():
            diagonal[rows] += weight**2 * self.precision
        before, here, after = (weight for _, weight in self._parts())
        first[:-2] += before * here * self.precision
        first[1:-1] += here * after * self.precision
        second[:-2] += before * after * self.precision
        return diagonal, first, second

    def _bends(self, x: F64) -> F64:
        """[n-2, P] of x [n, P]."""
        out = np.zeros((len(self.bend), x.shape[1]))
        for rows, weight in self._parts():
            out += weight * x[rows]
        return out

    def _parts(self) -> Iterator[tuple[slice, F64]]:
        """Of the three frames of each bend: their rows, and their weights [n-2, 1]."""
        rows = np.s_[:-2], np.s_[1:-1], np.s_[2:]
        return zip(rows, self.bend.T[..., None])


def solve_frames(
    energy: FrameEnergy,
    shape: F64,
    x: F64,
    smoothness: Smoothness,
    steps: int = 10,
    progress: Progress | None = None,
) -> F64:
    """All frames [n, P] of the subject `shape` [L, 3] together, smooth in time.

    Of a long clip PART at once, and SHARED more on both sides, which belong to the neighbours: the equations of one
    frame take .2 MB, of FLAME .5.
    """
    out, starts = x.copy(), range(0, len(x), PART)
    for number, start in enumerate(starts):
        first = max(start - SHARED, 0)
        part = slice(first, start + PART + SHARED)

        def so_far(done: int, total: int, number: int = number) -> None:
            if progress:
                progress(number * total + done, len(starts) * total)

        found = _solve_part(energy.select(part), shape, x[part], smoothness.select(part), steps, so_far)
        out[start : start + PART] = found[start - first :][:PART]
    return out


def _solve_part(
    energy: FrameEnergy,
    shape: F64,
    x: F64,
    smoothness: Smoothness,
    steps: int,
    progress: Progress,
) -> F64:
    def total(x: F64) -> float:
        parts = _in_chunks(lambda part: energy.select(part).value(shape, x[part]).sum(), len(x))
        return float(sum(parts)) + smoothness.value(x)

    bounds = _bounds(energy)
    damping, value = 1e-3, np.inf
    for step in range(steps):
        value, gradient, hessian = _linearize(energy, shape, x)
        value += smoothness.value(x)
        gradient += smoothness.gradient(x)
        while True:
            solve = partial(band_step, gradient, hessian, smoothness.at(x), damping)
            trial = bounds.clamp(x + bounded_step(bounds, x, gradient, solve)[1])
            trial_value = total(trial)
            if trial_value < value or damping > GIVE_UP:
                break
            damping *= 10
        progress(step + 1, steps)
        if not trial_value < value:
            break
        gain, value, x, damping = value - trial_value, trial_value, trial, max(damping / 5, 1e-6)
        if gain < CONVERGED * value:
            break
    progress(steps, steps)
    return x


def _bounds(energy: FrameEnergy | SharedEnergy) -> Bounds:
    return Bounds(energy.model.modes.lower, energy.model.modes.upper)


def _in_chunks(function: Callable[[slice], Result], count: int) -> list[Result]:
    """What the function gives for each CHUNK of `count` frames, in their order."""
    chunks = [slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]
    return list(side_by_side(function, chunks))


def _linearize(energy: FrameEnergy, shape: F64, x: F64) -> tuple[float, F64, F64]:
    gradient, hessian = np.empty(x.shape), np.empty((*x.shape, x.shape[1]))

    def fill(part: slice) -> float:
        quadratic = energy.select(part).linearize(shape, x[part])
        gradient[part], hessian[part] = quadratic.gradient, quadratic.hessian
        return float(quadratic.value.sum())

    return sum(_in_chunks(fill, len(x))), gradient, hessian


def band_step(
    gradient: F64, hessian: F64, smoothness: Smoothness, damping: float, fixed: NDArray[np.bool_], move: F64
) -> Step:
    """Step of the frames (no identity) by banded Cholesky factorization; the fixed unknowns are displaced by `move`.

    smoothness: a quadratic, see `Smoothness.at`.
    """
    n, p = gradient.shape
    gradient = gradient + np.einsum("npq,nq->np", hessian, move) + smoothness.gradient(move)
    gradient, hessian = freeze(gradient, hessian, fixed)
    free = ~fixed
    diagonal, first, second = smoothness.bands(n)
    band = np.zeros((n, p, 2 * p + 1))
    for unknown in range(p):
        band[:, unknown, : p - unknown] = hessian[:, unknown, unknown:]
    band[..., 0] += diagonal * free
    band[..., 0] *= 1 + damping
    band[..., 0] += 1e-9
    band[:-1, :, p] = (first * free)[:-1] * free[1:]
    band[:-2, :, 2 * p] = (second * free)[:-2] * free[2:]
    step = solve_banded(band.reshape(n * p, 2 * p + 1), -gradient.ravel()).reshape(n, p)
    return np.zeros(0), move + step
