"""The clip's camera: focal length from rigid feature tracks where they can tell it, else from a stated prior.

The upper face is a rigid body that turns before a camera whose focal length never changes, so all shots of a
clip are adjusted together with one focal. Its uncertainty comes from the adjustment's covariance and decides how
much the prior still counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial.transform import Rotation

from tracker.bundle_adjustment import RigidScene, absolute_pose, adjust, camera_model
from tracker.feature_tracks import FeatureTracks, Frame, track_features
from tracker.head import HeadModel, LandmarkEmbedding
from tracker.landmark_indices import LEFT_EYE_OUTER, RIGHT_EYE_OUTER, STEADY_CORNERS, UPPER_FACE
from tracker.track import F64, Bundle, Camera, Landmarks

PRIOR_FOCAL = 1.3  # of the picture's long side: phones and webcams .7-1.2, camcorders and portraits 1.2-2.5
PRIOR_SD_LOG = 0.35
FOCAL_RANGE = (0.6, 5.0)  # of the long side
SECOND_START = 1.6  # times the prior's: the adjustment must come to the same focal length from there
MIN_TURN_DEG = 8.0  # a head that turns less leaves focal length and depth undecided
OUTLIER = (
    0.08  # of the distance between the outer eye corners: farther landmarks do not count for a frame's pose
)
FEW = 20  # landmarks of the upper face: a user's sparse embedding has less, and most of them on the nose's ridge
MIN_OBSERVATIONS = 12  # of a frame in the bundle
MIN_LENGTH = 3  # observations of a point in the bundle
MAX_DEPARTURE = (
    0.005  # m, median from the mean head: 3 mm is another identity, more the noise of a still head
)


def estimate_camera(
    landmarks: Landmarks,
    frames: Callable[[], Iterable[Frame]],
    head: HeadModel,
    focal_given: float | None = None,
    usable: NDArray[np.bool_] | None = None,
    segments: NDArray[np.int32] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Camera, Bundle]:
    """The camera of one clip and the rigid evidence for it, in the frame of the mean head.

    frames: begins the clip anew: (time s, rgb [H, W, 3] u8), one for each row of the landmarks. focal_given: px,
    then nothing is estimated but poses and points.
    usable: [T] bool. segments: [T], number of the uninterrupted shot.
    """
    total = len(landmarks.time)
    usable = np.ones(total, bool) if usable is None else usable
    segments = np.zeros(total, np.int32) if segments is None else segments
    prior = _camera(landmarks.size, focal_given)
    tracks = track_features(frames(), landmarks, usable, segments, progress)
    start = _start(tracks, landmarks, head, prior)
    found = _adjust(start, prior, refine_focal=focal_given is None) if len(start.observations) else None
    if found is None:
        return prior, _bundle(start)
    scene, focal, formal = found
    camera = prior
    told = _tells_depth(scene, start)
    if focal_given is not None and not told:
        return prior, _bundle(_nothing())
    if focal_given is None and told:
        sd_log = _focal_sd_log(scene, focal, formal, prior)
        camera = _joined(prior, focal, float(np.hypot(sd_log, _start_dependence(start, prior, focal))))
    # Windows that fall back on their first poses must fit the final focal length, not the prior's.
    first = _scaled(start, camera.focal_px / prior.focal_px)
    return camera, _bundle(_final(scene, first, focal, camera))


def _adjust(scene: RigidScene, camera: Camera, refine_focal: bool) -> tuple[RigidScene, float, float] | None:
    return adjust(scene, camera_model(camera.focal_px, camera.principal_px, camera.size), refine_focal)


def _tells_depth(scene: RigidScene, start: RigidScene) -> bool:
    """Whether the head turns and most points end up near the mean head; noise takes those of a still head away."""
    _, loose = _settled(scene, start)
    return _turn_deg(scene) >= MIN_TURN_DEG and bool(loose.mean() < 0.5)


def _start_dependence(start: RigidScene, camera: Camera, focal: float) -> float:
    """How far log(focal) moves when the adjustment begins from another focal length: nothing where it is known."""
    there = replace(camera, focal_px=SECOND_START * camera.focal_px)
    again = _adjust(_scaled(start, SECOND_START), there, refine_focal=True)
    return abs(float(np.log(again[1] / focal))) if again is not None else np.inf


def _camera(size: tuple[int, int], focal_given: float | None) -> Camera:
    """The camera before any evidence from the clip."""
    long_side = max(size)
    sentence = (
        f"log-normal about {PRIOR_FOCAL} x the long side ({PRIOR_FOCAL * long_side:.0f} px), "
        f"sd {PRIOR_SD_LOG} of the logarithm, within {FOCAL_RANGE[0]}-{FOCAL_RANGE[1]} x the long side; "
        "principal point at the centre; no distortion"
    )
    return Camera(
        focal_px=float(focal_given or PRIOR_FOCAL * long_side),
        focal_sd_log=0.0 if focal_given else PRIOR_SD_LOG,
        principal_px=((size[0] - 1) / 2, (size[1] - 1) / 2),
        distortion=(),
        size=size,
        method="given" if focal_given else "prior",
        prior="none: the focal length was given" if focal_given else sentence,
    )


def _joined(prior: Camera, focal: float, sd_log: float) -> Camera:
    """Prior and bundle joined in log space, or the prior alone where the bundle tells less than it."""
    low, high = (bound * max(prior.size) for bound in FOCAL_RANGE)
    if sd_log >= PRIOR_SD_LOG or not low <= focal <= high:
        return prior
    weight, prior_weight = sd_log**-2, PRIOR_SD_LOG**-2
    log_focal = (weight * np.log(focal) + prior_weight * np.log(prior.focal_px)) / (weight + prior_weight)
    return replace(
        prior,
        focal_px=float(np.clip(np.exp(log_focal), low, high)),
        focal_sd_log=float((weight + prior_weight) ** -0.5),
        method="bundle",
    )


def _focal_sd_log(scene: RigidScene, focal: float, formal: float, camera: Camera) -> float:
    """Standard deviation of log(focal): the formal one, for errors as large and as dependent as they are.

    The error of a track hardly changes from one frame to the next, so tracks count, not observations.
    """
    noise = 1.4826 * float(np.median(np.abs(scene.residuals(focal, camera.principal_px))))
    length = np.bincount(scene.observations[:, 1].astype(int))
    return formal * noise * float(np.sqrt((length**2).sum() / length.sum()))


def _turn_deg(scene: RigidScene) -> float:
    """How far the direction from the head to the camera turns within a window, 5 % of the frames left out."""
    towards = -np.einsum("mji,mj->mi", scene.rotation, scene.translation)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    turns = [0.0]
    for number in np.unique(scene.window):
        mine = towards[scene.window == number]
        middle = mine.mean(0) / np.linalg.norm(mine.mean(0))
        turns.append(2 * float(np.quantile(np.arccos(np.clip(mine @ middle, -1, 1)), 0.95)))
    return float(np.degrees(max(turns)))


def _start(tracks: FeatureTracks, landmarks: Landmarks, head: HeadModel, camera: Camera) -> RigidScene:
    """Poses from the mean head's landmarks, and points where the tracks begin on its surface."""
    embedding = head.landmark_embedding
    rigid = rigid_landmarks(embedding)
    mean = np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_basis))
    surface = head.landmark_positions(*mean)[rigid].astype(np.float64)
    xy = landmarks.points[tracks.frames][:, embedding.landmarks[rigid], :2].astype(np.float64)
    eyes = landmarks.points[tracks.frames][:, [RIGHT_EYE_OUTER, LEFT_EYE_OUTER], :2]
    errors = OUTLIER * np.linalg.norm(eyes[:, 0] - eyes[:, 1], axis=1)
    model = camera_model(camera.focal_px, camera.principal_px, camera.size)
    poses = [absolute_pose(seen, surface, model, float(error)) for seen, error in zip(xy, errors)]
    good = np.array([pose is not None for pose in poses], bool)
    known = [pose for pose in poses if pose is not None]
    scene = RigidScene(
        frames=tracks.frames[good],
        rotation=np.array([rotation for rotation, _ in known]).reshape(-1, 3, 3),
        translation=np.array([translation for _, translation in known]).reshape(-1, 3),
        points=_points(tracks, xy, surface),
        observations=tracks.observations.astype(np.float64),
        window=tracks.window[good],
    )
    return _pruned(scene)


