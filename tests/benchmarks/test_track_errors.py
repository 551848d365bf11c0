"""Errors of a track, on cases worked by hand."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.ground_truth import GroundTruth
from benchmarks.track_errors import (
    aside_deg,
    closures_invented,
    closures_reached,
    compare,
    disturbed,
    middle_of_lips,
    opening_errors,
    recovery_frames,
    separation,
    surface_error,
)
from tracker.head import HeadModel, load_head
from tracker.track import Track

FRAMES = 12


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def exact(head: HeadModel) -> tuple[Track, GroundTruth]:
    """A track and the truth that it reproduces exactly, but for a size of 1.1."""
    random = np.random.default_rng(0)
    identity = 0.5 * random.standard_normal(len(head.identity_basis)).astype(np.float32)
    expression = 0.2 * random.random((FRAMES, len(head.expression_names))).astype(np.float32)
    rotation = Rotation.from_euler("xyz", [180, 0, 0], degrees=True) * Rotation.from_euler(
        "y", 5 * random.standard_normal((FRAMES, 1)), degrees=True
    )
    translation = np.array([0, 0, 0.5]) + 0.01 * random.standard_normal((FRAMES, 3))
    face = np.sort(head.regions["face"])
    gap = head.lip_gap_mm(head.vertices(identity, expression))
    truth = GroundTruth(
        neutral=1.1 * head.vertices(identity, np.zeros(len(head.expression_names)))[face].astype(np.float64),
        faces=np.searchsorted(face, head.faces[np.isin(head.faces, face).all(1)]).astype(np.int32),
        displacement=1.1
        * np.tensordot(expression.astype(np.float64), head.expression_basis[:, face], axes=1),
        rotation=rotation.as_matrix(),
        translation=1.1 * translation,
        focal=900.0,
        lip_gap_mm=1.1 * gap.astype(np.float64),
        covered=np.zeros(FRAMES),
        vertices=face.astype(np.int32),
        eyes=Rotation.from_euler("yx", random.uniform(-15, 15, (2 * FRAMES, 2)), degrees=True)
        .as_rotvec()
        .reshape(FRAMES, 2, 3),
    )
    track = Track(
        time=np.arange(FRAMES) / 25,
        valid=np.ones(FRAMES, bool),
        confidence=np.ones(FRAMES, np.float32),
        identity=identity,
        expression=expression,
        jaw=np.zeros((FRAMES, 3), np.float32),
        neck=np.zeros((FRAMES, 3), np.float32),
        eyes=truth.eyes.astype(np.float32),
        rotation=rotation.as_rotvec().astype(np.float32),
        translation=translation.astype(np.float32),
        focal=900.0,
        principal=np.zeros(2, np.float32),
        distortion=np.zeros(0, np.float32),
        size=(640, 640),
        head=head.name,
        lip_gap_mm=gap.astype(np.float32),
        reprojection_px=np.zeros(FRAMES, np.float32),
    )
    return track, truth


def free_between_lips(head: HeadModel, vertices: np.ndarray) -> np.ndarray:
    """[..] mm of vertices [.., D, 3] m."""
    upper, lower = (vertices[..., part, 1] for part in middle_of_lips(head))
    return 1e3 * (upper.min(-1) - lower.max(-1)).astype(np.float64)


@pytest.mark.parametrize(("jaw", "less"), [(0.0, 0.0), (0.2, 0.3), (0.5, 0.7)])
def test_what_is_free_between_the_lips_is_what_a_cut_through_the_middle_leaves(
    head: HeadModel, jaw: float, less: float
) -> None:
    """Less than between two vertices of an open mouth: the lower lip's inside turns up."""
    opens = head.expression_names.index("jawOpen")
    weights = jaw * np.eye(len(head.expression_names))[opens]
    vertices = head.vertices(np.zeros(len(head.identity_basis)), weights)
    lips = head.faces[np.isin(head.faces, head.regions["lips"]).all(1)]
    mesh = trimesh.Trimesh(vertices, lips, process=False)
    cut, faces = trimesh.intersections.mesh_plane(mesh, [1, 0, 0], [1e-5, 0, 0], return_faces=True)
    with_jaw = head.expression_basis[opens, lips[faces], 1].max(1) < -0.012
    upper, lower = 1e3 * cut[~with_jaw][..., 1], 1e3 * cut[with_jaw][..., 1]
    free = free_between_lips(head, vertices)
    assert free == pytest.approx(upper.min() - lower.max(), abs=0.05)
    assert head.lip_gap_mm(vertices) - free == pytest.approx(less, abs=0.1)


