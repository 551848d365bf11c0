"""Rendered mouths: what is added stays behind the lips and moves no face, and shade falls where it should."""

from dataclasses import replace

import numpy as np
import pytest

from personalize.render.mouth import MouthDetail, crevices, furnished, on_the_jaw, teeth, vermilion
from personalize.talkers.film import ASSETS, demo_identity
from personalize.talkers.motion import talker_motion
from personalize.talkers.visemes import load_phones
from tests.personalize.mouth_view import PIXELS_PER_M, assert_seen_between_parted_lips_only
from tracker.head import HeadModel, load_head
from tracker.raster import Raster


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def test_face_is_as_it_was(head: HeadModel) -> None:
    person, face = furnished(head), head.regions["face"]
    np.testing.assert_array_equal(person.template[face], head.template[face])
    np.testing.assert_array_equal(person.expression_basis[:, face], head.expression_basis[:, face])


@pytest.mark.parametrize("seed", range(4))
def test_teeth_are_seen_between_parted_lips_only(head: HeadModel, seed: int) -> None:
    moves = talker_motion(load_phones(ASSETS / "demo_speech.json"), 6.0, 25.0, seed)
    nothing = np.zeros(len(head.expression_names), np.float32)
    template = head.vertices(demo_identity(head, seed), nothing)
    person = furnished(replace(head, template=template))
    displacement = np.tensordot(
        moves.expression_for(head.expression_names), head.expression_basis, axes=1
    ).astype(np.float32)
    moved = person.template + on_the_jaw(displacement, person)
    assert_seen_between_parted_lips_only(person, moved)


def test_jaw_takes_lower_teeth_and_tongue_along_and_leaves_the_upper_ones(head: HeadModel) -> None:
    moved = on_the_jaw(head.expression_basis[head.expression_names.index("jawOpen")], head)
    upper, lower = teeth(head)
    assert len(upper) == len(lower) and np.abs(moved[upper]).max() < 1e-4
    assert np.abs(moved[head.regions["tongue"]] - moved[lower].mean(0)).max() < 1e-6
    assert moved[lower, 1].max() < -0.005


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


@pytest.mark.parametrize("lips", [(-50.0, 30.0), (30.0, -50.0), (130.0, 30.0), (30.0, 130.0)])
def test_mouth_outside_the_picture_changes_nothing_in_it(head: HeadModel, lips: tuple[float, float]) -> None:
    picture = np.full((60, 60, 3), 100, np.uint8)
    seen = Raster(
        np.zeros((60, 60), np.int32), np.full((60, 60, 3), 1 / 3, np.float32), np.ones((60, 60), np.float32)
    )
    detail = MouthDetail.of(furnished(head), len(head.template), 0)
    detail.lay(picture, seen, head.faces, np.array([lips]), 1000.0)
    np.testing.assert_array_equal(picture, 100)
