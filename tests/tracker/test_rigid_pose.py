from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracker.energy import rotation_matrix, rotation_vector
from tracker.rigid_pose import FADE_S, hold_poses, turned_as_far
from tracker.track import Bundle

FRAMES, STEP = 90, 3
GOOD = np.arange(FRAMES)
RUN = np.zeros(FRAMES, np.int64)
TIME = np.arange(FRAMES) / 25
MIDDLE = np.array([0.0, 0.03, 0.01])


def turns_of(bundle: Bundle) -> Rotation:
    return Rotation.from_rotvec(bundle.rotation)


@pytest.fixture
def truth() -> np.ndarray:
    """[n, 8] two weights and a pose that swings."""
    turn = np.radians([6.0, 15.0, 3.0]) * np.sin(np.outer(TIME, [1.1, 1.6, 0.7]))
    place = [0.0, 0.02, 0.6] + 0.02 * np.sin(np.outer(TIME, [1.3, 0.8, 1.0]))
    return np.concatenate([np.full((FRAMES, 2), 0.3), turn, place], axis=1)


def bundle_of(x: np.ndarray, frames: np.ndarray) -> Bundle:
    """Exact poses of every STEP-th frame, of a head frame that is turned, moved and 4 % larger."""
    turn, shift = Rotation.from_rotvec([0.03, -0.02, 0.01]).as_matrix(), np.array([0.002, -0.001, 0.09])
    own = rotation_matrix(x[frames, -6:-3])
    translation = 1.04 * (x[frames, -3:] + own @ shift)
    empty = np.zeros((0, 3), np.float32)
    return Bundle(
        frame=frames.astype(np.int32),
        rotation=Rotation.from_matrix(own @ turn).as_rotvec().astype(np.float32),
        translation=translation.astype(np.float32),
        points=empty,
        observations=np.zeros((0, 4), np.float32),
    )


def drifted(x: np.ndarray) -> np.ndarray:
    """The poses as landmarks give them: off by up to two degrees, slowly; right on average."""
    drift = np.radians(2.0) * np.sin(2 * np.pi * np.arange(FRAMES) / FRAMES)
    out = x.copy()
    turn = Rotation.from_rotvec(np.outer(drift, [0.2, 1.0, 0.1])).as_matrix()
    out[:, 2:5] = rotation_vector(turn @ rotation_matrix(x[:, 2:5]))
    return out


def error_deg(x: np.ndarray, truth: np.ndarray) -> np.ndarray:
    relative = rotation_matrix(x[:, 2:5]) @ rotation_matrix(truth[:, 2:5]).transpose(0, 2, 1)
    return np.degrees(Rotation.from_matrix(relative).magnitude())


def test_poses_come_to_the_bundle_and_weights_stay(truth):
    start = drifted(truth)
    held = hold_poses(start, bundle_of(truth, GOOD[::STEP]), GOOD, RUN, TIME, GOOD, MIDDLE)
    assert error_deg(start, truth).mean() > 1.0
    assert error_deg(held, truth).mean() < 0.1
    assert np.abs(held[:, -3:] - truth[:, -3:]).max() < 0.002
    np.testing.assert_array_equal(held[:, :2], start[:, :2])


def test_frames_of_the_clip_that_are_not_measured_are_skipped(truth):
    good = np.setdiff1d(GOOD, [0, 1, 30, 31])
    start = drifted(truth)[good]
    held = hold_poses(
        start, bundle_of(truth, GOOD[::STEP]), good, RUN[good], TIME[good], np.arange(len(good)), MIDDLE
    )
    assert error_deg(held, truth[good]).mean() < 0.1


def test_nothing_is_carried_over_a_cut_nor_far_from_a_window(truth):
    start = drifted(truth)
    bundle = bundle_of(truth, GOOD[:30:STEP])
    held = hold_poses(start, bundle, GOOD, (GOOD >= 30).astype(np.int64), TIME, GOOD, MIDDLE)
    np.testing.assert_array_equal(held[30:], start[30:])
    held = hold_poses(start, bundle, GOOD, RUN, TIME, GOOD, MIDDLE)
    assert np.abs(held - start)[(TIME - TIME[27]) > FADE_S].max() < 1e-12
    step = np.diff(held[:, 2:5] - start[:, 2:5], axis=0)
    assert np.degrees(np.abs(step)).max() < 0.3


def test_without_a_bundle_poses_stay(truth):
    start = drifted(truth)
    for frames in (GOOD[:0], GOOD[:7]):
        np.testing.assert_array_equal(
            hold_poses(start, bundle_of(truth, frames), GOOD, RUN, TIME, GOOD, MIDDLE), start
        )


def test_a_place_whose_depth_is_uncertain_moves_nothing_sideways(truth):
    start, random = drifted(truth), np.random.default_rng(0)
    start[:, -1] += np.cumsum(random.normal(0, 0.002, FRAMES))  # landmarks see depth badly
    held = hold_poses(start, bundle_of(truth, GOOD[::STEP]), GOOD, RUN, TIME, GOOD, MIDDLE)
    assert np.abs(held[:, -3:-1] - truth[:, -3:-1]).max() < 0.001


