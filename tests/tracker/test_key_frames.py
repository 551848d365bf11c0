"""Which frames tell who it is, on generated talkers."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.tracker.test_fit import DISTANCE, FOCAL, NAMES, Talker
from tracker.key_frames import KEY_FRAMES, farthest, key_frames


def chosen(talker: Talker) -> tuple[np.ndarray, np.ndarray]:
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
    rest, other = chosen(talker)
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
    assert 200 not in np.concatenate(chosen(talker))


def test_frames_that_look_alike_are_taken_once():
    talker = Talker(3, noise=0)
    points = talker.landmarks.points[[0] * 20, :, :2].astype(np.float64)
    rest, other = key_frames(points, np.full(20, FOCAL / DISTANCE))
    assert len(rest) == 1
    assert len(other) == 0
