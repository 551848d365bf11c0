"""Heads that the model cannot imitate: how far off they are, that their lips still meet, and how they move."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.rendered_heads import CUT_S, FACE_DEPTH_M, FPS, SCENES, Scene, scene_motion, stranger
from tracker.head import HeadModel, load_head

SCENE = Scene("any", 3, seconds=2.0)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def test_neutral_is_beyond_every_identity(head: HeadModel) -> None:
    face = head.regions["face"]
    person = stranger(head, SCENE).template[face].astype(np.float64)
    centred = head.template[face].astype(np.float64)
    rigid = [np.broadcast_to(axis, centred.shape) for axis in np.eye(3)]
    rigid += [np.cross(axis, centred) for axis in np.eye(3)]
    known = np.concatenate([head.identity_basis[:, face], np.stack([*rigid, centred])]).reshape(
        -1, person.size
    )
    wanted = (person - head.template[face]).ravel()
    left = wanted - np.linalg.lstsq(known.T, wanted, rcond=None)[0] @ known
    assert 1e3 * np.sqrt((left.reshape(-1, 3) ** 2).sum(1).mean()) > 1.0


def test_motion_is_beyond_the_expressions(head: HeadModel) -> None:
    lips = head.regions["lips"]
    weights = scene_motion(SCENE).expression_for(head.expression_names).astype(np.float64)
    moved = np.tensordot(weights, stranger(head, SCENE).expression_basis[:, lips], axes=1).reshape(
        len(weights), -1
    )
    known = head.expression_basis[:, lips].reshape(len(head.expression_names), -1).astype(np.float64)
    left = moved - np.linalg.lstsq(known.T, moved.T, rcond=None)[0].T @ known
    # Even with weights of either sign and size.
    assert 1e3 * np.linalg.norm(left.reshape(len(weights), -1, 3), axis=-1).mean() > 0.05


def test_without_bend_and_warp_the_person_is_the_head(head: HeadModel) -> None:
    person = stranger(head, replace(SCENE, bend_mm=0.0, warp=0.0))
    np.testing.assert_allclose(person.expression_basis, head.expression_basis, atol=1e-7)
    wanted = (person.template - head.template).reshape(-1).astype(np.float64)
    known = head.identity_basis.reshape(len(head.identity_basis), -1).astype(np.float64)
    assert np.abs(wanted - np.linalg.lstsq(known.T, wanted, rcond=None)[0] @ known).max() < 1e-6


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_lips_meet_and_part(head: HeadModel, scene: Scene) -> None:
    person = stranger(head, scene)
    weights = scene_motion(scene).expression_for(head.expression_names)
    gap = person.lip_gap_mm(person.vertices(np.zeros(1), weights))
    assert -0.5 < gap.min() < 0.3
    assert gap.max() > 5 if scene.speaks else np.ptp(gap) == 0


def test_fast_turn_is_fast_and_comes_back() -> None:
    turned = scene_motion(replace(SCENE, seconds=5.0, head=0.0, fast_turn_deg=30.0))
    turns = Rotation.from_rotvec(turned.rotation)
    angle = np.degrees((turns * turns[0].inv()).magnitude())
    assert angle.max() == pytest.approx(30, abs=0.1) and angle[-1] < 0.1
    assert np.abs(np.diff(angle)).max() > 5


def test_a_head_turns_slowly_into_profile_on_either_side_and_back() -> None:
    turned = scene_motion(replace(SCENE, seconds=8.0, head=0.0, aside_deg=70.0))
    yaw = np.degrees(Rotation.from_rotvec(turned.rotation).as_matrix()[:, 0, 2])
    turns = Rotation.from_rotvec(turned.rotation)
    angle = np.degrees((turns * turns[0].inv()).magnitude())
    assert angle.max() == pytest.approx(70, abs=0.1) and angle[-1] < 0.1
    assert yaw.min() < -50 and yaw.max() > 50
    assert np.abs(np.diff(angle)).max() < 5


@pytest.mark.parametrize(("aside", "above"), [(30.0, 0.0), (-8.0, 0.0), (0.0, 18.0), (0.0, -20.0)])
def test_a_camera_elsewhere_sees_the_face_from_there_in_the_pictures_middle(
    aside: float, above: float
) -> None:
    still, face = replace(SCENE, head=0.0), np.array([0, 0, FACE_DEPTH_M])
    ahead, elsewhere = scene_motion(still), scene_motion(replace(still, camera_deg=(aside, above)))
    (turns, there), (turned, still_there) = (
        (turn, turn.apply(face) + motion.translation)
        for motion in (ahead, elsewhere)
        for turn in [Rotation.from_rotvec(motion.rotation)]
    )
    np.testing.assert_allclose(still_there, there, atol=1e-6)
    before, after = turns.inv().apply(-there), turned.inv().apply(-there)
    if not above:
        moved = np.arctan2(after[:, 0], after[:, 2]) - np.arctan2(before[:, 0], before[:, 2])
        np.testing.assert_allclose(np.degrees(moved), aside, atol=0.5)
    if not aside:
        moved = np.arctan2(after[:, 1], after[:, 2]) - np.arctan2(before[:, 1], before[:, 2])
        np.testing.assert_allclose(np.degrees(moved), above, atol=0.5)


def test_moods_come_and_go_and_leave_the_speech() -> None:
    moody = scene_motion(replace(SCENE, seconds=6.0, moods=True))
    even = scene_motion(replace(SCENE, seconds=6.0))
    apart = moody.expression - even.expression
    for name, second in (("mouthSmileLeft", 1.2), ("browInnerUp", 2.4), ("mouthLeft", 3.4)):
        column = apart[:, even.names.index(name)]
        assert column[round(second * FPS)] > 0.3 and column[0] == column[-1] == 0
    assert moody.expression.max() <= 1 and not apart[:, even.names.index("jawOpen")].any()


def test_a_cut_leaves_out_what_happens_meanwhile() -> None:
    scene = next(scene for scene in SCENES if np.isfinite(scene.shot_s))
    cut, whole = (
        scene_motion(scene),
        scene_motion(replace(scene, shot_s=np.inf, seconds=scene.seconds + CUT_S)),
    )
    first, missing = round(scene.shot_s * FPS), round(CUT_S * FPS)
    assert len(cut.expression) == round(scene.seconds * FPS)
    moved = np.abs(np.diff(cut.translation, axis=0)).max(1)
    assert moved[first - 1] > 5 * np.median(moved) and moved[2 * first - 1] > 5 * np.median(moved)
    assert len(whole.expression) == len(cut.expression) + missing
