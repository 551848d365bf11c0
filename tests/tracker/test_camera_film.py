"""Camera, end to end on a filmed head: from pixels to focal length, and clips that give nothing."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from tests.tracker.one_shot import estimate_camera
from tracker.bundle_adjustment import RigidScene, _Problem, _State, absolute_pose, adjust, camera_model
from tracker.camera import PRIOR_FOCAL, PRIOR_SD_LOG
from tracker.feature_tracks import FeatureFollower, FeatureTracks
from tracker.head import load_head
from tracker.landmark_indices import BLENDSHAPE_NAMES, LIPS, POINTS
from tracker.patch_registration import cut_templates, fine_texture, register
from tracker.raster import project, rasterize
from tracker.rigid_surface import SPEECH_M, SurfacePoints, moved_by_speech
from tracker.track import Camera, Landmarks

HEAD = load_head()
SIZE, FOCAL, DISTANCE = (480, 480), 880.0, 0.55  # 1.83 x the long side: far from the prior
PRINCIPAL = ((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
FPS, COUNT = 8.0, 40
TURN = (8.0, 20.0, 4.0)  # degrees
Clip = tuple[Landmarks, list[tuple[float, NDArray[np.uint8]]], NDArray[np.float64]]


def poses(degrees: tuple[float, float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation [T, 3, 3] and translation [T, 3] m of a head that turns by so much about x, y and z."""
    t = np.arange(COUNT) / FPS
    turn = Rotation.from_rotvec(
        np.radians(degrees) * np.sin(np.outer(t, [1.7, 1.3, 0.9]) + np.array([0.5, 0, 1]))
    )
    rotation = turn.as_matrix() @ np.diag([1.0, -1.0, -1.0])
    return rotation, np.array([0, 0, DISTANCE]) - rotation @ HEAD.template.mean(0)


def film(degrees: tuple[float, float, float], noise: float = 2.0) -> Clip:
    """The mean head in a mottled skin, and its landmarks with noise of half a pixel; rotations are the truth."""
    rng = np.random.default_rng(1)
    rotation, translation = poses(degrees)
    skin = gaussian_filter(rng.standard_normal((96, 96, 96)), 1.0)
    skin = 130 + 30 * skin / skin.std()
    low, extent = HEAD.template.min(0), float(np.ptp(HEAD.template, axis=0).max())
    rest = np.zeros(len(HEAD.identity_basis), np.float32), np.zeros(len(HEAD.expression_names), np.float32)
    surface = HEAD.landmark_positions(*rest)
    points = np.zeros((COUNT, POINTS, 3), np.float32)
    pictures = []
    for frame in range(COUNT):
        seen = HEAD.template @ rotation[frame].T + translation[frame]
        pixels = np.column_stack([project(seen, FOCAL, PRINCIPAL), seen[:, 2]])
        raster = rasterize(pixels, HEAD.faces, SIZE)
        hit = raster.triangle >= 0
        corners = HEAD.template[HEAD.faces[raster.triangle[hit]]]
        place = np.einsum("nc,nci->ni", raster.barycentric[hit], corners)
        gray = np.full(SIZE[::-1], 60.0)
        gray[hit] = map_coordinates(skin, 95 * (place - low).T / extent, order=1)
        gray = cv2.GaussianBlur(gray, (0, 0), 0.7) + noise * rng.standard_normal(gray.shape)
        pictures.append((frame / FPS, np.repeat(gray.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)))
        marks = project(surface @ rotation[frame].T + translation[frame], FOCAL, PRINCIPAL)
        marks += 0.5 * rng.standard_normal(marks.shape)
        points[frame, HEAD.landmark_embedding.landmarks, :2] = marks
    return landmarks_of(points), pictures, rotation


def landmarks_of(points: NDArray[np.float32]) -> Landmarks:
    count = len(points)
    presence = np.isfinite(points[:, 0, 0]).astype(np.float32)
    scores = np.zeros((count, len(BLENDSHAPE_NAMES)), np.float32)
    return Landmarks(np.arange(count) / FPS, points, presence, scores, BLENDSHAPE_NAMES, SIZE)


