"""Eyes look where the irises are seen, however the head is turned meanwhile."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.flame_factory import FakeFlame
from tests.tracker.test_flame import arrays, surface
from tracker.energy import Energy, Weights, landmark_model, rotation_matrix
from tracker.flame import flame_head
from tracker.gaze import LIMIT, eye_rotations
from tracker.head import HeadModel, load_head

FOCAL, PRINCIPAL = 1000.0, np.array([320.0, 240.0])


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def seen(
    head: HeadModel, eyes: np.ndarray, head_yaw: float, identity: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, Energy]:
    """Unknowns x [n, P], landmarks [n, 478, 2] px and the energy of a resting face whose eyes [n, 2, 3] move.

    identity: [Ki], of the mean face if there is none.
    """
    count, model = len(eyes), landmark_model(head, Weights())
    rotation = np.tile([0.0, head_yaw, 0.0], (count, 1))
    x = np.concatenate(
        [np.zeros((count, model.expressions)), rotation, np.tile([0.02, 0.01, 0.6], (count, 1))], axis=1
    )
    who = np.zeros(len(head.identity_basis)) if identity is None else identity
    rest = np.tile(who, (count, 1)), np.zeros((count, len(head.expression_basis)))
    points = head.landmark_positions(*rest, eyes=eyes) - model.centre
    camera = points @ rotation_matrix(rotation).transpose(0, 2, 1) + x[:, None, -3:]
    observed = np.zeros((count, 478, 2))
    observed[:, head.landmark_embedding.landmarks] = FOCAL * camera[..., :2] / camera[..., 2:] + PRINCIPAL
    ones = np.ones((count, len(model.landmarks)))
    scale = np.full(count, FOCAL / 0.6)
    return (
        x,
        observed,
        Energy(model, Weights(), FOCAL, PRINCIPAL, observed[:, model.landmarks], scale, ones, ones[:, 0]),
    )


@pytest.mark.parametrize("head_yaw", np.radians([0.0, 15.0, -25.0, 35.0]))
def test_a_turned_head_looks_as_far_as_a_straight_one(head: HeadModel, head_yaw: float) -> None:
    random = np.random.default_rng(0)
    # Pairs of opposite looks: their median is straight ahead, which is what is held.
    looks = random.uniform(-0.4, 0.4, (20, 1, 2))
    eyes = np.zeros((41, 2, 3))
    eyes[1:, :, :2] = np.concatenate([looks, -looks])
    x, observed, energy = seen(head, eyes, head_yaw)
    nothing = np.zeros((41, len(head.expression_basis)), np.float32)
    found = eye_rotations(head, np.zeros(len(head.identity_basis)), nothing, x, observed, energy)
    apart = Rotation.from_rotvec(found.reshape(-1, 3)).inv() * Rotation.from_rotvec(eyes.reshape(-1, 3))
    assert np.degrees(apart.magnitude().max()) < 0.05


def test_an_iris_beside_the_eyeball_turns_it_no_farther_than_eyes_turn(head: HeadModel) -> None:
    x, observed, energy = seen(head, np.zeros((3, 2, 3)), 0.0)
    observed[1] += (200.0, 0.0)
    nothing = np.zeros((3, len(head.expression_basis)), np.float32)
    found = eye_rotations(head, np.zeros(len(head.identity_basis)), nothing, x, observed, energy)
    assert np.isfinite(found).all()
    assert np.linalg.norm(found[1], axis=-1) == pytest.approx(LIMIT, abs=0.02)


def looks(count: int, size: float) -> np.ndarray:
    """[2 count + 1, 2, 3] rad, eyes that look about, each look with its opposite: their median is straight ahead."""
    turns = np.random.default_rng(1).uniform(-size, size, (count, 1, 2))
    eyes = np.zeros((2 * count + 1, 2, 3))
    eyes[1:, :, :2] = np.concatenate([turns, -turns])
    return eyes


def apart_deg(found: np.ndarray, eyes: np.ndarray) -> float:
    between = Rotation.from_rotvec(found.reshape(-1, 3)).inv() * Rotation.from_rotvec(eyes.reshape(-1, 3))
    return float(np.degrees(between.magnitude().max()))


def test_eyes_are_those_of_the_subject(head: HeadModel) -> None:
    """Another person's eyeballs lie elsewhere."""
    identity = 1.5 * np.random.default_rng(2).normal(size=len(head.identity_basis))
    eyes = looks(10, 0.4)
    x, observed, energy = seen(head, eyes, 0.2, identity)
    nothing = np.zeros((len(eyes), len(head.expression_basis)), np.float32)
    assert apart_deg(eye_rotations(head, identity, nothing, x, observed, energy), eyes) < 0.05


def test_eyes_that_never_look_the_same_way_are_the_heads_error(head: HeadModel) -> None:
    eyes = looks(10, 0.3)
    crossed = eyes + np.radians([[[0.0, 4.0, 0.0], [0.0, -2.0, 0.0]]])
    x, observed, energy = seen(head, crossed, 0.0)
    nothing = np.zeros((len(eyes), len(head.expression_basis)), np.float32)
    found = eye_rotations(head, np.zeros(len(head.identity_basis)), nothing, x, observed, energy)
    np.testing.assert_allclose(found[0], np.radians([[0.0, 1.0, 0.0]] * 2), atol=1e-3)


def test_a_flame_heads_eyes_look_where_its_irises_are_seen() -> None:
    fake = FakeFlame()
    flame = flame_head("flame", arrays(fake), surface(fake), {})
    eyes = looks(10, 0.4)
    x, observed, energy = seen(flame, eyes, 0.2)
    nothing = np.zeros((len(eyes), len(flame.expression_basis)), np.float32)
    found = eye_rotations(flame, np.zeros(len(flame.identity_basis)), nothing, x, observed, energy)
    assert apart_deg(found, eyes) < 3  # its pose correctives, which are noise here, move the irises
