from types import SimpleNamespace

import numpy as np
import pytest

from tracker.energy import POSE, Quadratic, Weights
from tracker.solver import (
    Bounds,
    PosesHeld,
    Smoothness,
    band_step,
    bounded_step,
    schur_step,
    solve_frames,
    solve_subject,
)
from tracker.track import STEP_S

FRAMES, WEIGHTS, IDENTITIES = 7, 3, 4
UNKNOWNS = WEIGHTS + POSE
EVEN = STEP_S * np.arange(FRAMES)
UNEVEN = STEP_S * np.array([0.0, 0.5, 2.0, 3.0, 3.4, 5.4, 6.4])
UNIT = Bounds(np.zeros(1), np.ones(1))


def random_blocks(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(FRAMES, size, size))
    return root @ root.transpose(0, 2, 1) + np.eye(size)


def bends(run: np.ndarray, time: np.ndarray) -> np.ndarray:
    """[m, FRAMES], one row for each three frames in a row of the same run.

    How far the third lies off the line through the first two, over the deviation of that for the integral of white
    noise, by that of frames STEP_S apart.
    """
    rows = []
    for i in range(FRAMES - 2):
        if run[i] == run[i + 1] == run[i + 2]:
            before, after = np.diff(time[i : i + 3]) / STEP_S
            row = np.zeros(FRAMES)
            row[i : i + 3] = [after / before, -1 - after / before, 1]
            variance = after**2 * before / 3 + after**3 / 3
            rows.append(row * np.sqrt((1 / 3 + 1 / 3) / variance))
    return np.array(rows).reshape(-1, FRAMES)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def smoothness(
    rng: np.random.Generator, run: np.ndarray, time: np.ndarray = EVEN
) -> tuple[Smoothness, np.ndarray]:
    precision = rng.uniform(0.5, 2.0, UNKNOWNS)
    bend = bends(run, time)
    return Smoothness.between(run, time, precision), np.kron(bend.T @ bend, np.diag(precision))


@pytest.mark.parametrize("time", [EVEN, UNEVEN])
def test_smoothness_is_the_quadratic_form_and_its_gradient(rng, time):
    term, dense = smoothness(rng, np.array([0, 0, 0, 0, 1, 1, 1]), time)
    x = rng.normal(size=(FRAMES, UNKNOWNS))
    assert term.value(x) == pytest.approx(0.5 * x.ravel() @ dense @ x.ravel())
    np.testing.assert_allclose(term.gradient(x).ravel(), dense @ x.ravel(), atol=1e-12)


def test_smoothness_of_some_frames_is_that_of_them_alone(rng):
    run, precision = np.array([0, 0, 0, 0, 1, 1, 1]), rng.uniform(0.5, 2.0, UNKNOWNS)
    whole, x = Smoothness.between(run, UNEVEN, precision, 2.0), rng.normal(size=(FRAMES, UNKNOWNS))
    for part in (slice(0, 99), slice(2, 6), slice(5, 7), slice(6, 7)):
        alone = Smoothness.between(run[part], UNEVEN[part], precision, 2.0)
        np.testing.assert_allclose(whole.select(part).gradient(x[part]), alone.gradient(x[part]))


def test_frames_an_even_step_apart_bend_by_their_second_difference():
    np.testing.assert_allclose(bends(np.zeros(FRAMES, int), EVEN)[2, 2:5], [1, -2, 1])


def test_even_motion_costs_nothing_whenever_it_is_filmed(rng):
    term = Smoothness.between(np.zeros(FRAMES, int), UNEVEN, np.ones(UNKNOWNS))
    x = rng.normal(size=UNKNOWNS) + np.outer(UNEVEN, rng.normal(size=UNKNOWNS))
    assert term.value(x) == pytest.approx(0, abs=1e-20)


def test_pictures_of_almost_the_same_time_leave_the_step_solvable(rng):
    time = EVEN.copy()
    time[3] = time[2] + 1e-9
    term = Smoothness.between(np.zeros(FRAMES, int), time, np.ones(UNKNOWNS))
    none, still = np.zeros((FRAMES, UNKNOWNS), bool), np.zeros((FRAMES, UNKNOWNS))
    step = band_step(still + 1.0, random_blocks(rng, UNKNOWNS), term, 0.0, none, still)[1]
    assert 0 < np.abs(step).max() < 10


