"""Which frames tell who it is, on generated talkers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.tracker.test_fit import CAMERA, DISTANCE, FOCAL, HEAD, NAMES, Talker
from tracker.fit import at_ease, resume
from tracker.key_frames import KEY_FRAMES, KeyFrames, farthest, key_frames


def chosen(talker: Talker) -> KeyFrames:
    scale = np.full(len(talker.gap), FOCAL / DISTANCE)
    return key_frames(talker.landmarks.points[..., :2].astype(np.float64), scale)


def test_the_farthest_points_spread_and_are_never_taken_twice():
    line = np.arange(11.0)[:, None]
    np.testing.assert_array_equal(farthest(line, np.array([0]), np.arange(11), 4), [0, 10, 5, 2])
    np.testing.assert_array_equal(farthest(line, np.array([0]), np.arange(3, 8), 3), [0, 7, 3])
    twins = np.array([[1.0], [2.0], [1.0], [2.0]])
    np.testing.assert_array_equal(farthest(twins, np.array([0]), np.arange(4), 4), [0, 1])


def test_key_frames_hold_every_pose_and_expression_however_rare():
    """A head that looks ahead, but for two seconds in forty, in one of which it turns aside, in one nods."""
    turn = np.zeros((1000, 2))
    turn[500:525, 0], turn[800:825, 1] = 25 * np.sin(np.linspace(0, np.pi, 25)), 15
    talker = Talker(1000, turn=Rotation.from_euler("yx", turn, degrees=True))
    keys = chosen(talker)
    rest, other = keys.rest, keys.other
    assert len(np.unique(np.concatenate([rest, other]))) == KEY_FRAMES == len(rest) + len(other)
    assert talker.gap[rest].max() < np.quantile(talker.gap, 0.3)
    for frames in (rest, other):
        assert turn[frames, 0].max() > 15
        assert turn[frames, 1].max() > 10
    blink = talker.expression[:, NAMES.index("eyeBlinkLeft")]
    for state in (talker.gap, blink):
        assert state[other].min() <= np.quantile(state, 0.2)
        assert state[other].max() > np.quantile(state, 0.95)


def test_one_slip_of_the_landmarker_is_no_key_frame():
    talker = Talker(400, noise=0.001)
    talker.landmarks.points[200, 1] += 200  # the nose's tip
    assert 200 not in chosen(talker).rows


def test_a_head_turned_far_aside_gives_no_key_frame():
    """What landmarks say there is worth less than what they cost. One filmed from aside throughout does."""
    aside = Rotation.from_euler("y", np.where(np.arange(300) < 60, 50.0, 0.0)[:, None], degrees=True)
    assert chosen(Talker(300, turn=aside)).rows.min() >= 60
    always = Rotation.from_euler("y", np.full((300, 1), 30.0), degrees=True)
    assert len(chosen(Talker(300, turn=always)).rows) == KEY_FRAMES


def test_frames_that_look_alike_are_taken_once():
    talker = Talker(3, noise=0)
    points = talker.landmarks.points[[0] * 20, :, :2].astype(np.float64)
    keys = key_frames(points, np.full(20, FOCAL / DISTANCE))
    assert len(keys.rest) == len(keys.ease) == 1
    assert len(keys.other) == 0


def test_a_mouth_shut_in_a_smile_is_not_at_ease_and_one_that_is_turned_aside_is():
    turn = np.radians(25) * np.sin(np.arange(600) / 40)
    straight, smiling = (
        Talker(600, turn=Rotation.from_rotvec(np.outer(turn, [0, 1, 0])), held=(slice(None), weights))
        for weights in ({}, {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.6})
    )
    smiles = np.arange(600) % 70 < 20
    points = np.where(
        smiles[:, None, None], smiling.landmarks.points[..., :2], straight.landmarks.points[..., :2]
    )
    keys = key_frames(points.astype(np.float64), np.full(600, FOCAL / DISTANCE))
    smiled, aside = smiles[keys.rest], np.abs(turn[keys.rest]) > np.radians(15)
    assert smiled.any() and (aside & ~smiled).any()
    assert keys.ease[smiled].max() < 0.2
    assert keys.ease[aside & ~smiled].min() > 0.6


def test_key_frames_of_some_rows():
    keys = KeyFrames(np.array([0, 2]), np.array([1, 3]), np.array([0.2, 1.0]))
    rows = np.array([10, 20, 30, 40])
    assert keys.of(rows).rows.tolist() == [10, 30, 20, 40]
    some = keys.of(rows).among(np.array([30, 40, 99]))
    assert (some.rest.tolist(), some.other.tolist(), some.ease.tolist()) == ([30], [40], [1.0])


@pytest.mark.parametrize(("frames", "keys"), [(10, 10), (30, 16), (96, 32), (200, KEY_FRAMES)])
def test_of_a_short_clip_a_third_is_chosen_and_sixteen_at_least(frames: int, keys: int):
    found = chosen(Talker(frames))
    assert len(found.rows) == keys and len(found.rest) == min(keys // 2, max(1, frames // 5))


def test_expressions_are_held_where_a_face_rests_as_far_as_it_is_at_ease():
    keys = KeyFrames(np.array([4, 5, 6]), np.array([7, 8]), np.array([0.0, 0.5, 1.0]))
    talker = Talker(9)
    energy = resume(talker.fit(), talker.landmarks, CAMERA, HEAD)[0].select(keys.rows)
    held = at_ease(replace(energy, strictness=np.full(5, 2.0)), keys)
    np.testing.assert_allclose(held.strictness, 2 * 30 ** np.array([0, 0.5, 1, 0, 0]))
