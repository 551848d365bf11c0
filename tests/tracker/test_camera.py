"""Focal length, poses and rigid points from tracks on a head that the mean head is not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import tracker.camera as subject
from tests.tracker.one_shot import estimate_camera
from tracker import feature_tracks
from tracker.bundle_adjustment import RigidScene
from tracker.camera import PRIOR_FOCAL, PRIOR_SD_LOG
from tracker.feature_tracks import (
    FeatureFollower,
    FeatureTracks,
    upper_face_mask,
)
from tracker.head import HeadModel, load_head
from tracker.landmark_indices import LEFT_EYE, POINTS, RIGHT_EYE, UPPER_FACE
from tracker.patch_registration import fine_texture
from tracker.raster import project
from tracker.rigid_surface import SurfacePoints
from tracker.track import F64, Landmarks, TrackError

SIZE, FOCAL = (640, 480), 1100.0
CENTRE = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
FACING = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def _clip(points: np.ndarray) -> Landmarks:
    total = len(points)
    return Landmarks(
        time=np.arange(total) / 25,
        points=points.astype(np.float32),
        presence=np.ones(total, np.float32),
        blendshapes=np.zeros((total, 52), np.float32),
        blendshape_names=(),
        size=SIZE,
    )


def _talk(
    head: HeadModel, turn_deg: float, total: int = 40, noise: float = 0.15, before_m: float = 0.0
) -> tuple[Landmarks, FeatureTracks, F64]:
    """Landmarks and feature tracks of a turning head of another identity, and its rotations [M, 3, 3].

    before_m: how far a quarter of the tracked points lie before the skin.
    """
    rng = np.random.default_rng(1)
    who = rng.standard_normal(len(head.identity_basis)) * 0.7
    what = np.zeros(len(head.expression_basis))
    angle = np.radians(turn_deg) * np.sin(np.arange(total) / total * 2 * np.pi)
    turns = (
        Rotation.from_euler("yx", np.stack([angle, 0.4 * np.roll(angle, total // 4)], 1)).as_matrix() @ FACING
    )
    shift = np.array([0.01, 0.02, 0.6]) + np.cumsum(rng.normal(0, 0.0005, (total, 3)), 0)

    def seen(points: np.ndarray) -> np.ndarray:
        flat = project(np.einsum("mij,nj->mni", turns, points) + shift[:, None], FOCAL, CENTRE)
        return flat + rng.normal(0, noise, flat.shape)

    landmarks = np.zeros((total, POINTS, 3))
    landmarks[:, head.landmark_embedding.landmarks, :2] = seen(head.landmark_positions(who, what))
    skin = head.vertices(who, what)[head.regions["face"]]
    skin = skin[skin[:, 1] > skin[:, 1].mean()][::5]
    skin[::4, 2] += before_m
    places = seen(skin)
    shown = []
    for m in range(total):
        hull = cv2.convexHull(landmarks[m, UPPER_FACE, :2].astype(np.float32))
        inside = [cv2.pointPolygonTest(hull, tuple(map(float, xy)), False) > 0 for xy in places[m]]
        kept = np.flatnonzero(inside)
        shown.append(np.column_stack([np.full(len(kept), m), kept, places[m, kept]]))
    rows = np.concatenate(shown)
    rows[:, 1] = np.unique(rows[:, 1], return_inverse=True)[1]
    frames = np.arange(total, dtype=np.int32)
    tracks = FeatureTracks(frames, rows.astype(np.float32))
    return _clip(landmarks), tracks, turns


def test_a_turning_head_tells_focal_length_and_pose(head: HeadModel) -> None:
    marks, tracks, turns = _talk(head, 18)
    camera, bundle = estimate_camera(marks, tracks, head)
    assert camera.method == "bundle" and camera.focal_sd_log < 0.2
    assert abs(np.log(camera.focal_px / FOCAL)) < min(0.12, 2.5 * camera.focal_sd_log)
    between = Rotation.from_matrix(turns[bundle.frame]).inv() * Rotation.from_rotvec(bundle.rotation)
    assert np.degrees((between.mean().inv() * between).magnitude().mean()) < 0.5
    row = np.searchsorted(bundle.frame, bundle.observations[:, 0].astype(int))
    point = bundle.points[bundle.observations[:, 1].astype(int)]
    camera_frame = Rotation.from_rotvec(bundle.rotation[row]).apply(point) + bundle.translation[row]
    error = project(camera_frame, camera.focal_px, camera.principal_px) - bundle.observations[:, 2:]
    assert np.median(np.abs(error)) < 0.3


def test_what_is_seen_of_a_head_turned_far_aside_does_not_count(head: HeadModel) -> None:
    """Whatever the patches are taken for there."""
    marks, tracks, _ = _talk(head, 48)
    camera, bundle = estimate_camera(marks, tracks, head)
    observations, aside = tracks.observations.copy(), np.abs(np.sin(np.arange(40) / 40 * 2 * np.pi)) > 0.9
    wrong = aside[observations[:, 0].astype(int)]
    observations[wrong, 2:] += np.random.default_rng(2).normal(0, 5, (wrong.sum(), 2))
    again, rest = estimate_camera(marks, replace(tracks, observations=observations), head)
    assert not np.isin(np.flatnonzero(aside), rest.frame).any() and len(rest.frame) > 15
    assert (again.focal_px, again.focal_sd_log) == (camera.focal_px, camera.focal_sd_log)
    np.testing.assert_array_equal(rest.rotation, bundle.rotation)


def test_a_still_head_leaves_the_prior(head: HeadModel) -> None:
    marks, tracks, _ = _talk(head, 0.5)
    camera, bundle = estimate_camera(marks, tracks, head)
    assert (camera.method, camera.focal_px, camera.focal_sd_log) == ("prior", PRIOR_FOCAL * 640, PRIOR_SD_LOG)
    assert "832 px" in camera.prior
    assert len(bundle.frame) == len(marks.time) and np.isfinite(bundle.points).all()
    assert (bundle.translation[:, 2] > 0.2).all() and (bundle.translation[:, 2] < 1).all()


def test_what_the_camera_wrote_of_its_lens_is_the_prior(head: HeadModel) -> None:
    marks, tracks, _ = _talk(head, 0.5)
    camera, _ = estimate_camera(marks, tracks, head, recorded_mm=27.0)
    assert (camera.method, camera.focal_sd_log) == ("prior", 0.12)
    assert camera.focal_px == pytest.approx(1.1 * 27 / 36 * 640) and "27 mm" in camera.prior
    # A head that turns has its say beside it; what is given overrides both.
    marks, tracks, _ = _talk(head, 18)
    wrote = FOCAL / 640 * 36 / 1.1
    camera, _ = estimate_camera(marks, tracks, head, recorded_mm=1.1 * wrote)
    assert camera.method == "bundle" and camera.focal_sd_log <= 0.12
    assert abs(np.log(camera.focal_px / FOCAL)) < 0.085 < np.log(1.1)
    camera, _ = estimate_camera(marks, tracks, head, focal_given=1000.0, recorded_mm=wrote)
    assert (camera.method, camera.focal_px) == ("given", 1000.0)


@pytest.mark.parametrize(
    ("focal", "sd_log", "turn_deg", "expected_sd"),
    [
        (1.0, 0.1, 5.0, np.hypot(0.1, 0.08)),  # what light and moving skin do is never told by tracks
        (1.0, 0.0, 5.0, 0.08),
        (0.61, 0.1, 5.0, np.hypot(0.1, 0.08)),
        (4.9, 0.1, 5.0, np.hypot(0.1, 0.08)),
        (0.44, 0.1, 5.0, None),  # no camera
        (5.1, 0.1, 5.0, None),
        (1.0, 0.26, 5.0, np.hypot(0.26, 0.08)),
        (1.0, 0.28, 5.0, None),  # more than .28, beside what is never told
        (1.0, 0.1, 3.5, None),  # to either side: less than 8 degrees
    ],
)
def test_what_a_clip_must_tell_to_be_believed(
    focal: float, sd_log: float, turn_deg: float, expected_sd: float | None
) -> None:
    prior = subject._camera(SIZE, None, (), 0.0)
    angle = np.radians(turn_deg) * np.sin(np.linspace(0, 4 * np.pi, 200))
    rotation = Rotation.from_rotvec(np.outer(angle, [0, 1, 0])).as_matrix() @ FACING
    scene = RigidScene(
        np.arange(200), rotation, np.tile([0, 0, 0.6], (200, 1)), np.zeros((0, 3)), np.zeros((0, 4))
    )
    told = subject._told(prior, scene, 640 * focal, sd_log)
    if expected_sd is None:
        assert told == prior
    else:
        assert (told.method, told.focal_px) == ("bundle", 640 * focal)
        assert told.focal_sd_log == pytest.approx(expected_sd)
    given = subject._camera(SIZE, 900.0, (), 0.0)
    assert subject._told(given, scene, 640 * focal, sd_log) == given


def test_the_bundle_lies_on_the_mean_head_as_it_is_seen() -> None:
    """Turned, moved and scaled as a whole, its places in the pictures stay; points that are far off say nothing."""
    random = np.random.default_rng(4)
    points, turn = random.normal(0, 0.03, (60, 3)), Rotation.from_rotvec([0.1, -0.2, 0.05])
    loose = 1.2 * turn.apply(points) + [0.01, 0.02, -0.03]
    loose[:6] += random.normal(0, 0.2, (6, 3))  # of short tracks
    rotation = Rotation.from_rotvec(random.normal(0, 0.2, (9, 3))).as_matrix() @ FACING
    shift = np.array([0, 0, 0.7]) + random.normal(0, 0.02, (9, 3))
    scene = RigidScene(np.arange(9), rotation, shift, loose, np.zeros((0, 4)))
    surface = SurfacePoints(points, np.zeros((60, 3, 0)), np.tile(np.eye(3), (60, 1, 1)), np.zeros(60))
    settled = subject._settled(scene, surface)
    np.testing.assert_allclose(settled.points[6:], points[6:], atol=1e-9)

    def seen(scene: RigidScene) -> np.ndarray:
        camera = np.einsum("mij,qj->mqi", scene.rotation, scene.points) + scene.translation[:, None]
        return project(camera, FOCAL, CENTRE)

    np.testing.assert_allclose(seen(settled), seen(scene), atol=1e-6)


def test_a_given_lens_is_taken_out(head: HeadModel) -> None:
    marks, tracks, _ = _talk(head, 15)
    _, straight = estimate_camera(marks, tracks, head, focal_given=FOCAL)
    k1 = -0.4
    points, seen = marks.points.copy(), tracks.observations.copy()
    points[..., :2], seen[:, 2:] = _bent(points[..., :2], k1), _bent(seen[:, 2:], k1)
    assert np.abs(points - marks.points).max() > 1.5
    camera, bundle = estimate_camera(
        *(replace(marks, points=points), replace(tracks, observations=seen), head),
        focal_given=FOCAL,
        distortion=(k1,),
    )
    assert camera.distortion == (k1,)
    between = Rotation.from_rotvec(straight.rotation).inv() * Rotation.from_rotvec(bundle.rotation)
    assert np.degrees(between.magnitude().max()) < 0.05
    np.testing.assert_allclose(bundle.observations, straight.observations, atol=0.02)
    with pytest.raises(TrackError, match="give both"):
        estimate_camera(marks, tracks, head, distortion=(k1,))


def test_shots_that_are_enlarged_are_put_back(head: HeadModel) -> None:
    marks, tracks, _ = _talk(head, 15)
    times = np.where(np.arange(len(marks.time)) < len(marks.time) // 3, 1.4, 1.0)
    shots, everywhere = (times == 1).astype(np.int32), np.ones(len(times), bool)
    points, seen = marks.points.copy(), tracks.observations.copy()
    points[..., :2] = CENTRE + times[:, None, None] * (points[..., :2] - CENTRE)
    points[..., 2:] *= times[:, None, None]
    seen[:, 2:] = CENTRE + times[seen[:, 0].astype(int), None] * (seen[:, 2:] - CENTRE)
    shown = replace(marks, points=points), replace(tracks, observations=seen)
    (as_filmed, straight), (camera, bundle) = (
        subject.estimate_camera(*clip, head, everywhere, shots) for clip in ((marks, tracks), shown)
    )
    unseen, _ = subject.estimate_camera(*shown, head, times == 1, shots)
    given, _ = subject.estimate_camera(*shown, head, everywhere, shots, focal_given=FOCAL)
    assert not len(as_filmed.zoom) and not len(given.zoom)
    assert not len(unseen.zoom), "other people"
    np.testing.assert_allclose(camera.zoom[:, 0], times, rtol=0.05)
    assert camera.focal_px == pytest.approx(as_filmed.focal_px, rel=0.05)
    between = Rotation.from_rotvec(straight.rotation).inv() * Rotation.from_rotvec(bundle.rotation)
    assert np.degrees(between.magnitude().max()) < 0.5


def _bent(xy: np.ndarray, k1: float) -> np.ndarray:
    """Where a lens shows what a pinhole would show at xy [..., 2] px."""
    from_centre = (xy - CENTRE) / FOCAL
    return CENTRE + FOCAL * from_centre * (1 + k1 * (from_centre**2).sum(-1, keepdims=True))


def test_a_given_focal_length_is_kept(head: HeadModel) -> None:
    marks, tracks, _ = _talk(head, 15)
    camera, bundle = estimate_camera(marks, tracks, head, focal_given=1000.0)
    assert (camera.method, camera.focal_px, camera.focal_sd_log) == ("given", 1000.0, 0.0)
    assert len(bundle.points) and len(bundle.frame) == len(marks.time)
    marks, tracks, turns = _talk(head, 0.5)
    camera, bundle = estimate_camera(marks, tracks, head, focal_given=1000.0)
    assert camera.method == "given"
    between = Rotation.from_matrix(turns[bundle.frame]).inv() * Rotation.from_rotvec(bundle.rotation)
    assert np.degrees((between.mean().inv() * between).magnitude().max()) < 0.2


def test_shots_that_share_no_patch_share_the_focal_length(head: HeadModel) -> None:
    marks, tracks, _ = _talk(head, 18)
    half = tracks.observations[:, 0] >= 20
    rows = tracks.observations.copy()
    rows[half, 1] += rows[:, 1].max() + 1
    rows[:, 1] = np.unique(rows[:, 1], return_inverse=True)[1]
    camera, bundle = estimate_camera(marks, FeatureTracks(tracks.frames, rows), head)
    assert abs(np.log(camera.focal_px / FOCAL)) < 0.25
    assert len(bundle.frame) == 40 and np.isfinite(bundle.translation).all()


def test_without_tracks_or_faces_the_prior_stands(head: HeadModel) -> None:
    marks, tracks, _ = _talk(head, 15)
    for frames in (tracks.frames, np.zeros(0, np.int32)):
        nothing = FeatureTracks(frames, np.zeros((0, 4), np.float32))
        camera, bundle = estimate_camera(marks, nothing, head)
        assert camera.method == "prior" and bundle.rotation.shape == bundle.points.shape == (0, 3)
    # Poses of the mean head's landmarks are no evidence that could take the place of the fit's.
    _, bundle = estimate_camera(marks, nothing, head, focal_given=1000.0)
    assert len(bundle.frame) == 0


def test_frames_in_glasses_are_no_skin(head: HeadModel) -> None:
    """Every fourth point hangs 15 mm before the face, and every tenth track slides off."""
    marks, tracks, turns = _talk(head, 18, before_m=0.015)
    rows = tracks.observations
    sliding = rows[:, 1] % 10 == 0
    rows[sliding, 2] += 0.3 * rows[sliding, 0]
    camera, bundle = estimate_camera(marks, tracks, head)
    assert abs(np.log(camera.focal_px / FOCAL)) < 2.5 * camera.focal_sd_log < 0.5
    between = Rotation.from_matrix(turns[bundle.frame]).inv() * Rotation.from_rotvec(bundle.rotation)
    assert np.degrees((between.mean().inv() * between).magnitude().mean()) < 0.5


def _followed(
    time: np.ndarray, usable: np.ndarray, segments: np.ndarray, unseen: np.ndarray | None = None
) -> np.ndarray:
    """Which frames of a clip are followed whose pictures show nothing; unseen: [T] those without a face."""
    follower = FeatureFollower(time, usable, segments)
    for frame in range(len(time)):
        lost = unseen is not None and unseen[frame]
        follower.see(np.zeros((32, 32, 3), np.uint8), np.full((POINTS, 3), np.nan if lost else 0, np.float32))
    return follower.tracks().frames


def test_frames_are_followed_at_an_even_pace_in_every_shot() -> None:
    total = 600
    usable, segments = np.ones(total, bool), (np.arange(total) // 70).astype(np.int32)
    usable[400:411] = False
    time = np.arange(total) / 25
    frames = _followed(time, usable, segments)
    assert usable[frames].all() and set(np.unique(segments)) == set(segments[frames])
    assert {70 * shot for shot in range(9)} <= set(frames.tolist())
    together = np.diff(segments[frames]) == 0
    assert set(np.diff(frames)[together]) == {3, 13}  # 13: over the frames that show no face
    assert len(_followed(time, np.zeros(total, bool), segments)) == 0
    unseen = np.arange(total) < 100
    assert _followed(time, usable, segments, unseen).min() == 100


def test_pictures_that_stand_still_do_not_change_the_pace() -> None:
    """Film shown twice as fast: every second picture is a repeat, and not usable."""
    total = 600
    usable = np.arange(total) % 2 == 0
    frames = _followed(np.arange(total) / 50, usable, np.zeros(total, np.int32))
    assert usable[frames].all() and set(np.diff(frames)) == {6}


def test_a_long_clip_is_told_by_some_frames_and_its_turns_are_among_them(
    head: HeadModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    marks, tracks, turns = _talk(head, 18, total=80)
    monkeypatch.setattr(subject, "ADJUSTED", 30)
    telling = subject._telling(marks.points)
    assert len(telling) == 30 and {0, 79} <= set(telling.tolist())
    nose = subject.turning(marks.points)
    for farthest in (nose[:, 0].argmin(), nose[:, 0].argmax()):
        assert np.abs(telling - farthest).min() <= 1
    told: list[tuple[int, int]] = []
    camera, bundle = estimate_camera(marks, tracks, head, progress=lambda *step: told.append(step))
    assert camera.method == "bundle" and bundle.frame.tolist() == list(range(80))
    assert told == [(count, 50) for count in range(1, 51)]  # those that were not adjusted
    between = Rotation.from_matrix(turns).inv() * Rotation.from_rotvec(bundle.rotation)
    error = np.degrees((between.mean().inv() * between).magnitude())
    assert error[telling].mean() < 0.5 and np.delete(error, telling).mean() < 0.5
    assert set(np.unique(bundle.observations[:, 0])) == set(range(80))


def test_every_shot_keeps_tracks_when_there_are_too_many() -> None:
    """Three shots without a track in common, the first of them long."""
    rows = [
        (frame, 100 * shot + track, 0, 0)
        for shot, frames in enumerate((range(40), range(40, 50), range(50, 60)))
        for frame in frames
        for track in range(100)
        if track < 50 or frame % 2
    ]
    tracks = FeatureTracks(np.arange(60, dtype=np.int32), np.array(rows, np.float32))
    some = tracks.select(np.arange(0, 60, 2), 90)
    numbers = np.unique(some.observations[:, 1]).astype(int)
    assert some.frames.tolist() == list(range(0, 60, 2))
    assert [int((numbers // 100 == shot).sum()) for shot in range(3)] == [30, 30, 30]
    assert set(some.observations[:, 0]) == set(range(0, 60, 2))
    whole = tracks.select(np.arange(60), 1000)
    np.testing.assert_array_equal(whole.observations, tracks.observations)
    assert (np.unique(tracks.select(np.arange(60), 30).observations[:, 1]) % 100 < 50).all()  # those longest


def _face() -> np.ndarray:
    """Landmarks [478, 2] px of a schematic face: enough for the region and its motion."""
    rng = np.random.default_rng(0)
    points = rng.uniform((200, 100), (440, 260), (POINTS, 2))
    for eye, x in ((LEFT_EYE, 380), (RIGHT_EYE, 260)):
        points[list(eye)] = rng.uniform((x - 15, 160), (x + 15, 180), (len(eye), 2))
    points[33], points[263] = (240, 170), (400, 170)
    return points


def test_the_region_leaves_the_eyes_out() -> None:
    points = _face().astype(np.float32)
    mask = upper_face_mask(points, (480, 640))
    assert mask[170, 380] == 0 and mask[110:250, 210:430].mean() > 100
    assert mask[300:].max() == 0


@pytest.mark.parametrize("same_face", [True, False])
def test_tracks_follow_the_picture_and_over_a_cut_the_same_face_alone(same_face: bool) -> None:
    rng = np.random.default_rng(0)

    def texture() -> np.ndarray:
        noise = cv2.GaussianBlur(rng.integers(0, 255, (480, 640, 3), dtype=np.uint8), (0, 0), 2)
        return cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)

    total, cut, one = 30, 15, texture()
    faces = (one, one if same_face else texture())
    segments = (np.arange(total) >= cut).astype(np.int32)
    shift = np.arange(total)[:, None] * [0.7, -0.4] + segments[:, None] * [25, 18]
    points = np.zeros((total, POINTS, 3))
    points[..., :2] = _face() + shift[:, None]
    pictures = [
        (i / 25, cv2.warpAffine(faces[shot], np.float32([[1, 0, x], [0, 1, y]]), (640, 480)))
        for i, (shot, (x, y)) in enumerate(zip(segments, shift))
    ]
    follower = FeatureFollower(np.arange(total) / 25, np.ones(total, bool), segments)
    for (_, picture), marks in zip(pictures, points):
        follower.see(picture, marks.astype(np.float32))
    tracks = follower.tracks()
    rows = tracks.observations
    assert len(tracks.frames) == 10 and len(rows) > 500
    numbers = rows[:, 1].astype(int)
    assert sorted(set(numbers)) == list(range(numbers.max() + 1))
    over = []
    for number in range(numbers.max() + 1):
        mine = rows[numbers == number]
        frame = mine[:, 0].astype(int)
        moved = mine[:, 2:] - mine[0, 2:]
        assert len(mine) >= 5
        if frame[0] < cut:
            over.append(frame[-1] >= cut)
        if same_face or over[-1:] != [True]:
            assert np.abs(moved - (shift[frame] - shift[frame[0]])).max() < 0.3
    assert np.mean(over) > 0.95 if same_face else np.mean(over) < 0.02


def test_patches_that_are_never_found_again_are_given_up() -> None:
    """Pictures of noise: none looks like the one before."""
    rng = np.random.default_rng(0)
    follower = FeatureFollower(np.arange(60) / 8, np.ones(60, bool), np.zeros(60, np.int32))
    face = np.column_stack([_face(), np.zeros(POINTS)]).astype(np.float32)
    held = []
    for _ in range(60):
        noise = cv2.GaussianBlur(rng.integers(0, 255, (480, 640, 3), dtype=np.uint8), (0, 0), 2)
        follower.see(cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX), face)
        held.append(len(follower._numbers))
    assert max(held) < 600 and follower._numbers.max() > 2500


@pytest.mark.parametrize("shift", [(0, 0), (-220, 90), (230, -130)])
@pytest.mark.parametrize("scale", [1.0, 0.75, 0.3125])
def test_a_part_of_a_picture_is_like_that_of_the_whole_one_shrunk(
    scale: float, shift: tuple[int, int]
) -> None:
    """Also of a face at the picture's rim, and beyond it."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (480, 640, 3), dtype=np.uint8), (0, 0), 2)
    face = ((_face() + shift + 0.5) * scale - 0.5).astype(np.float32)
    part = feature_tracks._part(noise, face, scale)
    gray = cv2.cvtColor(noise, cv2.COLOR_RGB2GRAY)
    size = (round(640 * scale), round(480 * scale))
    whole = fine_texture(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))
    mask = upper_face_mask(face, whole.shape)
    (x, y), (height, width) = part.corner, part.mask.shape
    np.testing.assert_array_equal(part.mask, mask[y : y + height, x : x + width])
    assert np.count_nonzero(part.mask) == np.count_nonzero(mask) > 0
    shown = part.mask > 0
    np.testing.assert_allclose(part.texture[shown], whole[y : y + height, x : x + width][shown], atol=0.02)


def test_a_face_that_is_near_at_first_is_followed_at_its_usual_size() -> None:
    """Somebody who starts the camera and then sits down: the face shrinks from 400 px between the eyes to 200."""
    near = np.column_stack([2.5 * _face(), np.zeros(POINTS)]).astype(np.float32)
    sizes = np.where(np.arange(30) < 5, 1000.0, 500.0)
    boxes = np.column_stack([np.zeros((30, 2)), sizes, sizes]).astype(np.float32)
    given = np.arange(30) / 8, np.ones(30, bool), np.zeros(30, np.int32)
    for known, scale in ((boxes, 160 / 200), (None, 160 / 400)):
        follower = FeatureFollower(*given, known)
        follower.see(np.zeros((1000, 1400, 3), np.uint8), near)
        assert abs(follower._scale - scale) <= 1 / 32