def test_the_upper_face_stays_where_the_pictures_have_it(truth: np.ndarray) -> None:
    """Where landmarks see a head nod too far, as under a beard, brows and nose are seen in their place all the same."""
    nods, start = np.radians(5.0) * np.sin(1.6 * TIME), truth.copy()
    less = Rotation.from_rotvec(np.outer(nods - nods.mean(), [0.6, 0, 0])).as_matrix()
    start[:, 2:5] = rotation_vector(less @ rotation_matrix(truth[:, 2:5]))
    own, told = (rotation_matrix(x[:, 2:5]) @ MIDDLE for x in (truth, start))
    start[:, -3:] += own - told
    held = hold_poses(start, bundle_of(truth, GOOD[::STEP]), GOOD, RUN, TIME, GOOD, MIDDLE)
    turn = Rotation.from_matrix(
        rotation_matrix(held[:, 2:5]).transpose(0, 2, 1) @ rotation_matrix(truth[:, 2:5])
    )
    upper = held[:, -3:] + rotation_matrix(held[:, 2:5]) @ MIDDLE - truth[:, -3:] - own
    assert (
        np.degrees((turn.mean().inv() * turn).magnitude()).mean() < 0.05
        and np.ptp(upper, axis=0).max() < 2e-4
    )


def test_a_share_of_the_way_leaves_the_rest_of_the_error(truth):
    start, bundle = drifted(truth), bundle_of(truth, GOOD[::STEP])
    held = hold_poses(start, bundle, GOOD, RUN, TIME, GOOD, MIDDLE, 0.5)
    assert error_deg(held, truth).mean() == pytest.approx(error_deg(start, truth).mean() / 2, rel=0.05)


def test_a_frame_that_sees_few_of_the_points_tells_nothing(truth):
    start, frames = drifted(truth), GOOD[::STEP]
    bundle = bundle_of(truth, frames)
    bundle.rotation[15] += np.radians(8.0)  # blurred: its tracks are lost or led astray
    seen = np.where(np.arange(len(frames)) == 15, 12, 100)
    observations = np.zeros((seen.sum(), 4), np.float32)
    observations[:, 0] = np.repeat(frames, seen)
    held = hold_poses(start, replace(bundle, observations=observations), GOOD, RUN, TIME, GOOD, MIDDLE)
    assert error_deg(held, truth).max() < 1.0
    assert error_deg(hold_poses(start, bundle, GOOD, RUN, TIME, GOOD, MIDDLE), truth).max() > 2.0


def test_between_frames_corrections_go_by_the_time_and_not_by_how_many_frames_there_are(truth):
    kept = np.random.default_rng(1).random(FRAMES) < 0.6
    kept[::STEP] = True
    good = np.flatnonzero(kept)
    start, bundle = drifted(truth), bundle_of(truth, GOOD[::STEP])
    whole = hold_poses(start, bundle, GOOD, RUN, TIME, GOOD, MIDDLE)
    some = hold_poses(start[good], bundle, good, RUN[good], TIME[good], np.arange(len(good)), MIDDLE)
    change = whole[good] - start[good]
    np.testing.assert_allclose(some - start[good], change, atol=0.002 * np.abs(change).max())


def flattened(bundle: Bundle, factor: float) -> Bundle:
    """The bundle, its turns out of the picture's plane larger by a factor, as if the face were flatter than it is."""
    rotation = turns_of(bundle)
    middle = rotation.mean()
    turned = Rotation.from_rotvec((factor, factor, 1.0) * (rotation * middle.inv()).as_rotvec()) * middle
    points = np.random.default_rng(3).normal([0, 0, -0.09], 0.02, (50, 3)).astype(np.float32)
    return replace(bundle, rotation=turned.as_rotvec().astype(np.float32), points=points)


def turn_deg(bundle: Bundle) -> float:
    """Out of the picture's plane."""
    rotation = turns_of(bundle)
    turn = (rotation * rotation.mean().inv()).as_rotvec()[:, :2]
    return float(np.degrees(np.linalg.norm(turn, axis=1)).mean())


@pytest.mark.parametrize(
    ("factor", "focal_sd_log", "low", "high"),
    [
        (0.75, 1.0, 0.9, 1.1),  # nothing is known of the focal length
        (0.75, 0.15, 0.0, 0.3),  # landmarks must have been led astray
        (1.3, 0.15, 0.0, 0.3),
        (0.95, 0.15, 0.15, 0.5),  # either may err by that
        (0.95, 0.0, 0.0, 0.3),  # the focal length is given
    ],
)
def test_a_bundle_turns_as_far_as_landmarks_and_it_tell_together(
    truth: np.ndarray, factor: float, focal_sd_log: float, low: float, high: float
) -> None:
    exact = bundle_of(truth, GOOD[::STEP])
    wrong, noise = flattened(exact, factor), np.random.default_rng(2).normal(0, np.radians(0.4), (FRAMES, 3))
    right = turned_as_far(wrong, truth + np.pad(noise, ((0, 0), (2, 3))), GOOD, GOOD, focal_sd_log)
    share = np.log(turn_deg(right) / turn_deg(wrong)) / np.log(turn_deg(exact) / turn_deg(wrong))
    assert low < share < high
    before, after = (
        Rotation.from_rotvec(b.rotation).apply(b.points.mean(0)) + b.translation for b in (wrong, right)
    )
    np.testing.assert_allclose(after, before, atol=1e-5)  # the face stays where it was seen


