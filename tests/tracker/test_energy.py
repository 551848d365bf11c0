from dataclasses import replace

import numpy as np
import pytest

import tracker.energy
from tests.flame_factory import FakeFlame
from tests.tracker.test_flame import arrays, surface
from tracker.energy import (
    FACING,
    LID_PAIRS,
    LIP_PAIRS,
    Energy,
    LandmarkModel,
    Weights,
    landmark_model,
    left_jacobian,
    rotation_axis_angle,
    rotation_matrix,
    rotation_vector,
    visibility,
)
from tracker.flame import flame_head
from tracker.head import load_head
from tracker.modes import Modes, head_modes

IDENTITIES, EXPRESSIONS, POINTS = 4, 5, 30


def random_modes() -> Modes:
    to_head = np.eye(EXPRESSIONS, EXPRESSIONS + 3)
    to_head[0, 1] = 1.0  # mouthClose carries jawOpen along
    bounds = np.zeros(EXPRESSIONS), np.ones(EXPRESSIONS)
    return Modes(to_head, *bounds, np.full(EXPRESSIONS, 5.0), np.full(EXPRESSIONS, 4.0), bounds)


def random_model(seed: int = 0) -> LandmarkModel:
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=(POINTS, 3)) * [0.05, 0.06, 0.02]
    return LandmarkModel(
        landmarks=np.arange(POINTS, dtype=np.int32),
        mean=mean - mean.mean(0),
        identity=rng.normal(size=(IDENTITIES, POINTS, 3)) * 0.003,
        expression=rng.normal(size=(EXPRESSIONS, POINTS, 3)) * 0.005,
        centre=np.array([0.0, 0.03, 0.08]),
        normals=np.tile([0.0, 0.0, 1.0], (POINTS, 1)),
        pairs=np.array([[0, 1], [2, 3]]),
        touch=np.array([0.02, -0.08]),
        modes=random_modes(),
    )