@pytest.mark.parametrize("same_mesh", [True, False])
def test_an_exact_track_has_no_error(
    exact: tuple[Track, GroundTruth], head: HeadModel, same_mesh: bool
) -> None:
    track, truth = exact
    if not same_mesh:
        free = free_between_lips(head, 1.1 * head.vertices(track.identity, track.expression))
        truth = replace(truth, vertices=None, lip_gap_mm=free)
    errors = compare(track, head, truth)
    for name in ("surface_mm", "lip_motion_mm", "lip_neutral_mm", "opening_rmse_mm", "jitter_mm"):
        assert errors[name] == pytest.approx(0, abs=0.03), name
    assert errors["opening_r"] == pytest.approx(1) and errors["focal_pct"] == 0
    assert errors["rotation_deg"] == pytest.approx(0, abs=0.01)
    assert errors["mean_surface_mm"] > 0.3
    if same_mesh:
        assert errors["lids_mm"] == pytest.approx(0, abs=0.01) and errors["gaze_deg"] < 0.01
        assert errors["face_scaled_mm"] == pytest.approx(0, abs=0.01)
        # A tenth of the distance of the face's points from their middle, some 60 mm.
        assert 3 < errors["face_rigid_mm"] < 8


def test_a_face_whose_vertices_slid_over_its_surface_lies_on_it(
    exact: tuple[Track, GroundTruth], head: HeadModel
) -> None:
    _, truth = exact
    middles, first = truth.neutral[truth.faces].mean(1), truth.faces[:, 0]
    slid = truth.neutral.copy()
    slid[first] = middles
    assert 1e3 * np.linalg.norm(slid - truth.neutral, axis=1).mean() > 1
    neutral = head.template.astype(np.float64)
    neutral[truth.vertices] = slid
    # The similarity follows the vertices a little.
    assert surface_error(neutral, head, truth)[0] < 0.2


def test_the_farthest_part_of_a_face_counts(exact: tuple[Track, GroundTruth], head: HeadModel) -> None:
    _, truth = exact
    neutral = head.template.astype(np.float64)
    neutral[truth.vertices] = truth.neutral
    nose = truth.neutral[:, 2] > np.quantile(truth.neutral[:, 2], 0.97)
    neutral[truth.vertices[nose], 2] += 0.01
    assert surface_error(neutral, head, truth)[0] > 0.2


def test_a_lip_offset_counts_against_the_neutral_only(
    exact: tuple[Track, GroundTruth], head: HeadModel
) -> None:
    track, truth = exact
    lower = truth.displacement.copy()
    assert truth.vertices is not None
    lower[:, np.isin(truth.vertices, head.regions["lips"])] += [0, 0, 0.002]
    errors = compare(track, head, replace(truth, displacement=lower))
    assert errors["lip_motion_mm"] == pytest.approx(0, abs=0.01)
    assert errors["lip_neutral_mm"] == pytest.approx(2, abs=0.02)


def test_lids_that_move_and_eyes_that_stray_are_told_without_the_constant(
    exact: tuple[Track, GroundTruth], head: HeadModel
) -> None:
    track, truth = exact
    assert truth.vertices is not None and truth.eyes is not None
    there = np.arange(FRAMES) % 2 == 1
    lids = np.isin(
        truth.vertices, np.concatenate([head.regions[f"{x}_eyelid_upper"] for x in ("left", "right")])
    )
    raised = truth.displacement.copy()
    raised[there[:, None] & lids] += [0, 0.002, 0]
    errors = compare(track, head, replace(truth, displacement=raised))
    assert errors["lids_mm"] == pytest.approx(1, abs=0.01) and errors["gaze_deg"] < 0.01
    upwards = Rotation.from_euler("x", -4 * np.repeat(there, 2)[:, None] - 7, degrees=True)
    strayed = (upwards * Rotation.from_rotvec(truth.eyes.reshape(-1, 3))).as_rotvec().reshape(FRAMES, 2, 3)
    assert compare(track, head, replace(truth, eyes=strayed))["gaze_deg"] == pytest.approx(2, abs=0.1)


def test_where_eyes_look_behind_shut_lids_does_not_count(
    exact: tuple[Track, GroundTruth], head: HeadModel
) -> None:
    track, truth = exact
    assert truth.vertices is not None and truth.eyes is not None
    lids = np.isin(
        truth.vertices, np.concatenate([head.regions[f"{x}_eyelid_upper"] for x in ("left", "right")])
    )
    shut, strayed = truth.displacement.copy(), truth.eyes.copy()
    shut[3, lids] -= [0, 0.009, 0]
    strayed[3] += 0.5
    assert compare(track, head, replace(truth, displacement=shut, eyes=strayed))["gaze_deg"] < 0.01