def followed(landmarks: Landmarks, pictures: list, usable: NDArray[np.bool_] | None = None) -> FeatureTracks:
    everywhere = np.ones(COUNT, bool) if usable is None else usable
    follower = FeatureFollower(landmarks.time, everywhere, np.zeros(COUNT, np.int32))
    for (_, rgb), points in zip(pictures, landmarks.points):
        follower.see(rgb, points)
    return follower.tracks()


def assert_prior(camera: Camera) -> None:
    assert camera.method == "prior"
    assert camera.focal_px == pytest.approx(PRIOR_FOCAL * max(SIZE))
    assert camera.focal_sd_log == PRIOR_SD_LOG


@pytest.fixture(scope="module")
def turning() -> Clip:
    return film(TURN)


@pytest.fixture(scope="module")
def found(turning):
    return estimate_camera(turning[0], followed(*turning[:2]), HEAD)


def test_a_turning_head_tells_the_focal_length(found):
    camera, _ = found
    assert camera.method == "bundle"
    assert camera.focal_px == pytest.approx(FOCAL, rel=0.12)
    assert abs(np.log(camera.focal_px / FOCAL)) < 3 * camera.focal_sd_log
    assert 0 < camera.focal_sd_log < PRIOR_SD_LOG
    assert camera.principal_px == PRINCIPAL and camera.size == SIZE and camera.distortion == ()
    assert str(PRIOR_FOCAL) in camera.prior


def test_points_lie_on_the_head_and_project_to_what_was_seen(found):
    camera, bundle = found
    rows = np.searchsorted(bundle.frame, bundle.observations[:, 0].astype(int))
    turn = Rotation.from_rotvec(bundle.rotation).as_matrix()[rows]
    point = bundle.points[bundle.observations[:, 1].astype(int)]
    seen = np.einsum("oij,oj->oi", turn, point) + bundle.translation[rows]
    error = project(seen, camera.focal_px, camera.principal_px) - bundle.observations[:, 2:]
    assert np.median(np.linalg.norm(error, axis=1)) < 0.7
    distance = np.linalg.norm(bundle.points[:, None] - HEAD.template[None, HEAD.regions["face"]], axis=-1)
    assert np.median(distance.min(1)) < 0.005


def test_the_same_clip_gives_the_same_camera(turning, found):
    camera, bundle = estimate_camera(turning[0], followed(*turning[:2]), HEAD)
    for name in ("focal_px", "focal_sd_log", "method", "prior"):
        assert getattr(camera, name) == getattr(found[0], name)
    for name in ("frame", "rotation", "translation", "points", "observations"):
        assert np.array_equal(getattr(bundle, name), getattr(found[1], name)), name


def test_a_still_head_leaves_the_prior():
    landmarks, pictures, _ = film((0.5, 1.0, 0.3))
    camera, bundle = estimate_camera(landmarks, followed(landmarks, pictures), HEAD)
    assert_prior(camera)
    assert np.isfinite(bundle.translation).all() and (bundle.translation[:, 2] > 0).all()


def test_a_picture_without_corners_leaves_the_prior(turning):
    blank = [(time, np.full_like(rgb, 128)) for time, rgb in turning[1]]
    camera, bundle = estimate_camera(turning[0], followed(turning[0], blank), HEAD)
    assert_prior(camera)
    assert len(bundle.points) == len(bundle.observations) == 0


def test_no_face_or_no_usable_frame_leaves_the_prior(turning):
    gone = landmarks_of(np.full_like(turning[0].points, np.nan))
    nothing = np.zeros(COUNT, bool)
    for landmarks, usable in ((gone, None), (turning[0], nothing)):
        camera, bundle = estimate_camera(landmarks, followed(landmarks, turning[1], usable), HEAD)
        assert_prior(camera)
        assert bundle.rotation.shape == bundle.translation.shape == bundle.points.shape == (0, 3)
        assert bundle.observations.shape == (0, 4)