def random_energy(frames: int, seed: int = 1) -> tuple[Energy, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = np.concatenate(
        [
            rng.uniform(0.1, 0.6, (frames, EXPRESSIONS)),
            rng.normal(size=(frames, 3)) * 0.3,
            [0.0, 0.0, 0.6] + rng.normal(size=(frames, 3)) * 0.02,
        ],
        axis=1,
    )
    energy = Energy(
        model=random_model(),
        weights=Weights(),
        focal=900.0,
        principal=np.array([320.0, 240.0]),
        observed=np.zeros((frames, POINTS, 2)),
        px_per_m=np.full(frames, 1500.0),
        visible=rng.uniform(0.1, 1.0, (frames, POINTS)),
        strictness=rng.uniform(1.0, 3.0, frames),
    )
    energy.observed[:] = energy.project(energy.model.mean, x) + rng.normal(size=energy.observed.shape) * 3
    return energy, x


@pytest.mark.parametrize("share", (0.0, 0.3))
def test_gradient_of_identity_and_frames_matches_finite_differences(share: float):
    energy, x = random_energy(3)
    energy = replace(energy, weights=Weights(pair_noise_share=share))
    identity = np.array([0.5, -0.2, 0.1, 0.8])
    analytic = energy.linearize(energy.shape(identity), x, with_identity=True)
    both = np.concatenate([np.tile(identity, (3, 1)), x], axis=1)

    def value(both):
        return energy.value(energy.shape(both[0, :IDENTITIES]), both[:, IDENTITIES:])

    np.testing.assert_allclose(analytic.value, value(both))
    for column in range(both.shape[1]):
        step = np.zeros(both.shape[1])
        step[column] = 1e-6
        numeric = (value(both + step) - value(both - step)) / 2e-6
        np.testing.assert_allclose(analytic.gradient[:, column], numeric, rtol=1e-4, atol=1e-3)


def test_an_error_of_an_open_pair_weighs_less_than_one_of_a_shut_pair():
    energy, x = random_energy(1)
    weights = Weights(pair_noise_mm=0.1, pair_noise_share=0.1, robust=1e3)
    cost = []
    for open_m in (0.0, 0.01):
        shape = energy.model.mean.copy()
        touch = energy.model.heights(shape) - open_m
        told = replace(
            energy,
            weights=weights,
            model=replace(energy.model, touch=touch, expression=0 * energy.model.expression),
        )
        told.observed[:] = told.project(shape, x)
        exact = told.value(shape, x)
        shape[0, 1] += 0.001
        cost.append(float((told.value(shape, x) - exact)[0]))
    assert cost[1] < 0.5 * cost[0]


def test_hessian_is_symmetric_and_convex():
    energy, x = random_energy(2)
    hessian = energy.linearize(energy.model.mean, x).hessian
    np.testing.assert_allclose(hessian, hessian.transpose(0, 2, 1), rtol=1e-9, atol=1e-9)
    assert (np.linalg.eigvalsh(hessian) > 0).all()


def test_a_landmark_far_off_hardly_pulls():
    energy, x = random_energy(1)
    energy.observed[:] = energy.project(energy.model.mean, x)
    near, far = energy.observed.copy(), energy.observed.copy()
    near[0, 10, 0] += 5
    far[0, 10, 0] += 500
    pulls = []
    for observed in (near, far):
        energy.observed[:] = observed
        pulls.append(np.abs(energy.linearize(energy.model.mean, x).gradient[0, -3]))
    assert pulls[1] < 0.2 * pulls[0]


def test_project_follows_the_opencv_camera():
    energy, x = random_energy(1)
    x[:] = 0
    x[0, -1] = 0.5
    shape = np.zeros((POINTS, 3))
    shape[0] = [0.01, 0.02, 0.1]  # to the subject's left, up, out of the face
    pixel = energy.project(shape, x)[0, 0]
    np.testing.assert_allclose(pixel, [320 + 900 * 0.01 / 0.4, 240 - 900 * 0.02 / 0.4])


def test_head_weights_keep_mouth_close_under_jaw_open():
    weights = np.random.default_rng(0).uniform(0, 1, (100, EXPRESSIONS))
    arkit, jaw = random_model().modes.head_weights(weights)
    assert not jaw.any()
    assert (arkit[:, 0] <= arkit[:, 1]).all()
    assert arkit.min() >= 0
    assert arkit.max() <= 1


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.4, 1.5])
def test_rotations_round_trip(angle: float):
    rotation = np.array([[0.3, -0.8, 0.52]])
    rotation *= angle / np.linalg.norm(rotation)
    matrix = rotation_matrix(rotation)
    np.testing.assert_allclose(rotation_vector(matrix), rotation, atol=1e-9)
    whole = rotation_axis_angle(matrix)
    np.testing.assert_allclose(rotation_matrix(whole) @ FACING, matrix, atol=1e-9)


def test_left_jacobian_matches_finite_differences():
    rotation = np.array([[0.0, 0.0, 0.0], [0.4, -0.2, 0.9]])
    jacobian = left_jacobian(rotation)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        turn = rotation_matrix(rotation + step) @ rotation_matrix(rotation).transpose(0, 2, 1)
        np.testing.assert_allclose(
            np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1),
            jacobian[..., axis] * 1e-6,
            atol=1e-11,
        )


def test_skin_turned_away_counts_little():
    model = random_model()
    rotation = np.array([[0.0, 0.0, 0.0], [0.0, np.pi, 0.0]])
    seen = visibility(model, rotation, np.tile([0.0, 0.0, 1.0], (2, 1)))
    assert (seen[0] == 1).all()
    assert (seen[1] == seen[1].min()).all()
    assert 0 < seen[1].min() < 0.1


def test_skin_is_seen_alike_however_many_frames_are_asked_at_once(monkeypatch: pytest.MonkeyPatch):
    random = np.random.default_rng(0)
    poses = random.normal(0, 1, (20, 3)), random.normal((0, 0, 1), 0.1, (20, 3))
    whole = visibility(model := random_model(), *poses)
    monkeypatch.setattr(tracker.energy, "TOGETHER", 7)
    np.testing.assert_array_equal(visibility(model, *poses), whole)