def test_motion_errors_are_split_into_plane_and_depth(
    exact: tuple[Track, GroundTruth], head: HeadModel
) -> None:
    track, truth = exact
    shaken = (
        truth.displacement
        + np.array([0.0003, 0, 0.0004]) * np.where(np.arange(FRAMES) % 2, 1, -1)[:, None, None]
    )
    errors = compare(track, head, replace(truth, displacement=shaken))
    assert errors["lip_motion_mm"] == pytest.approx(0.5, abs=0.01)
    assert errors["lip_in_plane_mm"] == pytest.approx(0.3, abs=0.01)
    assert errors["lip_depth_mm"] == pytest.approx(0.4, abs=0.01)
    assert errors["jitter_mm"] == pytest.approx(2.0, abs=0.02)  # 4 x the amplitude


def test_still_clip_measures_jitter(exact: tuple[Track, GroundTruth], head: HeadModel) -> None:
    track, truth = exact
    still = replace(
        truth,
        displacement=np.broadcast_to(truth.displacement[:1], truth.displacement.shape),
        rotation=np.broadcast_to(truth.rotation[:1], truth.rotation.shape),
        translation=np.broadcast_to(truth.translation[:1], truth.translation.shape),
    )
    assert np.isnan(compare(track, head, truth)["still_mm"])
    same = replace(track, expression=np.broadcast_to(track.expression[:1], track.expression.shape))
    errors = compare(same, head, still)
    assert errors["still_mm"] == pytest.approx(0, abs=1e-3)
    assert errors["still_posed_mm"] > 3  # the pose of the track still moves


def test_opening_errors() -> None:
    true = np.array([0.0, 2, 4, 6])
    errors = opening_errors(true + np.array([1, 1, 1, 2]), true, np.array([True, True, True, False]))
    assert errors["opening_r"] == pytest.approx(1)
    assert errors["opening_rmse_mm"] == pytest.approx(1) and errors["opening_centred_mm"] == pytest.approx(0)
    assert errors["closed_mm"] == 1


def test_closures_within_one_frame() -> None:
    true = np.array([3, 0, 3, 3, 0, 0, 3, 3, 0, 3.0])
    late = np.array([3, 3, 0, 3, 3, 3, 0, 3, 3, 3.0])  # one frame, two frames, never
    assert closures_reached(true, true) == 1
    assert closures_reached(late, true) == pytest.approx(1 / 3)
    assert closures_reached(true + 5, true) == 0
    assert np.isnan(closures_reached(true, true + 5))


def test_a_fitted_closing_serves_one_closure() -> None:
    true = np.array([3, 0, 3, 0, 3, 3, 0, 3.0])
    between = np.array([3, 3, 0, 3, 3, 3, 3, 3.0])  # a frame from the first two
    assert closures_reached(between, true) == pytest.approx(1 / 3)
    # The first closing lies beside two closures, one of which is the second's only one.
    assert closures_reached(np.array([0, 3, 0, 3, 0, 3, 3, 3.0]), true) == pytest.approx(2 / 3)


def test_closing_on_open_lips_is_false() -> None:
    true = np.array([3, 0, 3, 3, 3, 3, 0.7, 3, 3, 3])
    fitted = np.array([3, 3, 0, 3, 0, 3, 0.4, 3, 3, 3])  # a frame late, on open lips, on lips all but shut
    assert closures_invented(fitted, true) == pytest.approx(1 / 3)
    assert closures_invented(true, true) == 0
    assert np.isnan(closures_invented(true + 5, true))


def test_flicker_about_the_limit_reaches_all_closures_and_invents_more() -> None:
    true = np.tile([4, 3, 2, 0, 0, 2, 3, 4.0], 5)
    flicker = np.where(np.arange(len(true)) % 2, 0.4, 0.6)
    errors = opening_errors(flicker, true, np.ones(len(true), bool))
    assert errors["closures"] == 1 and errors["false_closures"] == pytest.approx(0.5)
    assert closures_invented(flicker, np.full(len(true), 0.6)) == 0  # where lips hover there, it is no flaw


def test_unseen_closings_are_not_false() -> None:
    true, fitted = np.full(8, 3.0), np.array([3, 3, 0, 3, 3, 0, 3, 3.0])
    errors = opening_errors(fitted, true, np.arange(8) != 5)
    assert errors["false_closures"] == 1
    assert np.isnan(opening_errors(fitted, true, ~np.isin(np.arange(8), (2, 5)))["false_closures"])