def test_frames_without_a_face_have_no_pose(turning):
    points = turning[0].points.copy()
    points[10:14] = np.nan
    landmarks = landmarks_of(points)
    camera, bundle = estimate_camera(landmarks, followed(landmarks, turning[1]), HEAD)
    assert not np.isin(np.arange(10, 14), bundle.frame).any() and len(bundle.frame)
    assert np.isfinite(camera.focal_px)


def test_tracks_stay_on_the_skin(turning):
    landmarks, pictures, rotation = turning
    _, translation = poses(TURN)
    rows = followed(landmarks, pictures).observations
    begun = rows[rows[:, 0] == 0]
    assert len(begun) > 50 and np.bincount(rows[:, 1].astype(int)).min() >= 5
    seen = HEAD.template @ rotation[0].T + translation[0]
    raster = rasterize(np.column_stack([project(seen, FOCAL, PRINCIPAL), seen[:, 2]]), HEAD.faces, SIZE)
    x, y = begun[:, 2:].round().astype(int).T
    assert (raster.triangle[y, x] >= 0).all()
    skin = np.einsum("nc,nci->ni", raster.barycentric[y, x], HEAD.template[HEAD.faces[raster.triangle[y, x]]])
    place = dict(zip(begun[:, 1].astype(int).tolist(), skin))
    later = rows[(rows[:, 0] >= 5) & np.isin(rows[:, 1], begun[:, 1])]
    points = np.stack([place[int(track)] for track in later[:, 1]])
    frame = later[:, 0].astype(int)
    there = np.einsum("oij,oj->oi", rotation[frame], points) + translation[frame]
    error = np.linalg.norm(project(there, FOCAL, PRINCIPAL) - later[:, 2:], axis=1)
    assert np.median(error) < 1  # half of it from rounding the first place to a pixel


