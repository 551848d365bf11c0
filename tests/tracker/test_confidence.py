"""Each cue lowers confidence, and the one that lowers it most is the doubt."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.personalize.test_registration import track_of
from tracker.confidence import FROM_ABOVE, bare, confidence, from_above_deg, judge, off_axis_deg
from tracker.head import load_head
from tracker.occlusion import Appearance

NOTHING = np.zeros(4, np.float32)
CLEAR = Appearance(
    strangeness=NOTHING, sharpness=np.ones(4, np.float32), outside=NOTHING, unlike_lips=NOTHING
)
FACING = np.array([np.pi, 0, 0], np.float32)  # the head's y up and z out of the face, in the camera's axes


@pytest.fixture
def track():
    head = load_head()
    track = track_of(head, np.zeros((4, len(head.expression_basis))), np.arange(4) / 25)
    ahead = np.tile(np.float32([0, 0, 0.6]), (4, 1))
    return replace(track, rotation=np.tile(FACING, (4, 1)), translation=ahead)


def test_nothing_against_a_frame_leaves_its_confidence(track):
    little = np.full(4, 0.05, np.float32)
    judged, _ = judge(track, Appearance(little, CLEAR.sharpness, little, little))
    np.testing.assert_allclose(judged.confidence, track.confidence)


def test_the_doubt_is_what_costs_most(track):
    turned = track.rotation.copy()
    turned[2] = turn(60)
    poor = np.float32([1, 1, 1, 0.2])
    appearance = replace(
        CLEAR, strangeness=np.float32([0.6, 0, 0, 0.12]), sharpness=np.float32([1, 0.3, 1, 1])
    )
    judged, doubts = judge(replace(track, rotation=turned, confidence=poor), appearance)
    assert doubts == ["occluded", "blurred", "turned_away", "poor_fit"]
    assert (judged.confidence < 0.5).all() and (judged.confidence <= poor).all()


def test_a_face_turned_away_is_told_whatever_else_comes_of_it(track):
    """In profile a face lies badly and looks strange for that; turned by a little it does not."""
    turned = track.rotation.copy()
    turned[:3] = turn(42), turn(60), turn(36)
    strange = replace(CLEAR, strangeness=np.float32([0, 0.6, 0, 0.6]))
    poor = np.float32([0.01, 0.01, 0.01, 0.1])
    _, doubts = judge(replace(track, rotation=turned, confidence=poor), strange)
    assert doubts == ["turned_away", "turned_away", "poor_fit", "occluded"]


def test_a_mouth_that_looks_other_than_usual_is_a_poor_fit(track):
    deviation = np.float32([[1, 1], [1, 5], [2.9, 2.9], [np.nan, np.nan]])
    judged, doubts = judge(track, CLEAR, deviation)
    expected = track.confidence * np.float32([1, np.exp(-2), 1, 1])
    np.testing.assert_allclose(judged.confidence, expected, rtol=1e-6)
    assert doubts[1] == "poor_fit"


def test_a_mouth_beyond_the_pictures_edge_is_cut_off_and_no_evidence(track):
    cut = replace(
        CLEAR, strangeness=np.float32([0, 0, 0, 0.15]), outside=np.float32([0.05, 0.125, 0.5, 0.125])
    )
    judged, doubts = judge(track, cut)
    np.testing.assert_allclose(judged.confidence / track.confidence, [1, 0.5, 2**-6, 0.25], rtol=1e-5)
    assert doubts[1:3] == ["cut_off", "cut_off"]
    np.testing.assert_allclose(bare(cut), [1, 0.5, 2**-6, 0.25], rtol=1e-5)


def test_lips_without_the_colour_of_lips_are_covered_and_no_evidence(track):
    covered = replace(CLEAR, unlike_lips=np.float32([0.2, 0.3, 1, 0]))
    judged, doubts = judge(track, covered)
    np.testing.assert_allclose(judged.confidence / track.confidence, [1, 0.5, 2**-8, 1], rtol=1e-4)
    assert doubts[1:3] == ["occluded", "occluded"]
    np.testing.assert_allclose(bare(covered), [1, 0.5, 2**-8, 1], rtol=1e-4)


def turn(yaw_deg):
    turned = Rotation.from_euler("y", yaw_deg, degrees=True) * Rotation.from_rotvec(FACING)
    return turned.as_rotvec().astype(np.float32)


@pytest.mark.parametrize("yaw", [0, 20, -45, 90])
def test_the_angle_to_the_line_of_sight(track, yaw):
    assert off_axis_deg(replace(track, rotation=np.tile(turn(yaw), (4, 1)))) == pytest.approx(
        abs(yaw), abs=0.05
    )


@pytest.mark.parametrize("nod", [0, 20, -35, 44])
@pytest.mark.parametrize("yaw", [0, -30])
def test_what_is_seen_from_above_counts_more_than_from_below_or_aside(track, yaw, nod):
    """A head that is turned, then bowed by `nod` degrees before a camera straight ahead of it."""
    turned = Rotation.from_euler("x", nod, degrees=True) * Rotation.from_rotvec(turn(yaw))
    bowed = replace(track, rotation=np.tile(turned.as_rotvec().astype(np.float32), (4, 1)))
    towards = turned.inv().apply([0, 0, -1])
    above = np.degrees(np.arcsin(towards[1]))
    np.testing.assert_allclose(from_above_deg(bowed), above, atol=1e-3)
    assert np.sign(round(above)) == np.sign(nod) and (yaw or above == pytest.approx(nod, abs=1e-3))
    angle = np.degrees(np.arccos(towards[2]))
    up = angle * max(towards[1], 0) / max(np.hypot(*towards[:2]), 1e-9)
    aside = np.sqrt(angle**2 - up**2)
    assert off_axis_deg(bowed) == pytest.approx(np.hypot(aside, FROM_ABOVE * up), abs=0.05)


def test_a_face_at_the_side_of_the_picture_that_looks_at_the_camera_is_not_turned_away(track):
    aside = np.tile(np.float32([0.6, 0, 0.6]), (4, 1))
    looking = np.tile(turn(45), (4, 1))
    assert off_axis_deg(replace(track, translation=aside, rotation=looking)) == pytest.approx(0, abs=0.05)


def test_a_head_that_its_neck_turns_is_turned_away(track):
    turned = replace(track, neck=np.tile(np.radians([0.0, 60.0, 0.0]).astype(np.float32), (4, 1)))
    assert off_axis_deg(turned) == pytest.approx(off_axis_deg(track) + 60, abs=3)


def test_landmarks_cost_what_is_unusual_what_jumps_and_what_is_hidden():
    error, visible, presence = np.ones((10, 4)), np.ones((10, 4)), np.ones(10)
    error[0], error[3], error[6:8] = 2, 4, 3  # the first frame has one neighbour, the third stands alone
    error[:, 3], visible[:, 3] = 100, 0  # what is hidden errs as it likes
    visible[9], presence[8] = [1, 0.2, 0, 0], 0.9
    found = confidence(error, visible, presence, np.arange(10) + 1, 12)
    expected = np.exp(-np.array([0.5, 0, 0, 2.5 + 3, 0, 0, 1.5, 1.5, 0, 0])) * presence
    expected[9] *= 0.5
    np.testing.assert_allclose(found, [0, *expected, 0], rtol=1e-6)