def test_separation_is_the_area_under_the_curve() -> None:
    covered = np.array([True, True, False, False])
    assert separation(np.array([0.1, 0.2, 0.8, 0.9]), covered) == 1
    assert separation(np.array([0.1, 0.85, 0.8, 0.9]), covered) == 0.75
    assert separation(np.full(4, 0.5), covered) == 0.5
    assert np.isnan(separation(np.ones(4), np.zeros(4, bool)))


def test_recovery_counts_from_the_end_of_a_disturbance() -> None:
    disturbed = np.zeros(12, bool)
    disturbed[3:5] = disturbed[8:9] = True
    error = np.array([1, 1, 1, 9, 9, 5, 4, 1, 9, 1, 1, 1.0])
    assert recovery_frames(error, disturbed) == 2
    assert np.isnan(recovery_frames(error, np.zeros(12, bool)))


def test_covered_frames_do_not_count(exact: tuple[Track, GroundTruth], head: HeadModel) -> None:
    track, truth = exact
    covered = (np.arange(FRAMES) == 4).astype(float)
    gap, moved = truth.lip_gap_mm.copy(), truth.displacement.copy()
    gap[4] += 9
    moved[4] += 0.01
    errors = compare(track, head, replace(truth, covered=covered, lip_gap_mm=gap, displacement=moved))
    for name in ("opening_rmse_mm", "lip_motion_mm", "jitter_mm", "face_scaled_mm"):
        assert errors[name] == pytest.approx(0, abs=0.01), name


def test_bare_frames_without_a_fit_are_lost(exact: tuple[Track, GroundTruth], head: HeadModel) -> None:
    track, truth = exact
    assert compare(track, head, truth)["lost_pct"] == 0
    valid, covered = np.ones(FRAMES, bool), np.zeros(FRAMES)
    valid[[4, 5, 9]] = False
    covered[[5, 6]] = 1.0, 0.1  # a hand over the lips; one that leaves them as good as bare
    errors = compare(replace(track, valid=valid), head, replace(truth, covered=covered))
    assert errors["lost_pct"] == pytest.approx(100 * 2 / 11)


def test_a_head_turned_aside_hides_its_lips_until_it_is_back(
    exact: tuple[Track, GroundTruth], head: HeadModel
) -> None:
    track, truth = exact
    angle = np.array([26, 29, 33, 37, 41, 44, 47, 46, 43, 39, 35, 31.0])
    turns = (Rotation.from_euler("y", angle[:, None], degrees=True)).as_matrix() @ np.diag([1.0, -1, -1])
    ahead = np.broadcast_to(np.array([0, 0, 0.6]), truth.translation.shape)
    turned = replace(truth, rotation=turns, translation=ahead)
    np.testing.assert_allclose(aside_deg(turned), angle, atol=1e-3)
    np.testing.assert_array_equal(np.flatnonzero(disturbed(turned)), np.arange(2, 12))
    # A camera that stands aside all the time disturbs nothing.
    steady = Rotation.from_euler("y", np.linspace(28, 40, FRAMES)[:, None], degrees=True).as_matrix()
    assert not disturbed(replace(turned, rotation=steady @ np.diag([1.0, -1, -1]))).any()
    valid, confidence = angle < 45, np.where(angle < 44, 1.0, 0.2).astype(np.float32)
    errors = compare(replace(track, valid=valid, confidence=confidence), head, turned)
    assert errors["lost_pct"] == 0 and errors["kept_pct"] == 0
    assert errors["left_out_pct"] == pytest.approx(100 / 10)


def test_fitted_frames_are_left_out_or_used_by_their_confidence(
    exact: tuple[Track, GroundTruth], head: HeadModel
) -> None:
    track, truth = exact
    assert np.isnan(compare(track, head, truth)["kept_pct"])
    covered = np.zeros(FRAMES)
    covered[[5, 6, 7]] = 1.0
    confidence = np.ones(FRAMES, np.float32)
    confidence[[2, 5, 6]] = 0.4, 0.1, 0.49
    errors = compare(replace(track, confidence=confidence), head, replace(truth, covered=covered))
    assert errors["left_out_pct"] == pytest.approx(100 / (FRAMES - 3))
    assert errors["kept_pct"] == pytest.approx(100 / 3)


def test_a_turn_there_and_back_is_one_disturbance(exact: tuple[Track, GroundTruth]) -> None:
    _, truth = exact
    angle = np.array([0, 0, 0, 8, 20, 30, 31, 30, 20, 8, 0, 0])[:, None]
    turns = Rotation.from_euler("y", angle, degrees=True).as_matrix() @ np.diag([1.0, -1, -1])
    found = disturbed(replace(truth, rotation=turns))
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(3, 11))