def test_tolerant_smoothness_slopes_as_it_rises(rng):
    term = Smoothness.between(np.zeros(FRAMES, int), EVEN, rng.uniform(0.5, 2.0, UNKNOWNS), tolerated=2.0)
    x, way = rng.normal(size=(2, FRAMES, UNKNOWNS))
    rise = (term.value(x + 1e-6 * way) - term.value(x - 1e-6 * way)) / 2e-6
    assert (term.gradient(x) * way).sum() == pytest.approx(rise, rel=1e-6)


def test_the_quadratic_at_a_point_has_its_slope_and_is_nowhere_below(rng):
    term = Smoothness.between(np.zeros(FRAMES, int), EVEN, rng.uniform(0.5, 2.0, UNKNOWNS), tolerated=2.0)
    x, elsewhere = rng.normal(size=(2, FRAMES, UNKNOWNS))
    touching = term.at(x)
    np.testing.assert_allclose(touching.gradient(x), term.gradient(x))
    for share in (-1.0, 0.1, 1.0, 3.0):
        y = x + share * (elsewhere - x)
        assert touching.value(y) - touching.value(x) >= term.value(y) - term.value(x)


def test_a_jerk_of_the_head_costs_next_to_nothing_more_and_one_of_a_weight_all_of_it():
    term = Smoothness.between(np.zeros(FRAMES, int), EVEN, np.ones(UNKNOWNS), tolerated=9.0)
    jerked, spoken = np.zeros((2, FRAMES, UNKNOWNS))
    jerked[3:, -6], spoken[3:, 0] = 100.0, 100.0
    assert term.value(jerked) < 0.01 * term.value(spoken)
    assert term.value(spoken) == pytest.approx(100.0**2)


@pytest.mark.parametrize("run", [[0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 1, 1, 1], [0, 1, 1, 2, 2, 3, 3]])
@pytest.mark.parametrize("time", [EVEN, UNEVEN])
def test_band_step_solves_the_dense_system(rng, run, time):
    term, dense = smoothness(rng, np.array(run), time)
    gradient, blocks = rng.normal(size=(FRAMES, UNKNOWNS)), random_blocks(rng, UNKNOWNS)
    for frame in range(FRAMES):
        part = slice(frame * UNKNOWNS, (frame + 1) * UNKNOWNS)
        dense[part, part] += blocks[frame]
    expected = -np.linalg.solve(dense, gradient.ravel()).reshape(FRAMES, UNKNOWNS)
    none, still = np.zeros((FRAMES, UNKNOWNS), bool), np.zeros((FRAMES, UNKNOWNS))
    step = band_step(gradient, blocks, term, 0.0, none, still)[1]
    np.testing.assert_allclose(step, expected, rtol=1e-6, atol=1e-8)


def test_band_step_moves_fixed_unknowns_as_told_and_solves_for_the_rest(rng):
    term, dense = smoothness(rng, np.zeros(FRAMES, int))
    gradient, blocks = rng.normal(size=(FRAMES, UNKNOWNS)), random_blocks(rng, UNKNOWNS)
    for frame in range(FRAMES):
        part = slice(frame * UNKNOWNS, (frame + 1) * UNKNOWNS)
        dense[part, part] += blocks[frame]
    fixed = rng.random((FRAMES, UNKNOWNS)) < 0.3
    free = ~fixed.ravel()
    move = rng.normal(size=fixed.shape) * fixed
    step = band_step(gradient, blocks, term, 0.0, fixed, move)[1]
    np.testing.assert_array_equal(step[fixed], move[fixed])
    pull = (gradient.ravel() + dense @ move.ravel())[free]
    expected = -np.linalg.solve(dense[np.ix_(free, free)], pull)
    np.testing.assert_allclose(step.ravel()[free], expected, rtol=1e-6, atol=1e-8)