def test_what_is_turned_in_the_pictures_plane_stays(truth: np.ndarray) -> None:
    """It is seen whatever the depth: a head that only leans leans as far as its patches do."""
    leaning = truth.copy()
    leaning[:, 2:5] = np.radians([0.0, 0.0, 12.0]) * np.sin(1.6 * TIME)[:, None]
    leaning[:, 3] += np.radians(6.0) * np.sin(1.1 * TIME)
    bundle = bundle_of(leaning, GOOD[::STEP])
    told = leaning.copy()
    told[:, 3:5] *= 1.4, 0.8
    right = turned_as_far(bundle, told, GOOD, GOOD, 1.0)
    before, after = ((r * r.mean().inv()).as_rotvec().T for r in map(turns_of, (bundle, right)))
    np.testing.assert_allclose(after[2], before[2], atol=np.radians(0.05))
    assert after[1].std() / before[1].std() == pytest.approx(1.4, rel=0.1)


@pytest.mark.parametrize("jump", [0.4, 0.8, 2.0])
def test_a_frame_with_a_wrong_pose_does_not_shrink_the_others(truth: np.ndarray, jump: float) -> None:
    exact = bundle_of(truth, GOOD[::STEP])
    wrong = flattened(exact, 1.0)
    wrong.rotation[17] += [0.0, jump, 0.0]
    noise = np.pad(np.random.default_rng(2).normal(0, np.radians(0.4), (FRAMES, 3)), ((0, 0), (2, 3)))
    right = turned_as_far(wrong, truth + noise, GOOD, GOOD, 0.15)
    others = np.delete(np.arange(len(wrong.frame)), 17)
    left, whole = (Rotation.from_rotvec(b.rotation[others]) for b in (right, exact))
    turns = [(r * r.mean().inv()).magnitude().mean() for r in (left, whole)]
    assert turns[0] == pytest.approx(turns[1], rel=0.03)


def test_a_head_that_hardly_turns_or_is_hardly_known_says_nothing_of_how_far(truth: np.ndarray) -> None:
    still = truth.copy()
    still[:, 2:5] = still[0, 2:5]
    for x, frames in ((still, GOOD[::STEP]), (truth, GOOD[:7])):
        bundle = flattened(bundle_of(x, frames), 0.7)
        told = turned_as_far(bundle, drifted(x), GOOD, GOOD, 0.2)
        np.testing.assert_allclose(told.rotation, bundle.rotation, atol=np.radians(0.02))


def test_covered_frames_do_not_tell_how_the_head_frames_lie_to_each_other(truth: np.ndarray) -> None:
    bundle, covered = bundle_of(truth, GOOD[::STEP]), (GOOD >= 30) & (GOOD < 55)
    start = drifted(truth)
    start[covered, 2:5] = [0.3, 0.0, 0.0]  # behind a hand a face is seen that does not turn
    sound = GOOD[~covered]
    held = hold_poses(start, bundle, GOOD, RUN, TIME, sound, MIDDLE)
    assert error_deg(held, truth)[sound].max() < 0.5


def test_what_changes_from_one_known_frame_to_the_next_is_noise(truth: np.ndarray) -> None:
    frames, noise = GOOD[::STEP], np.radians(0.5) * np.random.default_rng(5).normal(size=(30, 3))
    bundle = bundle_of(truth, frames)
    turned = Rotation.from_rotvec(noise) * Rotation.from_rotvec(bundle.rotation)
    shaky = replace(bundle, rotation=turned.as_rotvec().astype(np.float32))
    held = hold_poses(drifted(truth), shaky, GOOD, RUN, TIME, GOOD, MIDDLE)
    # Of white noise a quarter, a half and a quarter leave .61.
    assert error_deg(held, truth)[frames].mean() < 0.75 * np.degrees(np.linalg.norm(noise, axis=1)).mean()


def test_nothing_is_carried_over_a_gap_between_known_frames(truth: np.ndarray) -> None:
    start, known = drifted(truth), (GOOD < 27) | (GOOD >= 60)
    held = hold_poses(start, bundle_of(truth, GOOD[known][::STEP]), GOOD, RUN, TIME, GOOD, MIDDLE)
    assert np.abs(held - start)[38:48].max() < 1e-12  # FADE_S is 12 frames
    assert np.abs(held - start)[30].max() > 1e-3
