"""What landmarks err by as a face turns and moves: by hand, then read on rendered heads whose turn is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.tracker.test_landmarker import CENTRE, FACING, FOCAL, SIZE
from tools.build_landmark_bias import View, about_person, learn, left_over
from tracker import landmark_bias as landmark_bias_module
from tracker.head import HeadModel, load_head
from tracker.landmark_bias import FARTHEST_SCORE, FARTHEST_TURN, USUAL_TURN, LandmarkBias, landmark_bias
from tracker.landmark_indices import MIRRORED, POINTS
from tracker.landmarker import track_landmarks
from tracker.raster import project, render

SEEN = np.arange(20, 50, dtype=np.int32)
STEADY = np.arange(30) < 20
PX_PER_M = 1000.0


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def bias() -> LandmarkBias:
    """Of which point 7 errs with yaw alone, point 9 with nods and point 11 with how far point 45 is pushed forward."""
    mean = np.random.default_rng(1).normal(size=(30, 3)).astype(np.float32) * 0.04
    modes, rate = np.zeros((1, 30, 3), np.float32), np.zeros((3, POINTS, 2), np.float32)
    modes[0, 25, 2] = 1 / 0.002
    of_turn = np.array([[0.5], [-0.3]], np.float32)
    rate[0, 7], rate[1, 9], rate[2, 11] = (0.02, 0.01), (0.03, -0.04), (0.001, 0.002)
    return LandmarkBias(SEEN, STEADY, mean, modes, of_turn, rate)


def _towards(yaw: float, nod: float) -> np.ndarray:
    """[3, 3] head axes to picture axes (y up) of a head that stands upright, its camera to the left and above it."""
    forward = np.array([np.tan(yaw), np.tan(nod), 1.0])
    forward /= np.linalg.norm(forward)
    side = np.cross([0, 1, 0], forward)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(forward, side), forward])


def _seen(
    bias: LandmarkBias,
    yaw: float = 0,
    nod: float = 0,
    pushed: float = 0,
    roll: float = 0,
    scale: float = PX_PER_M,
) -> np.ndarray:
    """[478, 3] px of a face seen from afar."""
    points = np.random.default_rng(2).normal(size=(POINTS, 3)) * 0.05
    points[SEEN] = bias.mean
    points[45, 2] += pushed
    turn = Rotation.from_rotvec([0, 0, roll]).as_matrix() @ FACING @ _towards(yaw, nod)
    return (scale * points @ turn.T + [300, 200, 0]).astype(np.float32)


@pytest.mark.parametrize(("roll", "scale"), [(0.0, 1000.0), (0.7, 2000.0), (-2.5, 500.0)])
def test_turn_and_shape_are_seen_whatever_the_roll_and_the_size(
    bias: LandmarkBias, roll: float, scale: float
) -> None:
    turns, shapes, scales, axes = bias.seen(_seen(bias, 0.3, -0.2, 0.004, roll, scale)[None])
    np.testing.assert_allclose(turns, [[0.3, -0.2]], atol=1e-5)
    assert scales[0] == pytest.approx(scale, rel=1e-5)
    expected = bias.mean - bias.mean[STEADY].mean(0)
    expected[25, 2] += 0.004
    np.testing.assert_allclose(shapes[0], expected, atol=1e-6)
    np.testing.assert_allclose(axes[0] @ axes[0].T, np.eye(2), atol=1e-6)
    np.testing.assert_allclose(axes[0, 1], [-np.sin(roll), np.cos(roll)], atol=1e-5)


@pytest.mark.parametrize("roll", [0.0, 0.9])
def test_errors_are_taken_out_along_the_face(bias: LandmarkBias, roll: float) -> None:
    usual = _seen(bias, roll=roll)
    clip = np.stack([usual, usual, usual, _seen(bias, 0.3, -0.2, 0.004, roll)])
    moved = bias.taken_out(clip, np.ones(len(clip), bool)) - clip
    np.testing.assert_allclose(moved[:3], 0, atol=1e-3)  # as in the middle of the clip
    axes = np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    np.testing.assert_allclose(moved[3, 7, :2] @ axes.T, [-6.0, -3.0], atol=1e-2)  # .3 rad of 20 and 10 px
    np.testing.assert_allclose(moved[3, 9, :2] @ axes.T, [6.0, -8.0], atol=1e-2)
    score = 0.004 / 0.002 - (0.3 * 0.5 + 0.2 * 0.3)  # less what goes with the turn
    np.testing.assert_allclose(moved[3, 11, :2] @ axes.T, [-score, -2 * score], atol=1e-2)
    assert np.abs(np.delete(moved[3], (7, 9, 11), axis=0)).max() < 1e-3 and np.abs(moved[..., 2]).max() == 0


def test_what_was_never_seen_errs_as_the_farthest_that_was(bias: LandmarkBias) -> None:
    clip = np.stack([_seen(bias)] * 3 + [_seen(bias, 1.2), _seen(bias, 0, 0.9), _seen(bias, pushed=0.03)])
    moved = bias.taken_out(clip, np.ones(len(clip), bool)) - clip
    for frame, point, farthest, rate in (
        (3, 7, FARTHEST_TURN[0], (0.02, 0.01)),
        (4, 9, FARTHEST_TURN[1], (0.03, -0.04)),
        (5, 11, FARTHEST_SCORE, (0.001, 0.002)),
    ):
        expected = PX_PER_M * farthest * np.hypot(*rate)
        assert np.linalg.norm(moved[frame, point]) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("opening_mm", "share"), [(0.0, 0.0), (1.0, 0.25), (6.0, 1.0)])
def test_skin_that_touches_is_not_brought_nearer(bias: LandmarkBias, opening_mm: float, share: float) -> None:
    """Errors of an opening count the less the narrower it is read; what its two sides err by alike counts always."""
    rate = np.zeros_like(bias.rate)
    rate[0, 13], rate[0, 14] = (0.01, 0.03), (0.01, -0.01)
    turned = _seen(bias, 0.3)
    turned[14] = turned[13] + [0, opening_mm, 0]
    clip = np.stack([_seen(bias)] * 3 + [turned])
    moved = clip - replace(bias, rate=rate).taken_out(clip, np.ones(4, bool))
    np.testing.assert_allclose(moved[3, 13, :2], [3, 3 + 6 * share], atol=0.05)
    np.testing.assert_allclose(moved[3, 14, :2], [3, 3 - 6 * share], atol=0.05)


def test_without_a_face_nothing_is_taken_out(bias: LandmarkBias) -> None:
    clip = np.stack([_seen(bias)] * 3 + [_seen(bias, 0.3)] * 2)
    gap, used = clip.copy(), np.ones(5, bool)
    gap[1] = np.nan
    out = bias.taken_out(gap, used)
    assert np.isnan(out[1]).all() and np.isfinite(out[[0, 2, 3, 4]]).all()
    nothing = np.full((2, POINTS, 3), np.nan, np.float32)
    assert np.isnan(bias.taken_out(nothing, used[:2])).all()
    np.testing.assert_array_equal(bias.taken_out(clip[:1], used[:1]), clip[:1])  # one frame is its own middle
    np.testing.assert_array_equal(bias.taken_out(clip, ~used), clip)  # no frame tells how the face usually is
    clip[1] = 5.0  # no face's points
    np.testing.assert_array_equal(bias.taken_out(clip, used)[1], clip[1])
    np.testing.assert_array_equal(bias.taken_out(clip, used)[[0, 2, 3, 4]], out[[0, 2, 3, 4]])


@pytest.mark.parametrize(("yaw", "nod"), [(0.4, 0.0), (-0.3, 0.0), (0.0, 0.25), (0.09, -0.2)])
def test_a_face_filmed_from_elsewhere_errs_by_that_throughout(
    bias: LandmarkBias, yaw: float, nod: float
) -> None:
    """Of a turn that is usual, what goes beyond that of a face filmed from the front is taken out of all frames."""
    clip = np.stack([_seen(bias, yaw, nod)] * 4 + [_seen(bias, 0.0)])
    moved = bias.taken_out(clip, np.ones(5, bool)) - clip
    for point, turn, rate in ((7, yaw, (0.02, 0.01)), (9, nod, (0.03, -0.04))):
        usual = np.clip(turn, -USUAL_TURN, USUAL_TURN)
        expected = PX_PER_M * np.array(rate)
        for frame in range(4):
            np.testing.assert_allclose(moved[frame, point, :2], -(turn - usual) * expected, atol=0.02)
        np.testing.assert_allclose(moved[4, point, :2], usual * expected, atol=0.02)


def test_a_long_clip_is_put_right_as_a_short_one(bias: LandmarkBias, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = np.stack([_seen(bias, 0.03 * k, 0.02 * k) for k in range(7)])
    clip[2] = np.nan
    whole = bias.taken_out(clip, np.ones(7, bool))
    monkeypatch.setattr(landmark_bias_module, "TOGETHER", 2)
    np.testing.assert_array_equal(bias.taken_out(clip, np.ones(7, bool)), whole)


def test_frames_of_others_do_not_tell_how_the_face_usually_is(bias: LandmarkBias) -> None:
    clip = np.stack([_seen(bias)] * 2 + [_seen(bias, 0.3)] * 3)
    used = np.array([True, True, False, False, False])
    moved = bias.taken_out(clip, used) - clip
    assert np.abs(moved[:2]).max() < 1e-3 and np.linalg.norm(moved[2, 7]) > 6


def test_a_map_is_learned_again(head: HeadModel) -> None:
    """From views made by one, but for a tenth, which the ridge takes off."""
    random = np.random.default_rng(3)
    views = _made(head, random, 40)
    learned = learn(head, views)
    np.testing.assert_allclose(learned.rate[0, 4], [0.01 / 1.1, 0], atol=3e-4)
    np.testing.assert_allclose(learned.rate[1, 4], [0, -0.02 / 1.1], atol=3e-4)
    before, after = left_over(learned, _made(head, random, 10))
    assert (after < 0.2 * before).all()
    # What goes with the turn alone is no score: those are of deviation one, and stay within the limit.
    person, points = (np.array([getattr(view, name) for view in views]) for name in ("person", "points"))
    features = about_person(learned.features(points)[0], person)
    scores = features[:, 2:]
    np.testing.assert_allclose(scores[:, 0].std(), 1, atol=0.15)
    assert (
        np.abs(np.corrcoef(features.T)[:2, 2]).max() < 0.2 and (np.abs(scores) > FARTHEST_SCORE).mean() < 0.02
    )


def _made(head: HeadModel, random: np.random.Generator, people: int) -> list[View]:
    """Views of heads whose chin is read elsewhere when they turn, and moves; the nose tip errs with their turns."""
    embedding = head.landmark_embedding
    where = np.zeros((POINTS, 3))
    where[embedding.landmarks] = head.landmark_positions(
        np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_basis))
    )
    chin = 0.01 * (where[:, 1:2] < where[:, 1].mean() - 0.04)
    views = []
    for person in range(1, people + 1):
        shape = where + 0.002 * random.normal(size=where.shape)
        for _ in range(6):
            yaw, nod = random.uniform(-0.4, 0.4, 2)
            turn = FACING @ _towards(yaw, nod)
            off = np.full((POINTS, 2), np.nan)
            off[embedding.landmarks] = 0.0
            off[4] = 0.01 * yaw, -0.02 * nod
            moving = shape + 0.0001 * random.normal(size=where.shape)
            moving += chin * (random.normal() * np.array([0, 0.2, 0]) + yaw * np.array([2, 0, 0]))
            views.append(View(person, (PX_PER_M * moving @ turn.T).astype(np.float32), off))
    return views


def test_both_sides_err_alike() -> None:
    """Of the asset: from a mirrored clip the mirror image is taken out."""
    random = np.random.default_rng(5)
    learned = landmark_bias()
    points = np.zeros((5, POINTS, 3))
    points[:, learned.landmarks] = learned.mean + 0.001 * random.normal(size=(5, *learned.mean.shape))
    turns = Rotation.from_euler("yx", random.uniform(-0.3, 0.3, (5, 2))).as_matrix()
    points = (2000 * np.einsum("ij,njk,npk->npi", FACING, turns, points)).astype(np.float32)
    used = np.ones(len(points), bool)
    moved = learned.taken_out(points, used) - points
    flipped = points[:, MIRRORED] * np.float32([-1, 1, 1])
    back = (learned.taken_out(flipped, used) - flipped)[:, MIRRORED] * [-1, 1, 1]
    np.testing.assert_allclose(back, moved, atol=0.02)
    assert np.abs(moved).max() > 1.0


@pytest.mark.parametrize(("axis", "share"), [("x", 0.65), ("y", 0.8)])
def test_points_read_on_a_head_that_turns_stay_on_its_skin(head: HeadModel, axis: str, share: float) -> None:
    """A head pictured otherwise than those it was learned from: what points wander by becomes less."""
    random = np.random.default_rng(99)
    who, rest = random.standard_normal(len(head.identity_basis)), np.zeros(len(head.expression_basis))
    pictures, places = [], []
    for angle in (-12, -4, 4, 12):
        turn = FACING @ Rotation.from_euler(axis, angle, degrees=True).as_matrix()
        shift = np.array([0, 0.02, 0.6])
        vertices = (head.vertices(who, rest) @ turn.T + shift).astype(np.float32)
        places.append(project(head.landmark_positions(who, rest) @ turn.T + shift, FOCAL, CENTRE))
        pictures.append(render(vertices, head.faces, head.albedo, FOCAL, CENTRE, (SIZE, SIZE)))
    kept = head.landmark_embedding.landmarks

    def wander(points: np.ndarray) -> float:
        off = points[:, kept, :2] - np.array(places)
        return float(np.sqrt(((off - off.mean(0)) ** 2).mean()))

    frames = ((k / 25, picture) for k, picture in enumerate(pictures))
    read = track_landmarks(frames, len(pictures)).points
    assert wander(landmark_bias().taken_out(read, np.ones(len(read), bool))) < share * wander(read)