def scene(noise_px: float, seed: int = 0) -> tuple[RigidScene, SurfacePoints]:
    """150 points of the head's front, in all frames with noise, and what is known of them: to lie near a bent head."""
    rng = np.random.default_rng(seed)
    rotation, translation = poses(TURN)
    points = HEAD.template[rng.choice(HEAD.regions["face"], 150, replace=False)].astype(np.float64)
    seen = np.einsum("mij,qj->mqi", rotation, points) + translation[:, None]
    xy = project(seen, FOCAL, PRINCIPAL) + noise_px * rng.standard_normal((COUNT, len(points), 2))
    frame, point = np.mgrid[:COUNT, : len(points)].reshape(2, -1)
    true = RigidScene(
        frames=np.arange(COUNT, dtype=np.int32),
        rotation=rotation,
        translation=translation,
        points=points,
        observations=np.column_stack([frame, point, xy.reshape(-1, 2)]),
    )
    true.observations[:, 1] += len(points) * (frame >= COUNT // 2)  # two shots of one head
    true = replace(true, points=np.concatenate([points, points]))
    modes = 0.002 * rng.standard_normal((150, 3, 3))
    bent = points + modes @ rng.standard_normal(3) + 0.001 * rng.standard_normal(points.shape)
    precision = np.broadcast_to(np.eye(3) / 0.001**2, (300, 3, 3))
    surface = SurfacePoints(
        np.concatenate([bent, bent]), np.concatenate([modes, modes]), precision, moving=np.zeros(300)
    )
    return true, surface


def residuals(found: RigidScene, focal: float) -> NDArray[np.float64]:
    """[O, 2] px, projected minus observed."""
    row, point = found.rows(), found.points[found.observations[:, 1].astype(int)]
    seen = np.einsum("oij,oj->oi", found.rotation[row], point) + found.translation[row]
    return project(seen, focal, PRINCIPAL) - found.observations[:, 2:]


def test_bundle_adjustment_finds_the_focal_length_and_knows_how_well():
    true, surface = scene(0.3)
    prior = PRIOR_FOCAL * max(SIZE)
    start = replace(true, translation=true.translation * (1, 1, prior / FOCAL))
    adjusted, focal, sd_log = adjust(start, surface, PRINCIPAL, prior, PRIOR_SD_LOG)
    assert abs(np.log(focal / FOCAL)) < 2 * sd_log < 0.2
    between = Rotation.from_matrix(adjusted.rotation) * Rotation.from_matrix(true.rotation).inv()
    assert np.degrees(between.magnitude()).max() < 1.5
    assert np.linalg.norm(adjusted.points - true.points, axis=1).mean() < 0.004


def test_bundle_adjustment_of_one_shot_with_points_known_to_three_millimetres():
    true, _ = scene(0.3)
    observations = true.observations.copy()
    observations[:, 1] %= 150
    points = true.points[:150] + 0.003 * np.random.default_rng(4).standard_normal((150, 3))
    precision = np.broadcast_to(np.eye(3) / 0.003**2, (150, 3, 3))
    surface = SurfacePoints(points, np.zeros((150, 3, 0)), precision, moving=np.zeros(150))
    prior = PRIOR_FOCAL * max(SIZE)
    start = replace(
        true,
        translation=true.translation * (1, 1, prior / FOCAL),
        points=points,
        observations=observations,
    )
    adjusted, focal, sd_log = adjust(start, surface, PRINCIPAL, prior, PRIOR_SD_LOG)
    assert focal == pytest.approx(FOCAL, rel=0.03)
    assert abs(np.log(focal / FOCAL)) < 2.5 * sd_log
    assert np.std(residuals(adjusted, focal)) < 0.32


def test_points_that_go_along_with_the_lips_lead_the_adjustment_less_astray():
    true, surface = scene(0.3)
    low = true.points[:, 1] < np.quantile(true.points[:, 1], 0.4)
    moving = np.where(low, 0.001, 0.0)
    observations, rows = true.observations.copy(), true.rows()
    # Skin stretched more the farther the head is turned, which a flatter head would do as well.
    turned = Rotation.from_matrix(true.rotation).as_rotvec()[rows, 1]
    scale = FOCAL / true.translation[rows, 2]
    observations[:, 2] += scale * moving[observations[:, 1].astype(int)] * turned / turned.std()
    seen = replace(true, observations=observations)
    astray, led = (
        adjust(seen, replace(surface, moving=known), PRINCIPAL, PRIOR_FOCAL * max(SIZE), PRIOR_SD_LOG)
        for known in (np.zeros_like(moving), moving)
    )
    errors = []
    for scene_, _, _ in (astray, led):
        between = Rotation.from_matrix(scene_.rotation) * Rotation.from_matrix(true.rotation).inv()
        errors.append((between * between.mean().inv()).magnitude().mean())
    assert errors[1] < 0.8 * errors[0]


def test_skin_goes_along_with_the_lips_the_more_the_nearer_it_is():
    moved = dict(zip(HEAD.landmark_embedding.landmarks.tolist(), moved_by_speech(HEAD).tolist()))
    forehead, bridge, tip, cheek, lip = (moved[index] for index in (10, 6, 4, 50, 14))
    assert forehead < 1e-6 and bridge < 5e-5 < tip < cheek < lip
    assert np.mean([moved[index] for index in LIPS]) == pytest.approx(SPEECH_M, rel=0.2)


def test_a_known_focal_length_stays():
    true, surface = scene(0.3)
    adjusted, focal, sd_log = adjust(true, surface, PRINCIPAL, FOCAL, 0.0)
    assert focal == pytest.approx(FOCAL) and sd_log == 0.0
    assert np.std(residuals(adjusted, FOCAL)) < 0.34


def test_the_adjustment_s_derivatives_are_those_of_its_residuals():
    true, surface = scene(0.0)
    problem = _Problem(true, surface, np.array(PRINCIPAL), 700.0, PRIOR_SD_LOG)
    rng = np.random.default_rng(3)
    state = _State(np.log(800.0), np.zeros(3), np.zeros((300, 3)), true.rotation, true.translation)
    problem.let_go(0.0, state)
    problem._repeats, problem._noise = 1.0, 1e6  # so that every weight is one over this noise
    linear = problem._linear(state)
    row, point = true.rows(), true.observations[:, 1].astype(int)
    turn, shift, departure = (rng.standard_normal(shape) for shape in ((COUNT, 3), (COUNT, 3), (300, 3)))

    def at(h: float) -> NDArray[np.float64]:
        rotation = Rotation.from_rotvec(h * turn).as_matrix() @ true.rotation
        moved = _State(
            state.log_focal + h, state.shape, h * departure, rotation, true.translation + h * shift
        )
        return problem._residuals(moved)[0]

    numeric = (at(1e-6) - at(-1e-6)) / 2e-6
    pose = np.concatenate([turn, shift], axis=1)[row]
    analytic = np.einsum("oij,oj->oi", linear.pose, pose) + linear.focal
    analytic += np.einsum("oij,oj->oi", linear.point, departure[point])
    assert np.allclose(1e6 * analytic, numeric, rtol=1e-4, atol=1e-2)


def test_a_step_of_the_adjustment_is_that_of_all_unknowns_together_and_goes_down_the_cost():
    """Against one dense system in which nothing is eliminated, whose slope is the cost's by finite differences."""
    rng, (frames, count, shapes) = np.random.default_rng(7), (5, 12, 2)
    points = rng.normal(0, 0.03, (count, 3))
    rotation = Rotation.from_rotvec(rng.normal(0, 0.2, (frames, 3))).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    translation = np.array([0, 0, DISTANCE]) + rng.normal(0, 0.01, (frames, 3))
    frame, point = (index.ravel() for index in np.mgrid[:frames, :count])
    kept = rng.random(len(frame)) < 0.8
    seen = np.einsum("oij,oj->oi", rotation[frame], points[point]) + translation[frame]
    xy = project(seen, FOCAL, PRINCIPAL) + rng.normal(0, 1.0, (len(frame), 2))
    observations = np.column_stack([frame, point, xy])[kept]
    root = rng.normal(size=(count, 3, 3))
    precision = (root @ root.transpose(0, 2, 1) + np.eye(3)) / 0.002**2
    modes = 0.003 * rng.normal(size=(count, 3, shapes))
    surface = SurfacePoints(points, modes, precision, moving=rng.uniform(0, 0.001, count))
    scene_ = RigidScene(np.arange(frames, dtype=np.int32), rotation, translation, points, observations)
    problem = _Problem(scene_, surface, np.array(PRINCIPAL), FOCAL, 0.3)
    state = _State(
        np.log(1.1 * FOCAL), rng.normal(size=shapes), rng.normal(0, 0.002, (count, 3)), rotation, translation
    )
    problem.let_go(0.0, state)

    def moved(change: NDArray[np.float64]) -> _State:
        longer, shape, off, turn, shift = np.split(change, np.cumsum([1, shapes, 3 * count, 3 * frames]))
        turned = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix() @ rotation
        return _State(
            state.log_focal + longer[0],
            state.shape + shape,
            state.departure + off.reshape(-1, 3),
            turned,
            translation + shift.reshape(-1, 3),
        )

    unknowns = 1 + shapes + 3 * count + 6 * frames
    steps = 1e-6 * np.eye(unknowns)
    slope = np.array([(problem._cost(moved(h)) - problem._cost(moved(-h))) / 4e-6 for h in steps])
    rows = np.stack(
        [(problem._residuals(moved(h))[0] - problem._residuals(moved(-h))[0]) / 2e-6 for h in steps]
    )
    residual = problem._residuals(state)[0]
    variance = problem._repeats * problem._noise**2 * (1 + (residual**2).sum(1) / (2 * problem._noise) ** 2)
    dense = np.einsum("uok,o,vok->uv", rows, 1 / variance, rows)
    dense[0, 0] += 0.3**-2
    dense[range(1, 1 + shapes), range(1, 1 + shapes)] += 1
    believed = 1 / (1 + np.einsum("qi,qij,qj->q", state.departure, precision, state.departure) / 3.0**2)
    for q in range(count):
        own = slice(1 + shapes + 3 * q, 4 + shapes + 3 * q)
        dense[own, own] += believed[q] * precision[q]
    expected, found = moved(-np.linalg.solve(dense, slope)), problem._step(state, 0.0)
    assert abs(expected.log_focal - state.log_focal) > 0.02
    for name in ("log_focal", "shape", "departure", "rotation", "translation"):
        before, there, here = (getattr(one, name) for one in (state, expected, found))
        np.testing.assert_allclose(here, there, atol=1e-3 * np.abs(there - before).max(), err_msg=name)
    assert problem.focal_sd_log(state) == pytest.approx(np.sqrt(np.linalg.inv(dense)[0, 0]), rel=1e-4)


def test_tracks_count_and_not_how_often_each_is_seen():
    """An error of a track stays from frame to frame: twice as many frames tell the focal length no better."""
    true, surface = scene(0.3)
    rows = true.observations[:, 0] % 2 == 0
    half = replace(true.select(np.arange(0, COUNT, 2)), observations=true.observations[rows])
    sds = [adjust(some, surface, PRINCIPAL, FOCAL, PRIOR_SD_LOG)[2] for some in (true, half)]
    assert sds[1] == pytest.approx(sds[0], rel=0.25)


def test_patches_are_found_turned_stretched_and_under_another_light():
    rng = np.random.default_rng(0)
    picture = gaussian_filter(rng.standard_normal((200, 200)), 1.2)
    picture = (128 + 25 * picture / picture.std()).clip(0, 255).astype(np.uint8)
    motion = np.array([[0.98, -0.12, 14.0], [0.1, 1.04, -6.0]])
    light = np.linspace(0.5, 1.2, 200)[:, None]
    later = cv2.warpAffine(picture, motion, (200, 200), flags=cv2.INTER_CUBIC)
    later = (light * later + 20).clip(0, 255).astype(np.uint8)
    xy = rng.uniform(50, 150, (40, 2))
    there = xy @ motion[:, :2].T + motion[:, 2]
    templates = cut_templates(fine_texture(picture), xy)
    bend = np.broadcast_to(motion[:, :2], (40, 2, 2))
    texture = fine_texture(later)
    places, found = register(texture, there + rng.uniform(-0.8, 0.8, xy.shape), bend, templates)
    assert found.mean() > 0.9
    assert np.abs(places - there)[found].max() < 0.15
    _, found = register(texture, there + np.array([40.0, 0]), bend, templates)
    assert found.mean() < 0.1
    edge = np.repeat(np.linspace(0, 40, 200)[None] // 10 * 60, 200, axis=0).astype(np.uint8)
    assert not cut_templates(fine_texture(edge), np.array([[50.0, 100.0], [100.0, 90.0]])).corners().any()


def test_a_patch_at_the_border_is_found_and_none_of_none():
    picture = np.random.default_rng(0).integers(0, 255, (90, 120)).astype(np.uint8)
    texture, corners = fine_texture(picture), np.array([[0.0, 0.0], [119.0, 89.0]])
    templates, straight = cut_templates(texture, corners), np.tile(np.eye(2), (2, 1, 1))
    places, found = register(texture, corners, straight, templates)
    assert found.all()
    assert np.abs(places - corners).max() < 0.05
    places, found = register(texture, corners[:0], straight[:0], templates.select(np.zeros(0, int)))
    assert places.shape == (0, 2) and not len(found)


def test_absolute_pose_is_exact_with_outliers_and_pixel_centres_at_integers():
    true, _ = scene(0.0)
    xy = true.observations[:150, 2:].copy()
    xy[:20] += 40
    rotation, translation = absolute_pose(xy, true.points[:150], camera_model(FOCAL, PRINCIPAL, SIZE), 3.0)
    assert np.allclose(rotation, true.rotation[0], atol=1e-4)
    assert np.allclose(translation, true.translation[0], atol=1e-4)


def test_a_failed_adjustment_leaves_the_prior(turning, monkeypatch):
    monkeypatch.setattr("tracker.camera.adjust", lambda *_: None)
    camera, bundle = estimate_camera(turning[0], followed(*turning[:2]), HEAD)
    assert_prior(camera)
    assert len(bundle.frame) == 0  # poses that were not adjusted are no evidence
