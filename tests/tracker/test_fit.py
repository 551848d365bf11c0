"""Closed loop: known parameters -> projected landmarks and noise -> fit -> error."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracker import solver
from tracker.energy import LIP_PAIRS, Weights, landmark_model
from tracker.fit import fit_track, make_track, resume, runs, trusted, with_lips_shut
from tracker.head import load_head
from tracker.landmark_indices import BLENDSHAPE_NAMES, INNER_LIP_LOWER, POINTS
from tracker.modes import LIP_SHAPES
from tracker.scene import place
from tracker.track import Camera, Landmarks, TrackError

HEAD = load_head()
NAMES = list(HEAD.expression_names)
SIZE, FOCAL, DISTANCE = (1280, 720), 1500.0, 0.65
CAMERA = Camera(FOCAL, 0.0, (639.5, 359.5), (), SIZE, "given", "")
NOISE = 0.0035  # of the outer-eye distance, which is about 0.09 m


class Talker:
    """A person of the head model who talks, blinks, looks about and turns the head for T frames.

    held: frames in which the face is held in the weights of these shapes instead.
    """

    def __init__(
        self,
        frames: int,
        seed: int = 0,
        noise: float = NOISE,
        turn: Rotation | None = None,
        held: tuple[slice, dict[str, float]] | None = None,
    ):
        rng = np.random.default_rng(seed)
        t = np.arange(frames) / 25
        self.identity = 0.6 * rng.normal(size=len(HEAD.identity_basis)).astype(np.float32)
        self.expression = np.zeros((frames, len(NAMES)), np.float32)
        for name, size, hertz in (
            ("jawOpen", 0.35, 3.0),
            ("mouthFunnel", 0.4, 2.3),
            ("mouthSmileLeft", 0.3, 0.6),
            ("mouthSmileRight", 0.3, 0.6),
            ("eyeBlinkLeft", 0.8, 0.4),
            ("eyeBlinkRight", 0.8, 0.4),
        ):
            self.expression[:, NAMES.index(name)] = size * np.clip(
                np.sin(2 * np.pi * hertz * t + len(name)), 0, 1
            )
        if held is not None:
            self.expression[held[0]] = [held[1].get(name, 0.0) for name in NAMES]
        self.eyes = np.zeros((frames, 2, 3), np.float32)
        self.eyes[..., 1] = np.radians(12) * np.sin(3 * t)[:, None]
        if turn is None:
            turn = Rotation.from_rotvec(
                np.radians([6.0, 18.0, 4.0]) * np.sin(np.outer(t, [0.9, 0.7, 0.5]) + 1)
            )
        self.rotation = turn.as_matrix() @ np.diag([1.0, -1.0, -1.0])
        shift = np.array([0, 0, DISTANCE]) + 0.01 * np.sin(np.outer(t, [0.8, 0.5, 0.6]))
        self.translation = shift - self.rotation @ HEAD.template.mean(0)
        person = np.broadcast_to(self.identity, (frames, len(self.identity)))
        vertices = HEAD.vertices(person, self.expression)
        self.lips = 1e3 * (
            vertices[:, HEAD.regions["lips"]]
            - HEAD.vertices(self.identity, 0 * self.expression[0])[HEAD.regions["lips"]]
        )
        self.gap = HEAD.lip_gap_mm(vertices)
        face = HEAD.landmark_positions(person, self.expression, eyes=self.eyes)
        seen = face @ self.rotation.transpose(0, 2, 1) + self.translation[:, None]
        pixels = FOCAL * seen[..., :2] / seen[..., 2:] + [639.5, 359.5]
        pixels += noise * 0.09 * FOCAL / DISTANCE * rng.normal(size=pixels.shape)
        points = np.zeros((frames, POINTS, 3), np.float32)
        points[:, HEAD.landmark_embedding.landmarks] = np.dstack([pixels, seen[..., 2] * FOCAL / DISTANCE])
        scores = np.zeros((frames, len(BLENDSHAPE_NAMES)), np.float32)
        self.landmarks = Landmarks(t, points, np.ones(frames, np.float32), scores, BLENDSHAPE_NAMES, SIZE)

    def fit(self, usable=None, segment=None, camera=CAMERA, landmarks=None, evidence=None):
        landmarks = landmarks or self.landmarks
        frames = len(landmarks.time)
        usable = np.ones(frames, bool) if usable is None else usable
        segment = np.zeros(frames, np.int32) if segment is None else segment
        return fit_track(landmarks, camera, HEAD, usable, segment, evidence=evidence)


def turn_error_deg(track, truth):
    """[T] degrees."""
    relative = Rotation.from_rotvec(track.rotation) * Rotation.from_matrix(truth).inv()
    return np.degrees(relative.magnitude())


def without_face(landmarks: Landmarks, gone: slice) -> Landmarks:
    points, presence = landmarks.points.copy(), landmarks.presence.copy()
    points[gone], presence[gone] = np.nan, 0
    return replace(landmarks, points=points, presence=presence)


def assert_finite(track):
    for name in (
        "identity",
        "expression",
        "rotation",
        "translation",
        "eyes",
        "lip_gap_mm",
        "reprojection_px",
        "confidence",
    ):
        assert np.isfinite(getattr(track, name)).all(), name


@pytest.fixture(scope="module")
def talker() -> Talker:
    return Talker(150)


@pytest.fixture(scope="module")
def track(talker):
    return talker.fit()


def test_lips_pose_and_opening_are_found(talker, track):
    lips = 1e3 * np.tensordot(track.expression, HEAD.expression_basis[:, HEAD.regions["lips"]], axes=1)
    error = (lips - lips.mean(0)) - (talker.lips - talker.lips.mean(0))
    assert np.linalg.norm(error, axis=-1).mean() < 0.6
    assert np.corrcoef(track.lip_gap_mm, talker.gap)[0, 1] > 0.99
    assert np.sqrt(np.mean((track.lip_gap_mm - talker.gap) ** 2)) < 0.8
    assert turn_error_deg(track, talker.rotation).mean() < 1.0
    assert np.abs(track.translation - talker.translation).max() < 0.05
    assert track.reprojection_px.mean() < 3 * NOISE * 0.09 * FOCAL / DISTANCE


def test_shut_lips_read_shut_though_the_landmarker_keeps_them_apart():
    talker = Talker(150, seed=2, noise=0.001)
    points = talker.landmarks.points.copy()
    apart = 0.0007 * FOCAL / DISTANCE  # px
    points[:, [upper for upper, _ in LIP_PAIRS], 1] -= apart / 2
    points[:, [lower for _, lower in LIP_PAIRS], 1] += apart / 2
    track = talker.fit(landmarks=replace(talker.landmarks, points=points))
    shut = talker.gap < 0.05
    assert shut.sum() > 10
    assert np.median(track.lip_gap_mm[shut]) < 0.3
    assert np.sqrt(np.mean((track.lip_gap_mm - talker.gap) ** 2)) < 0.6


@pytest.mark.parametrize(
    ("shut_mm", "open_mm", "told_mm"),
    [
        ([0.3] * 3, (2, 6), 0.3),
        ([0.8] * 3, (2, 6), 0.8),
        ([0.1] * 3, (0.85, 0.99), 0.1),
        ([0.5] * 2 + [1.1] * 8, (2, 6), 1.0),
        ([-0.5] + [0.4] * 6, (2, 6), 0.4),
        ([0.2] * 9, (0.8, 0.88), 0.2),
        ([], (2, 6), 1.0),
    ],
)
def test_lips_that_hardly_ever_shut_are_not_taken_for_shut(
    shut_mm: list[float], open_mm: tuple[float, float], told_mm: float
):
    """Of twenty frames the first have lips that touch and are seen `shut_mm` apart, others open by `open_mm`."""
    talker = Talker(20, noise=0.0, held=(slice(0, 20), {}))
    energy, x, *_ = resume(talker.fit(), talker.landmarks, CAMERA, HEAD)
    model = landmark_model(HEAD, Weights())
    lips = [k for k, pair in enumerate(model.landmarks[model.pairs].tolist()) if tuple(pair) in LIP_PAIRS]
    upper, lower = model.pairs[lips].T
    seen = replace(energy, model=model, observed=energy.observed.copy())
    down = 1e-3 * np.array([*shut_mm, *np.linspace(*open_mm, 20 - len(shut_mm))]) * energy.px_per_m
    seen.observed[:, lower] = seen.observed[:, upper] + np.stack([0 * down, down], axis=-1)[:, None]
    bias = 1e3 * (with_lips_shut(seen, x, np.arange(20)).model.touch - model.touch)[lips]
    np.testing.assert_allclose(bias, told_mm, atol=0.15)


def test_shut_lips_are_read_in_bare_frames():
    talker = Talker(120, seed=2, noise=0.001)
    points = talker.landmarks.points.copy()
    # What a hand over the mouth shows as lips: shut in the middle and crossed beside it.
    points[40:60, 14] = points[40:60, 13]
    points[40:60, [upper for upper, _ in LIP_PAIRS if upper != 13], 1] += 0.003 * FOCAL / DISTANCE
    covered = replace(talker.landmarks, points=points)
    evidence = np.ones(120, np.float32)
    evidence[40:60] = 0
    track = talker.fit(landmarks=covered, evidence=evidence)
    touch = {
        name: resume(track, landmarks, CAMERA, HEAD, told)[0].model.touch
        for name, landmarks, told in (
            ("bare", talker.landmarks, None),
            ("told", covered, evidence),
            ("untold", covered, None),
        )
    }
    assert np.abs(touch["told"] - touch["bare"]).max() < 0.0003
    assert np.abs(touch["untold"] - touch["bare"]).max() > 0.0006


def test_lips_and_lids_do_not_pass_each_other():
    model = landmark_model(HEAD, Weights())
    talker = Talker(60, seed=4)
    points = talker.landmarks.points.copy()
    upper, lower = model.landmarks[model.pairs].T
    points[:, upper, 1] += 0.002 * FOCAL / DISTANCE
    points[:, lower, 1] -= 0.002 * FOCAL / DISTANCE
    track = talker.fit(landmarks=replace(talker.landmarks, points=points))
    shape = model.mean + np.tensordot(track.identity, model.identity, axes=1)
    face = shape + np.tensordot(track.expression, model.expression, axes=1)
    assert (model.heights(face) - model.touch).min() > -2e-4


@pytest.mark.parametrize(
    "shapes",
    [{"mouthPressLeft": 0.8, "mouthPressRight": 0.8}, {"mouthRollLower": 0.6, "mouthRollUpper": 0.6}],
)
def test_pressed_and_rolled_lips_are_thin_and_shut_and_do_not_cross(shapes: dict[str, float]):
    silent = slice(20, 40)
    talker = Talker(60, seed=2, noise=0.001, held=(silent, shapes))
    # The head's own rolled lips pass through each other: where they cross, a detector sees one line.
    upper, lower = np.transpose(LIP_PAIRS)
    points = talker.landmarks.points.copy()
    crossed = (points[:, upper, 1] > points[:, lower, 1])[..., None]
    line = (points[:, upper] + points[:, lower]) / 2
    points[:, upper] = np.where(crossed, line, points[:, upper])
    points[:, lower] = np.where(crossed, line, points[:, lower])
    track = talker.fit(landmarks=replace(talker.landmarks, points=points))
    vertices = HEAD.vertices(track.identity, track.expression)[silent]
    edges = (HEAD.regions[f"inner_lip_{lip}"] for lip in ("upper", "lower"))
    above, below = (vertices[:, edge, 1] for edge in edges)
    assert np.abs(track.lip_gap_mm[silent]).max() < 0.2
    assert (above - below).min() > -2e-4 and (above - below).max() < 1e-3
    places = HEAD.landmark_embedding.landmarks.tolist()
    fitted = HEAD.landmark_positions(track.identity, track.expression)
    thickness = fitted[:, places.index(0), 1] - fitted[:, places.index(17), 1]
    assert thickness[silent].mean() < thickness[: silent.start].min() - 1.5e-3


def test_a_mouth_that_opens_in_another_profile_is_followed(monkeypatch):
    talker = Talker(75, seed=3, noise=0.001)
    # A fifth wider beside the middle and narrower in it, as no shape of ARKit's opens.
    along = (np.arange(len(LIP_PAIRS)) + 1) / (len(LIP_PAIRS) + 1)
    apart = 1e-3 * np.maximum(talker.gap, 0)[:, None] * 0.2 * np.sin(3 * np.pi * along)
    up = talker.rotation[:, :2, 1] * FOCAL / DISTANCE
    points = talker.landmarks.points.copy()
    for lip, way in zip(np.transpose(LIP_PAIRS), (0.5, -0.5)):
        points[:, lip, :2] += way * apart[..., None] * up[:, None]
    landmarks = replace(talker.landmarks, points=points)
    usable, shot = np.ones(75, bool), np.zeros(75, np.int32)
    errors = []
    for sd in (Weights().lip_shape_sd, 1e-3):
        weights = Weights(lip_shape_sd=sd)
        monkeypatch.setattr("tracker.fit.Weights", lambda weights=weights: weights)
        track = fit_track(landmarks, CAMERA, HEAD, usable, shot)
        errors.append(track.lip_gap_mm - 0.8 * talker.gap)
    followed, held = (np.sqrt(np.mean(error**2)) for error in errors)
    assert followed < 0.5 * held


@pytest.mark.parametrize("shape", ["mouthLeft", "mouthRight", "jawLeft"])
def test_a_mouth_pulled_awry_is_followed(shape: str):
    """And none is invented of a mouth that only opens, as the head turns."""
    awry = slice(40, 60)
    talker = Talker(100, held=(awry, {shape: 0.6, "jawOpen": 0.15}))
    moves = HEAD.expression_basis[:, HEAD.regions["lips"], 0].mean(1)
    found, true = (1e3 * (weights @ moves) for weights in (talker.fit().expression, talker.expression))
    assert abs(true[awry].mean()) > 1.5
    assert found[awry].mean() == pytest.approx(true[awry].mean(), rel=0.2)
    assert np.abs((found - true)[:35]).mean() < 0.25


def test_a_frame_in_which_the_landmarker_hardly_sees_a_face_is_not_measured():
    talker = Talker(4)
    presence = np.float32([1, 0.49, 0.5, 1])
    track = talker.fit(landmarks=replace(talker.landmarks, presence=presence))
    assert track.valid.tolist() == [True, False, True, True] and track.confidence[1] == 0
    assert track.confidence[2] < 0.6 * track.confidence[0]


def test_reprojection_is_the_mean_distance_of_the_landmarks_that_are_fitted(talker, track):
    fitted = landmark_model(HEAD, Weights()).landmarks
    rows = np.isin(HEAD.landmark_embedding.landmarks, fitted)
    for frame in (0, 77):
        at = place(track, frame, HEAD)[1][rows]
        pixels = FOCAL * at[:, :2] / at[:, 2:] + [639.5, 359.5]
        seen = talker.landmarks.points[frame, HEAD.landmark_embedding.landmarks[rows], :2]
        apart = np.linalg.norm(pixels - seen, axis=1)
        # But for how far apart the landmarker holds shut lips, which is taken out.
        assert track.reprojection_px[frame] == pytest.approx(apart.mean(), rel=0.02)
        assert apart.max() > 2 * apart.mean()


def test_gaze_follows_the_irises(talker, track):
    open_eyes = talker.expression[:, NAMES.index("eyeBlinkLeft")] < 0.1
    for side in range(2):
        yaw = track.eyes[open_eyes, side, 1]
        assert np.corrcoef(yaw, talker.eyes[open_eyes, side, 1])[0, 1] > 0.95
        assert abs(np.polyfit(talker.eyes[open_eyes, side, 1], yaw, 1)[0] - 1) < 0.12


def test_everything_has_its_shape_and_bounds(talker, track):
    frames = len(talker.landmarks.time)
    assert track.identity.shape == (len(HEAD.identity_basis),)
    assert track.expression.shape == (frames, len(NAMES))
    assert track.eyes.shape == (frames, 2, 3)
    assert track.head == f"{HEAD.name}@{HEAD.sha256}"
    assert_finite(track)
    assert track.valid.all()
    signed = np.isin(NAMES, LIP_SHAPES)
    assert track.expression[:, ~signed].min() >= 0
    assert np.abs(track.expression).max() <= 1
    assert track.expression[:, signed].min() < 0
    assert (
        track.expression[:, NAMES.index("mouthClose")] <= track.expression[:, NAMES.index("jawOpen")]
    ).all()
    assert track.confidence.min() >= 0
    assert 0.8 < np.median(track.confidence) <= 1


def test_the_same_input_gives_the_same_track(talker, track):
    again = talker.fit()
    np.testing.assert_array_equal(again.expression, track.expression)
    np.testing.assert_array_equal(again.rotation, track.rotation)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5])
def test_short_clips(frames):
    talker = Talker(frames)
    track = talker.fit()
    assert_finite(track)
    assert track.valid.all()
    assert turn_error_deg(track, talker.rotation).max() < 5


def test_frames_without_a_face_take_the_nearest_pose_and_are_not_measured(talker):
    gone = slice(40, 52)
    track = talker.fit(landmarks=without_face(talker.landmarks, gone))
    assert_finite(track)
    np.testing.assert_array_equal(np.flatnonzero(~track.valid), np.arange(40, 52))
    assert (track.confidence[gone] == 0).all()
    np.testing.assert_array_equal(track.rotation[41], track.rotation[39])
    np.testing.assert_array_equal(track.expression[50], track.expression[52])


def test_frames_that_are_not_usable_do_not_touch_the_fit(talker):
    usable = np.ones(150, bool)
    usable[60:70] = False
    points = talker.landmarks.points.copy()
    reference = talker.fit(usable)
    points[60:70] += 300
    spoiled = talker.fit(usable, landmarks=replace(talker.landmarks, points=points))
    np.testing.assert_array_equal(spoiled.expression, reference.expression)


def test_smoothness_does_not_cross_a_cut():
    first, second = Talker(40, seed=3), Talker(40, seed=3)
    points = np.concatenate([first.landmarks.points, second.landmarks.points[::-1] + np.float32([200, 0, 0])])
    whole = replace(
        first.landmarks,
        time=np.arange(80) / 25,
        points=points,
        presence=np.ones(80, np.float32),
        blendshapes=np.zeros((80, 52), np.float32),
    )
    jump = np.linalg.norm
    cut = first.fit(landmarks=whole, segment=np.repeat(np.int32([0, 1]), 40))
    through = first.fit(landmarks=whole)
    assert jump(cut.translation[40] - cut.translation[39]) > 0.07
    assert cut.reprojection_px[38:42].mean() < through.reprojection_px[38:42].mean()
    assert cut.reprojection_px[38:42].mean() < 1.3 * cut.reprojection_px.mean()


@pytest.mark.parametrize(
    ("evidence", "rows"),
    [
        ([1.0] * 10 + [0.0] * 90, range(10)),  # covered ones tell nothing, however few are bare
        ([0.9] * 30 + [0.4] * 70, range(30)),
        ([0.55] * 2 + [0.45] * 30 + [0.1] * 68, range(32)),  # hardly any is sure
        ([0.45] * 50 + [0.3] * 50, range(50)),
        ([1.0] + [0.45] * 99, range(100)),
    ],
)
def test_frames_that_are_bare_are_trusted_or_the_barest(evidence: list[float], rows: range):
    np.testing.assert_array_equal(trusted(np.array(evidence, np.float32), np.arange(100)), rows)
    assert len(trusted(None, np.arange(5))) == 5


def test_a_frame_with_wild_landmarks_is_not_trusted(talker):
    points = talker.landmarks.points.copy()
    points[80, :, :2] += np.random.default_rng(0).normal(size=(POINTS, 2)) * 15
    track = talker.fit(landmarks=replace(talker.landmarks, points=points))
    assert track.confidence[80] < 0.3
    assert np.median(track.confidence) > 0.8


def leaning(talker: Talker, covered: slice, deg: float) -> tuple[Landmarks, np.ndarray]:
    """Behind a hand the landmarker holds another face: one that leans, its mouth open; and what evidence there is."""
    points, evidence = talker.landmarks.points.copy(), np.ones(len(talker.landmarks.time), np.float32)
    points[covered, list(INNER_LIP_LOWER), 1] += np.float32(20)
    middle = points[covered].mean(1, keepdims=True)[..., :2]
    lean = Rotation.from_euler("z", deg, degrees=True).as_matrix()[:2, :2].astype(np.float32)
    points[covered, :, :2] = (points[covered, :, :2] - middle) @ lean.T + middle
    evidence[covered] = 0
    return replace(talker.landmarks, points=points), evidence


def test_a_covered_face_does_not_bend_the_frames_beside_it():
    talker, covered = Talker(90), slice(40, 70)
    landmarks, evidence = leaning(talker, covered, 10)
    track = talker.fit(landmarks=landmarks, evidence=evidence)
    assert track.valid.all()
    error = turn_error_deg(track, talker.rotation)
    assert error[[39, 70]].max() < 1.5 * error[:30].max()


def test_a_covered_frame_lies_between_its_neighbours():
    talker = Talker(20)
    landmarks, evidence = leaning(talker, slice(12, 13), 10)
    seen, told = (talker.fit(landmarks=landmarks, evidence=given) for given in (None, evidence))
    assert turn_error_deg(seen, talker.rotation)[12] > 8
    assert turn_error_deg(told, talker.rotation)[12] < 2


def test_the_fit_recovers_within_three_frames_of_a_fast_turn():
    """The head snaps by 35 degrees in two frames, waits, and snaps back."""
    yaw = np.zeros(100)
    yaw[40:44], yaw[44:60], yaw[60:64] = (9, 18, 26, 35), 35, (26, 18, 9, 0)
    talker = Talker(100, turn=Rotation.from_euler("y", yaw[:, None], degrees=True))
    track = talker.fit()
    error = turn_error_deg(track, talker.rotation)
    still = np.r_[5:35, 68:95]
    assert error[[47, 48, 49, 67, 68, 69]].max() < max(1.0, 2 * error[still].max())
    assert track.reprojection_px[[47, 67]].max() < 1.5 * np.median(track.reprojection_px)


def test_a_face_that_leaves_the_picture_is_followed_to_its_edge(talker):
    """The landmarks of a face that walks out of the picture go on beyond its edge until it is lost."""
    frames = 90
    shift = np.zeros((frames, 1, 3), np.float32)
    shift[30:, 0, 0] = 12 * np.arange(60)
    cut = {name: getattr(talker.landmarks, name)[:frames] for name in ("time", "presence", "blendshapes")}
    leaving = replace(talker.landmarks, points=talker.landmarks.points[:frames] + shift, **cut)
    track = talker.fit(landmarks=without_face(leaving, slice(70, None)))
    assert leaving.points[69, :, 0].max() > SIZE[0]
    assert_finite(track)
    assert track.valid.tolist() == [True] * 70 + [False] * 20
    assert track.reprojection_px[60:70].mean() < 1.5 * track.reprojection_px[:30].mean()


def test_distortion_is_taken_out(talker):
    import cv2

    matrix = np.array([[FOCAL, 0, 639.5], [0, FOCAL, 359.5], [0, 0, 1]])
    points = talker.landmarks.points[:20].copy()
    points[..., :2] += (300, 120)  # towards a corner, where a lens bends most
    few = replace(
        talker.landmarks, points=points, time=talker.landmarks.time[:20], presence=np.ones(20, np.float32)
    )
    straight = talker.fit(landmarks=few)
    rays = np.concatenate([(points[..., :2] - [639.5, 359.5]) / FOCAL, np.ones((20, POINTS, 1))], axis=2)
    bent, _ = cv2.projectPoints(
        rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, np.array([-0.6, 0.05, 0, 0])
    )
    bent = np.concatenate([bent.reshape(20, POINTS, 2), points[..., 2:]], axis=2).astype(np.float32)
    lens = replace(CAMERA, distortion=(-0.6, 0.05))
    track = talker.fit(camera=lens, landmarks=replace(few, points=bent))
    np.testing.assert_allclose(track.lip_gap_mm, straight.lip_gap_mm, atol=0.04)
    np.testing.assert_allclose(track.rotation, straight.rotation, atol=1e-3)
    np.testing.assert_allclose(track.confidence, straight.confidence, atol=1e-2)


def test_no_face_at_all_is_one_clear_line(talker):
    with pytest.raises(TrackError, match=r"no face to fit.*150 frames 150 are usable") as raised:
        talker.fit(landmarks=without_face(talker.landmarks, slice(None)))
    assert "\n" not in str(raised.value)
    with pytest.raises(TrackError, match="0 are usable"):
        talker.fit(usable=np.zeros(150, bool))


def test_progress_ends_at_its_total(talker):
    seen: list[tuple[int, int]] = []
    fit_track(
        talker.landmarks,
        CAMERA,
        HEAD,
        np.ones(150, bool),
        np.zeros(150, np.int32),
        lambda done, total: seen.append((done, total)),
    )
    assert seen[-1][0] == seen[-1][1]
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_a_long_clip_is_solved_in_parts_to_the_same_end(talker, track, monkeypatch):
    monkeypatch.setattr(solver, "PART", 40)
    monkeypatch.setattr(solver, "SHARED", 12)
    seen: list[tuple[int, int]] = []
    every, one_shot = np.ones(len(track.time), bool), np.zeros(len(track.time), np.int32)
    parts = fit_track(
        talker.landmarks, CAMERA, HEAD, every, one_shot, lambda done, total: seen.append((done, total))
    )
    np.testing.assert_allclose(parts.rotation, track.rotation, atol=2e-4)
    np.testing.assert_allclose(parts.lip_gap_mm, track.lip_gap_mm, atol=0.05)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[-1][0] == seen[-1][1]


def test_repeated_pictures_break_no_stretch_and_missing_ones_do():
    time, one_shot = np.arange(60) / 30, np.zeros(60, np.int32)
    fifths = np.flatnonzero(np.arange(60) % 5 < 4)
    assert runs(fifths, one_shot, time).max() == 0
    halves = np.flatnonzero(np.arange(60) % 2 == 0)
    assert runs(halves, one_shot, time).max() == 0
    gap = np.setdiff1d(np.arange(60), [20, 21, 22, 23])
    assert runs(gap, one_shot, time).tolist() == [0] * 20 + [1] * 36
    slower = np.concatenate([time, time[-1] + np.arange(1, 20) / 10])
    assert runs(np.arange(79), np.zeros(79, np.int32), slower).max() == 0
    assert runs(halves, (np.arange(60) >= 30).astype(np.int32), time).tolist() == [0] * 15 + [1] * 15


def test_what_covers_a_face_is_no_doubt_of_the_fit(talker, track):
    """It is judged by the pictures; counted here too, refined frames had been left out for half of it."""
    covered = np.full(len(track.time), 0.6, np.float32)
    energy, x, observed, good = resume(track, talker.landmarks, CAMERA, HEAD, covered)
    again = make_track(talker.landmarks, CAMERA, HEAD, energy, observed, track.identity, x, good)
    np.testing.assert_allclose(again.confidence, track.confidence, atol=0.05)