def rigid_landmarks(embedding: LandmarkEmbedding) -> NDArray[np.bool_]:
    """[L] which of a head's landmarks lie on the rigid upper face; with few of those, corners of eyes and nose too."""
    upper = np.isin(embedding.landmarks, UPPER_FACE)
    return upper if upper.sum() > FEW else upper | np.isin(embedding.landmarks, STEADY_CORNERS)


def _points(tracks: FeatureTracks, xy: F64, surface: F64) -> F64:
    """[Q, 3] m, NaN off the surface: each track's first place on the mean head, between its landmarks.

    xy: [M, L, 2] px and surface: [L, 3] m, the same landmarks in the picture and on the head.
    """
    numbers, first = np.unique(tracks.observations[:, 1].astype(int), return_index=True)
    points = np.full((len(numbers), 3), np.nan)
    begun = tracks.observations[first]
    for row, frame in enumerate(tracks.frames):
        mine = begun[:, 0] == frame
        if mine.any():
            points[mine] = LinearNDInterpolator(xy[row], surface)(begun[mine, 2:])
    return points


def _pruned(scene: RigidScene) -> RigidScene:
    """Without frames and points that see, or are seen, too little; with none left, the poses alone stay."""
    rows = scene.observations[np.isfinite(scene.points[scene.observations[:, 1].astype(int)]).all(1)]
    rows = rows[np.isin(rows[:, 0], scene.frames)]
    while len(rows):
        frame, point = rows[:, 0].astype(int), rows[:, 1].astype(int)
        keep = (np.bincount(frame)[frame] >= MIN_OBSERVATIONS) & (np.bincount(point)[point] >= MIN_LENGTH)
        if keep.all():
            break
        rows = rows[keep]
    if not len(rows):
        return replace(scene, points=np.zeros((0, 3)), observations=np.zeros((0, 4)))
    seen = np.isin(scene.frames, rows[:, 0])
    kept, number = np.unique(rows[:, 1].astype(int), return_inverse=True)
    return replace(
        scene,
        frames=scene.frames[seen],
        rotation=scene.rotation[seen],
        translation=scene.translation[seen],
        window=scene.window[seen],
        points=scene.points[kept],
        observations=np.column_stack([rows[:, 0], number, rows[:, 2:]]),
    )


