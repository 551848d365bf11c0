"""Tubes: closed, and turned outward, or the rasterizer would not draw them."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from benchmarks.props import beard, glasses, hair, hand, tube
from tracker.head import load_head


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    return float(np.linalg.det(vertices[faces] - vertices.mean(0)).sum() / 6)


def test_tube_has_the_volume_of_a_cylinder() -> None:
    points = np.linspace([0, 0, 0], [0, 0.1, 0], 200)
    radius = np.full(200, 0.01)
    radius[[0, -1]] = 0
    prism = 10 / 2 * np.sin(2 * np.pi / 10) * 0.01**2 * 0.1  # ten sides
    assert volume(*tube(points, radius)) == pytest.approx(prism, rel=0.02)


def test_hair_lies_upon_the_head_and_leaves_eyes_and_mouth_bare() -> None:
    head = load_head()
    strands = hair(head, np.ones(3)).vertices
    skin = head.template[np.concatenate([head.regions["face"], head.regions["scalp"]])]
    front = skin[skin[:, 2] > 0.02]
    above, near = KDTree(front[:, :2]).query(strands[:, :2])
    inside = above < 0.004
    assert (strands[inside, 2] > front[near[inside], 2] - 0.002).mean() > 0.98
    for name in ("left_iris", "right_iris", "lips"):
        low, high = head.template[head.regions[name], :2].min(0), head.template[head.regions[name], :2].max(0)
        assert not ((strands[:, :2] > low) & (strands[:, :2] < high)).all(1).any()


def test_glasses_and_hand_turn_outward_and_stand_before_the_face() -> None:
    head = load_head()
    for prop in (glasses(head), hand(head, np.ones(3)), hair(head, np.ones(3))):
        assert volume(prop.vertices, prop.faces) > 0
    eyes = head.template[head.regions["eyes"], 2].max()
    assert 0.005 < glasses(head).vertices[:, 2].max() - eyes < 0.03
    lips, still = head.template[head.regions["lips"], 2].max(), np.zeros_like(head.template)
    assert hand(head, np.ones(3)).at(3.1, still)[:, 2].min() > lips
    assert hand(head, np.ones(3)).at(0.0, still)[:, 1].max() < head.template[:, 1].min() + 0.1


def test_a_beard_grows_around_the_mouth_and_goes_along_with_it() -> None:
    head = load_head()
    bristles = beard(head, np.ones(3))
    assert volume(bristles.vertices, bristles.faces) > 0
    lips, nose = head.template[head.regions["lips"]], head.template[head.regions["face"], 2].argmax()
    front = bristles.vertices[np.abs(bristles.vertices[:, 0]) < 0.02]
    assert bristles.vertices[:, 1].max() < head.template[head.regions["eyes"], 1].min()
    assert front[:, 1].max() < head.template[head.regions["face"][nose], 1]
    over = front[(front[:, 1] < lips[:, 1].max()) & (front[:, 1] > lips[:, 1].mean())]
    assert len(over) > 1000  # over the edge of the upper lip
    opened = head.vertices(
        np.zeros(len(head.identity_basis)),
        np.eye(len(head.expression_names))[head.expression_names.index("jawOpen")],
    )
    moved = bristles.at(1.0, opened - head.template) - bristles.vertices
    chin = bristles.vertices[:, 1] < lips[:, 1].min() - 0.01
    upper = (bristles.vertices[:, 1] > lips[:, 1].max()) & (np.abs(bristles.vertices[:, 0]) < 0.015)
    assert moved[chin, 1].mean() < -0.01 and np.abs(moved[upper, 1]).mean() < 0.003
