"""Motions from the front: the embedded head shows teeth in an open mouth, any other head is clay."""

import numpy as np
import pytest
from numpy.typing import NDArray

from personalize.render.face import CLAY, FaceCamera
from tracker.head import HeadModel, load_head

SIZE = (480, 480)
U8 = NDArray[np.uint8]


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def moved(head: HeadModel, **weights: float) -> NDArray[np.float32]:
    basis = (weight * head.expression_basis[head.expression_names.index(w)] for w, weight in weights.items())
    return sum(basis, np.zeros_like(head.template))


def teeth_rows(picture: U8) -> NDArray[np.integer]:
    """Rows of pixels that are bright and nearly grey below the nose, as teeth are and skin and lips are not."""
    rgb = picture[260:380, 120:320].astype(int)
    return np.nonzero((rgb.min(2) > 110) & (np.ptp(rgb, axis=2) < 45))[0]


def test_open_mouth_shows_teeth_that_stay_with_the_skull_and_a_shut_one_none(head: HeadModel) -> None:
    camera = FaceCamera(head.template, head.faces, head.regions["face"], SIZE)
    shut = camera.picture(moved(head))
    some, more = (
        teeth_rows(camera.picture(moved(head, jawOpen=jaw, mouthUpperUpLeft=0.6, mouthUpperUpRight=0.6)))
        for jaw in (0.3, 0.6)
    )
    assert len(teeth_rows(shut)) == 0
    assert len(some) > 50 and len(more) > 50 and abs(some.min() - more.min()) <= 1


def test_another_topology_is_clay(head: HeadModel) -> None:
    camera = FaceCamera(head.template, head.faces[:-1], head.regions["face"], SIZE)
    face = camera.picture(moved(head, jawOpen=0.6))[120:380, 180:300].astype(float)
    # Brightness changes over it, the colour does not.
    assert face[..., 0].std() > 5
    np.testing.assert_allclose(
        face[..., 1:] / face[..., :1], np.full((260, 120, 2), CLAY[1:]) / CLAY[0], atol=0.03
    )
