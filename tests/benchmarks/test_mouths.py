"""Mouths of the films: what is added stays behind the lips and moves no truth, and shade falls where it should."""

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.mouths import crevices, furnished, vermilion
from benchmarks.rendered_heads import SCENES, Scene, scene_motion, stranger
from tracker.head import HeadModel, load_head
from tracker.raster import rasterize

PIXELS_PER_M = 3000.0


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def shown(person: HeadModel, vertices: NDArray[np.floating]) -> NDArray[np.floating]:
    """[N, 2] m, where teeth or tongue are seen from the front."""
    pixels = np.stack(
        [vertices[:, 0] + 0.1, 0.1 - vertices[:, 1], (1 - vertices[:, 2]) / PIXELS_PER_M], axis=1
    )
    raster = rasterize(PIXELS_PER_M * pixels, person.faces, (600, 700))
    hidden = np.concatenate([person.regions["teeth"], person.regions["tongue"]])
    seen = (raster.triangle >= 0) & np.isin(person.faces, hidden).all(1)[raster.triangle]
    rows, columns = np.nonzero(seen)
    return np.stack([columns / PIXELS_PER_M - 0.1, 0.1 - rows / PIXELS_PER_M], axis=1)


def test_face_is_as_it_was(head: HeadModel) -> None:
    person, face = furnished(head), head.regions["face"]
    np.testing.assert_array_equal(person.template[face], head.template[face])
    np.testing.assert_array_equal(person.expression_basis[:, face], head.expression_basis[:, face])


@pytest.mark.parametrize("scene", [s for s in SCENES if s.speaks], ids=lambda scene: scene.name)
def test_teeth_are_seen_between_parted_lips_only(head: HeadModel, scene: Scene) -> None:
    person = furnished(stranger(head, scene))
    weights = scene_motion(scene).expression_for(person.expression_names)
    vertices = person.vertices(np.zeros(1), weights)
    gap, lips = person.lip_gap_mm(vertices), person.regions["lips"]
    assert len(shown(person, vertices[gap.argmin()])) < 20
    wide = vertices[gap.argmax()]
    places = shown(person, wide)
    assert len(places) > 200
    assert (places >= wide[lips, :2].min(0)).all() and (places <= wide[lips, :2].max(0)).all()


def test_vermilion_fades_away_from_the_line_where_lips_meet(head: HeadModel) -> None:
    lips = head.regions["lips"]
    weight = vermilion(head, lips)
    height = np.abs(head.template[lips, 1] - head.template[head.regions["inner_lip_upper"][7], 1])
    middle = np.abs(head.template[lips, 0]) < 0.005
    assert weight[middle & (height < 0.004)].min() > 0.8
    assert weight[middle & (height > 0.0115)].max() < 0.2


def test_crevices_are_what_lies_behind_its_surroundings() -> None:
    across = np.broadcast_to(np.linspace(0.5, 0.52, 200, dtype=np.float32), (120, 200))
    assert crevices(across, 0.001, PIXELS_PER_M)[20:-20, 20:-20].max() < 1e-3
    narrow, broad, ridge = across.copy(), across.copy(), across.copy()
    narrow[58:62] += np.float32(0.002)
    broad[50:70] += np.float32(0.002)
    ridge[58:62] -= np.float32(0.002)
    size = 0.002
    at = [crevices(depth, size, PIXELS_PER_M)[60, 100] for depth in (narrow, broad, ridge)]
    assert at[0] > at[1] > 0.05 and at[2] == 0
    open_air = across.copy()
    open_air[:, :60] = np.inf
    assert crevices(open_air, size, PIXELS_PER_M)[:, 60:140].max() < 1e-3
