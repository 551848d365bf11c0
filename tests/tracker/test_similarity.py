"""The similarity between two sets of points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracker.similarity import similarity


def test_similarities_are_found_exactly() -> None:
    random = np.random.default_rng(1)
    source, shift = random.normal(size=(4, 9, 3)), random.normal(size=(4, 3))
    turned, scale = Rotation.random(4, random_state=2).as_matrix(), np.array([0.5, 1, 2, 300])
    target = scale[:, None, None] * source @ turned.transpose(0, 2, 1) + shift[:, None]
    for found, true in zip(similarity(source, target), (scale, turned, shift)):
        np.testing.assert_allclose(found, true, atol=1e-9)
    one = similarity(source[2], target[2])
    for found, true in zip(one, (2.0, turned[2], shift[2])):
        np.testing.assert_allclose(found, true, atol=1e-9)


def test_a_rigid_motion_has_the_scale_one() -> None:
    source = np.random.default_rng(1).normal(size=(9, 3))
    scale, rotation, shift = similarity(source, 2 * source + [1, 2, 3], scaled=False)
    assert scale == 1
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(shift - source.mean(0), [1, 2, 3])


def test_no_similarity_mirrors() -> None:
    source = np.random.default_rng(1).normal(size=(9, 3)) * [3, 2, 1]
    _, rotation, _ = similarity(source, source * [1, 1, -1])
    assert np.linalg.det(rotation) == pytest.approx(1)