def test_the_energy_is_the_sum_of_its_parts():
    """Each as it is written, landmark by landmark; lengths in standard deviations."""
    energy, x = random_energy(2)
    model, weights = energy.model, energy.weights
    expected = np.zeros(2)
    for frame in range(2):
        w, turn, shift = (
            x[frame, :EXPRESSIONS],
            rotation_matrix(x[frame : frame + 1, -6:-3])[0],
            x[frame, -3:],
        )
        face = model.mean + sum(weight * move for weight, move in zip(w, model.expression))
        seen = face @ turn.T + shift
        apart = energy.focal * seen[:, :2] / seen[:, 2:] + energy.principal - energy.observed[frame]
        mm = 1e3 / energy.px_per_m[frame]
        terms = [(mm * away / weights.noise_mm, share) for away, share in zip(apart, energy.visible[frame])]
        for upper, lower in model.pairs:  # a pair is seen no better than its worse half
            share = min(energy.visible[frame, upper], energy.visible[frame, lower])
            terms.append((mm * (apart[upper] - apart[lower]) / weights.pair_noise_mm, share))
        for away, share in terms:
            loss = weights.robust**2 * np.log(1 + away @ away / weights.robust**2)
            expected[frame] += 0.5 * weights.evidence * share * loss
        expected[frame] += energy.strictness[frame] * (
            model.modes.rate @ w + 0.5 * model.modes.precision @ w**2
        )
        for (upper, lower), touch in zip(model.pairs, model.touch):
            through = 1e3 * min(face[upper, 1] - face[lower, 1] - touch, 0) / weights.contact_mm
            expected[frame] += 0.5 * through**2
    np.testing.assert_allclose(energy.value(model.mean, x), expected)


def test_the_heads_landmarks_are_those_that_stay_on_its_skin_and_shut_where_lids_and_lips_meet():
    head = load_head()
    model = landmark_model(head, Weights())
    assert not np.isin(model.landmarks, [*range(468, 478), 234, 454, 93, 323, 127, 356]).any()
    assert len(model.landmarks) > 300
    assert {tuple(pair) for pair in model.landmarks[model.pairs].tolist()} == {*LIP_PAIRS, *LID_PAIRS}
    blinking = np.array([name.startswith("eyeBlink") for name in head.expression_names], np.float32)
    shut = head.landmark_positions(np.zeros(len(head.identity_basis)), blinking)
    y = dict(zip(head.landmark_embedding.landmarks.tolist(), shut[:, 1].tolist()))
    meet = [y[upper] - y[lower] for upper, lower in model.landmarks[model.pairs].tolist()]
    np.testing.assert_allclose(model.touch, meet, atol=1e-6)


def test_each_shape_has_its_bounds_and_its_prior():
    head, weights = load_head(), Weights()
    modes, names = head_modes(head, weights), list(head.expression_names)

    def of(name: str) -> tuple[float, float, float, float]:
        k = names.index(name)
        return tuple(float(values[k]) for values in (modes.lower, modes.upper, modes.rate, modes.precision))

    assert of("jawOpen") == of("eyeBlinkLeft") == of("mouthClose") == (0, 1, 2, 4)
    assert of("jawForward") == of("cheekPuff") == of("tongueOut") == (0, 1, 50, 4)
    assert of("mouthLeft") == of("jawRight") == (0, 1, 10, 4)
    assert of("lipUpper2") == of("lipLower3") == (-1, 1, 0, pytest.approx(0.6**-2))
    # A shut mouth under an open jaw: mouthClose never exceeds jawOpen.
    expression, _ = modes.head_weights(np.eye(len(modes))[names.index("mouthClose")])
    assert {names[k] for k in np.flatnonzero(expression)} == {"mouthClose", "jawOpen"}


def test_a_jaw_joint_has_its_prior_in_its_angles():
    fake = FakeFlame()
    modes = head_modes(flame_head("flame", arrays(fake), surface(fake), {}), Weights())
    for row, sd in ((-2, 0.2), (-1, 0.02)):
        _, jaw = modes.head_weights(np.eye(len(modes))[row])
        assert np.count_nonzero(jaw) == 1
        assert modes.precision[row] == pytest.approx((jaw.max() / sd) ** 2) and modes.rate[row] == 0
    widest = modes.head_weights(np.eye(len(modes))[-2] * modes.upper[-2])[1]
    np.testing.assert_allclose(widest, [0.7, 0, 0])
    assert (modes.precision[:-2] == 1).all() and np.isinf(modes.lower[:-2]).all()