def test_schur_step_solves_the_dense_system(rng):
    size = IDENTITIES + UNKNOWNS
    quadratic = Quadratic(np.zeros(FRAMES), rng.normal(size=(FRAMES, size)), random_blocks(rng, size))
    identity, prior = rng.normal(size=IDENTITIES), 2.0
    none, still = np.zeros((FRAMES, UNKNOWNS), bool), np.zeros((FRAMES, UNKNOWNS))
    dense = np.zeros((IDENTITIES + FRAMES * UNKNOWNS,) * 2)
    right = np.zeros(len(dense))
    dense[:IDENTITIES, :IDENTITIES] = prior * np.eye(IDENTITIES)
    right[:IDENTITIES] = -prior * identity
    for frame in range(FRAMES):
        start = IDENTITIES + frame * UNKNOWNS
        index = np.r_[0:IDENTITIES, start : start + UNKNOWNS]
        dense[np.ix_(index, index)] += quadratic.hessian[frame]
        right[index] -= quadratic.gradient[frame]
    expected = np.linalg.solve(dense, right)
    step_identity, step = schur_step(quadratic, identity, prior, 0.0, none, still)
    np.testing.assert_allclose(step_identity, expected[:IDENTITIES], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(step.ravel(), expected[IDENTITIES:], rtol=1e-6, atol=1e-8)


class Bowl:
    """An energy of n frames with a minimum at `goal`, too flat by its model: plain steps lead far beyond it.

    An identity moves all goals. flat: share of the true curvature that its model has.
    """

    model = SimpleNamespace(modes=SimpleNamespace(lower=np.full(WEIGHTS, -9.0), upper=np.full(WEIGHTS, 9.0)))
    weights = Weights(identity=0.5)

    def __init__(self, goal: np.ndarray, flat: float, moves: np.ndarray) -> None:
        self.goal, self.flat, self.moves = goal, flat, moves

    def __len__(self) -> int:
        return len(self.goal)

    def select(self, frames: slice) -> "Bowl":
        return Bowl(self.goal[frames], self.flat, self.moves)

    def shape(self, identity: np.ndarray) -> np.ndarray:
        return identity @ self.moves

    def value(self, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
        return 0.5 * ((x - self.goal - shape) ** 2).sum(1)

    def linearize(self, shape: np.ndarray, x: np.ndarray, with_identity: bool = False) -> Quadratic:
        by = np.concatenate([-self.moves, np.eye(UNKNOWNS)]) if with_identity else np.eye(UNKNOWNS)
        gradient = (x - self.goal - shape) @ by.T
        hessian = np.broadcast_to(self.flat * by @ by.T, (len(x), *2 * (len(by),)))
        return Quadratic(self.value(shape, x), gradient, hessian.copy())


@pytest.mark.parametrize("flat", [1.0, 0.2])
def test_frames_come_to_their_goals_however_far_plain_steps_lead(rng, flat: float):
    """A model that is five times too flat takes steps of four times the way too many."""
    goal = rng.normal(size=(FRAMES, UNKNOWNS))
    bowl = Bowl(goal, flat, np.zeros((IDENTITIES, UNKNOWNS)))
    alone = Smoothness.none(FRAMES, UNKNOWNS)
    found = solve_frames(bowl, np.zeros(UNKNOWNS), np.zeros_like(goal), alone, steps=60)
    assert np.abs(found - goal).max() < 0.1


def test_weights_come_to_their_goals_under_poses_that_are_held(rng):
    """Where what a weight does is much like what a pose does, they go where that pose leaves them."""
    goal, moves = rng.normal(size=(FRAMES, UNKNOWNS)), np.zeros((IDENTITIES, UNKNOWNS))
    start = rng.normal(size=goal.shape)

    class Tied(Bowl):
        def select(self, frames: slice) -> "Bowl":
            return Tied(self.goal[frames], self.flat, self.moves)

        def value(self, shape: np.ndarray, x: np.ndarray) -> np.ndarray:
            return super().value(shape, x) + 2 * (x[:, 0] + x[:, -1]) ** 2

        def linearize(self, shape: np.ndarray, x: np.ndarray, with_identity: bool = False) -> Quadratic:
            quadratic = super().linearize(shape, x)
            both = np.eye(UNKNOWNS)[0] + np.eye(UNKNOWNS)[-1]
            push = 4 * (x[:, 0] + x[:, -1])
            hessian = quadratic.hessian + 4 * np.outer(both, both)
            return Quadratic(self.value(shape, x), quadratic.gradient + push[:, None] * both, hessian)

    bowl, alone = Tied(goal, 1.0, moves), Smoothness.none(FRAMES, UNKNOWNS)
    found = solve_frames(PosesHeld(bowl), np.zeros(UNKNOWNS), start, alone, steps=20)
    np.testing.assert_array_equal(found[:, WEIGHTS:], start[:, WEIGHTS:])
    expected = goal[:, :WEIGHTS].copy()
    expected[:, 0] = (goal[:, 0] - 4 * start[:, -1]) / 5
    np.testing.assert_allclose(found[:, :WEIGHTS], expected, atol=0.01)


@pytest.mark.parametrize("flat", [1.0, 0.2])
def test_an_identity_is_held_by_its_prior_once_for_each_key_frame(rng, flat: float):
    """Of frames whose weights are bounded at zero only the identity is left to explain what is seen."""
    goal, moves = rng.normal(size=(FRAMES, UNKNOWNS)), rng.normal(size=(IDENTITIES, UNKNOWNS))
    goal[:, WEIGHTS:], moves[:, WEIGHTS:] = 0, 0
    bowl = Bowl(goal, flat, moves)
    bowl.model = SimpleNamespace(modes=SimpleNamespace(lower=np.zeros(WEIGHTS), upper=np.zeros(WEIGHTS)))
    start = np.zeros(IDENTITIES)
    solution = solve_subject(bowl, start, np.zeros_like(goal), steps=200)
    # sum over frames of |goal + identity moves|^2 + .5 |identity|^2, each once a frame.
    expected = -np.linalg.solve(moves @ moves.T + 0.5 * np.eye(IDENTITIES), moves @ goal.mean(0))
    np.testing.assert_allclose(solution.identity, expected, atol=0.02)
    value = bowl.value(bowl.shape(solution.identity), solution.x).sum()
    assert solution.value == pytest.approx(value + 0.25 * FRAMES * solution.identity @ solution.identity)


def test_weights_at_a_bound_are_held_only_when_pushed_out():
    x = np.zeros((1, UNKNOWNS))
    x[0, :3] = [0.0, 1.0, 0.5]
    inward, outward = np.full((1, UNKNOWNS), 1.0), np.full((1, UNKNOWNS), -1.0)
    np.testing.assert_array_equal(UNIT.held(x, inward)[0, :3], [True, False, False])
    np.testing.assert_array_equal(UNIT.held(x, outward)[0, :3], [False, True, False])
    assert not UNIT.held(x, inward)[0, 3:].any()


def test_bounded_step_finds_the_bounded_minimum():
    # Two coupled weights; the unbounded minimum (2, 0.2) is outside, the bounded one is (1, 0.7).
    hessian = np.array([[2.0, 1.0], [1.0, 2.0]])
    x = np.full((1, 2 + POSE), 0.5)

    def solve(fixed, move):
        step, free = move.copy(), np.flatnonzero(~fixed[0, :2])
        pull = hessian @ (x[0, :2] - [2.0, 0.2]) + hessian @ move[0, :2]
        step[0, free] = -np.linalg.solve(hessian[np.ix_(free, free)], pull[free])
        return np.zeros(0), step

    step = bounded_step(UNIT, x, np.zeros_like(x), solve)[1]
    np.testing.assert_allclose((x + step)[0, :2], [1.0, 0.7])


def test_clamp_cuts_weights_and_not_the_pose():
    x = np.full((2, UNKNOWNS), -3.0)
    np.testing.assert_array_equal(UNIT.clamp(x)[:, :WEIGHTS], 0)
    np.testing.assert_array_equal(UNIT.clamp(x)[:, WEIGHTS:], -3)