def _nothing() -> RigidScene:
    frames, no_points = np.zeros(0, np.int32), np.zeros((0, 3))
    return RigidScene(frames, np.zeros((0, 3, 3)), no_points, no_points, np.zeros((0, 4)), frames)


def _scaled(scene: RigidScene, factor: float) -> RigidScene:
    """The scene for a focal longer by `factor`: as far again from the camera."""
    return replace(scene, translation=scene.translation * (1, 1, factor))


def _final(scene: RigidScene, start: RigidScene, focal: float, camera: Camera) -> RigidScene:
    """The scene, adjusted with a free focal, once more under the final camera and in the mean head's frame.

    Where a window's head is too still to tell its shape, the points stay on the mean head.
    """
    settled, loose = _settled(_scaled(scene, camera.focal_px / focal), start)
    model = camera_model(camera.focal_px, camera.principal_px, camera.size)
    found = adjust(settled, model, refine_focal=False, fixed=loose)
    return _settled(found[0], start)[0] if found is not None else settled


def _settled(scene: RigidScene, start: RigidScene) -> tuple[RigidScene, NDArray[np.bool_]]:
    """Each window moved, turned and scaled as a whole onto its points as they began, on the mean head.

    A window whose points then lie far from where they began gets these back, with its first poses; [Q] says
    which points these are.
    """
    rotation, translation, points = scene.rotation.copy(), scene.translation.copy(), scene.points.copy()
    row = np.searchsorted(scene.frames, scene.observations[:, 0].astype(int))
    window_of = np.zeros(len(points), np.int64)
    window_of[scene.observations[:, 1].astype(int)] = scene.window[row]
    loose = np.zeros(len(points), bool)
    for number in np.unique(scene.window):
        mine, poses = window_of == number, scene.window == number
        turn, scale, shift = _similarity(scene.points[mine], start.points[mine])
        moved = scale * scene.points[mine] @ turn.T + shift
        if np.median(np.linalg.norm(moved - start.points[mine], axis=1)) > MAX_DEPARTURE:
            loose |= mine
            points[mine] = start.points[mine]
            rotation[poses], translation[poses] = start.rotation[poses], start.translation[poses]
            continue
        points[mine] = moved
        rotation[poses] = scene.rotation[poses] @ turn.T
        translation[poses] = scale * scene.translation[poses] - rotation[poses] @ shift
    return replace(scene, rotation=rotation, translation=translation, points=points), loose


def _bundle(scene: RigidScene) -> Bundle:
    return Bundle(
        frame=scene.frames.astype(np.int32),
        rotation=Rotation.from_matrix(scene.rotation).as_rotvec().astype(np.float32).reshape(-1, 3),
        translation=scene.translation.astype(np.float32),
        points=scene.points.astype(np.float32),
        observations=scene.observations.astype(np.float32),
    )


def _similarity(source: F64, target: F64) -> tuple[F64, float, F64]:
    """Rotation, scale and shift that take most of source [n, 3] closest to target [n, 3].

    Least squares over the points that are not far off: the depth of short tracks can be anything.
    """
    near = np.ones(len(source), bool)
    for _ in range(5):
        centre, goal = source[near].mean(0), target[near].mean(0)
        a, b = source[near] - centre, target[near] - goal
        u, size, vt = np.linalg.svd(b.T @ a)
        sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
        turn = (u * sign) @ vt
        scale = float((size * sign).sum() / (a**2).sum())
        shift = goal - scale * turn @ centre
        departure = np.linalg.norm(scale * source @ turn.T + shift - target, axis=1)
        near = departure <= 2.5 * np.median(departure)
    return turn, scale, shift
