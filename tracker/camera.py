"""The clip's camera: focal length from rigid feature tracks where they can tell it, else from a stated prior.

The upper face is a rigid body that turns before a camera whose focal length never changes, so all shots of a
clip are adjusted together with one focal, under priors on it and on the shape of heads. What uncertainty is then left
decides whether the clip has told the focal length. Of a long clip some frames tell the points, and these the poses of
the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracker.bundle_adjustment import RigidScene, absolute_pose, adjust, camera_model
from tracker.feature_tracks import FeatureTracks, turned_as_usual, turning
from tracker.head import HeadModel
from tracker.key_frames import farthest
from tracker.landmark_indices import LEFT_EYE_OUTER, RIGHT_EYE_OUTER, of_rigid_face
from tracker.rigid_surface import SurfacePoints, surface_points
from tracker.similarity import similarity
from tracker.track import F64, Bundle, Camera, Landmarks, TrackError
from tracker.zoom import zoom_of_frames

PRIOR_FOCAL = 1.3  # of the picture's long side: phones and webcams .7-1.2, camcorders and portraits 1.2-2.5
PRIOR_SD_LOG = 0.35
# Where the camera wrote down its lens. Films show the middle of what the lens does, to be steadied: 1.09 and 1.11 times
# the focal length on two telephones as they report it, 1.22 on one that was measured.
FILM_MM = 36.0
MIDDLE, MIDDLE_SD_LOG = 1.1, 0.12
FOCAL_RANGE = (0.45, 5.0)  # of the long side
LEAST_SD_LOG = 0.08  # of log(focal): what light and skin that moves do to all tracks alike
# Of PRIOR_SD_LOG: a clip that leaves more of it has told nothing. Beside a lens that was written down it has its say
# whatever it leaves.
TOLD = 0.8
MIN_TURN_DEG = 8.0  # a head that turns less leaves focal length and depth undecided
# Of the distance between the outer eye corners: farther landmarks, and points that were followed, do not count for a
# frame's pose.
OUTLIER, TRACK_OUTLIER = 0.08, 0.02
MIN_OBSERVATIONS = 12  # of a frame in the bundle
MIN_LENGTH = 3  # observations of a point in the bundle
ADJUSTED, MOST_POINTS = 250, 600  # frames and points adjusted together: the time grows by their squares


def estimate_camera(
    landmarks: Landmarks,
    features: FeatureTracks,
    head: HeadModel,
    seen: NDArray[np.bool_],
    segment: NDArray[np.int32],
    focal_given: float | None = None,
    distortion: tuple[float, ...] = (),
    recorded_mm: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Camera, Bundle]:
    """The camera of one clip and the rigid evidence for it, in the frame of the mean head.

    features: what was followed through the frames of the landmarks. seen: [T], frames that show the person. segment:
    [T], number of the uninterrupted shot. focal_given: px, of all frames; then nothing is estimated but poses and
    points. distortion: its radial coefficients, see `Lens`. recorded_mm: what the camera wrote of its focal length, on
    film 36 mm wide; 0 if nothing.
    Raises TrackError for a distortion without the focal length that it was measured with.
    """
    if distortion and not focal_given:
        raise TrackError("a lens's distortion goes with its focal length: give both")
    prior = _camera(landmarks.size, focal_given, distortion, recorded_mm)
    if not focal_given:
        prior = replace(prior, zoom=zoom_of_frames(landmarks, seen, segment, head))
    landmarks = landmarks.through(prior.lens)
    tracks = _not_aside(_straight(features, prior), landmarks)
    some = tracks.select(_telling(landmarks.points[tracks.frames]), MOST_POINTS)
    start, surface, kept = _start(some, landmarks, head, prior)
    if not len(kept):
        return prior, _bundle(start)
    found = adjust(start, surface, prior.principal_px, prior.focal_px, prior.focal_sd_log)
    camera = prior if found is None else _told(prior, *found)
    if camera.method == "prior":  # the poses must fit its focal length
        found = adjust(start, surface, prior.principal_px, prior.focal_px, 0.0)
    if found is None:
        return camera, _bundle(start.select(np.zeros(0, np.int64)))
    settled = _settled(found[0], surface)
    return camera, _bundle(_resected(settled, tracks, kept, landmarks, camera, progress))


def _telling(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """ADJUSTED rows of landmarks [M, 478, 2 or 3] px at most: half spread over time, half over how the head turns."""
    if len(points) <= ADJUSTED:
        return np.arange(len(points))
    spread = np.linspace(0, len(points) - 1, ADJUSTED // 2).round().astype(np.int64)
    return np.sort(farthest(turning(points).astype(np.float64), spread, np.arange(len(points)), ADJUSTED))


def _told(prior: Camera, scene: RigidScene, focal: float, sd_log: float) -> Camera:
    """The camera that the adjustment, in which the prior counts, found; the prior's where it learnt too little."""
    low, high = (bound * max(prior.size) for bound in FOCAL_RANGE)
    sd_log = min(float(np.hypot(sd_log, LEAST_SD_LOG)), prior.focal_sd_log)
    still = _turn_deg(scene) < MIN_TURN_DEG
    if prior.method == "given" or still or sd_log > TOLD * PRIOR_SD_LOG or not low <= focal <= high:
        return prior
    return replace(prior, focal_px=focal, focal_sd_log=sd_log, method="bundle")


def _straight(tracks: FeatureTracks, camera: Camera) -> FeatureTracks:
    """What was followed as a camera without distortion and zoom would see it."""
    seen = camera.lens.points(tracks.observations[:, 2:], tracks.observations[:, 0].astype(int))
    return replace(tracks, observations=np.concatenate([tracks.observations[:, :2], seen], axis=1))


def _not_aside(tracks: FeatureTracks, landmarks: Landmarks) -> FeatureTracks:
    """What was followed into frames in which the head is not turned much farther aside than it is usual."""
    if not len(tracks.frames):
        return tracks
    frames = tracks.frames[turned_as_usual(landmarks.points[tracks.frames])]
    return FeatureTracks(frames, tracks.observations[np.isin(tracks.observations[:, 0], frames)])


def _camera(
    size: tuple[int, int], focal_given: float | None, distortion: tuple[float, ...], recorded_mm: float
) -> Camera:
    """The camera before any evidence from the clip."""
    long_side = max(size)
    if focal_given:
        focal, sd_log, prior = float(focal_given), 0.0, "none: the focal length was given"
    else:
        if recorded_mm:
            focal, sd_log = MIDDLE * recorded_mm / FILM_MM * long_side, MIDDLE_SD_LOG
            about = f"{MIDDLE} x the {recorded_mm:.0f} mm (film: {FILM_MM:.0f} mm) that the camera wrote down"
            within = ""
        else:
            focal, sd_log, about = PRIOR_FOCAL * long_side, PRIOR_SD_LOG, f"{PRIOR_FOCAL} x the long side"
            within = f", within {FOCAL_RANGE[0]}-{FOCAL_RANGE[1]} x the long side"
        prior = (
            f"log-normal about {about} ({focal:.0f} px), sd {sd_log} of the logarithm{within}; "
            "principal point at the centre; no distortion"
        )
    return Camera(
        focal_px=focal,
        focal_sd_log=sd_log,
        principal_px=((size[0] - 1) / 2, (size[1] - 1) / 2),
        distortion=distortion,
        size=size,
        method="given" if focal_given else "prior",
        prior=prior,
    )


def _turn_deg(scene: RigidScene) -> float:
    """How far the direction from the head to the camera turns, 5 % of the frames left out."""
    towards = -np.einsum("mji,mj->mi", scene.rotation, scene.translation)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    middle = towards.mean(0) / np.linalg.norm(towards.mean(0))
    return 2 * float(np.degrees(np.quantile(np.arccos(np.clip(towards @ middle, -1, 1)), 0.95)))


def _start(
    tracks: FeatureTracks, landmarks: Landmarks, head: HeadModel, camera: Camera
) -> tuple[RigidScene, SurfacePoints, NDArray[np.int64]]:
    """Poses from the mean head's landmarks, points where the tracks run over its surface, and whose tracks these are.

    Frames and points that see, or are seen, too little are left out.
    """
    embedding = head.landmark_embedding
    rigid = of_rigid_face(embedding.landmarks)
    mean = np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_basis))
    surface = head.landmark_positions(*mean)[rigid].astype(np.float64)
    xy = landmarks.points[tracks.frames][:, embedding.landmarks[rigid], :2].astype(np.float64)
    eyes = landmarks.points[tracks.frames][:, [RIGHT_EYE_OUTER, LEFT_EYE_OUTER], :2]
    errors = OUTLIER * np.linalg.norm(eyes[:, 0] - eyes[:, 1], axis=1)
    model = camera_model(camera.focal_px, camera.principal_px, camera.size)
    poses = [absolute_pose(seen, surface, model, float(error)) for seen, error in zip(xy, errors)]
    good = np.array([pose is not None for pose in poses], bool)
    known = [pose for pose in poses if pose is not None]
    points = surface_points(tracks, xy, head, rigid)
    scene = RigidScene(
        frames=tracks.frames[good],
        rotation=np.array([rotation for rotation, _ in known]).reshape(-1, 3, 3),
        translation=np.array([translation for _, translation in known]).reshape(-1, 3),
        points=points.mean,
        observations=tracks.observations.astype(np.float64),
    )
    pruned, kept = _pruned(scene)
    return pruned, points.select(kept), kept


def _pruned(scene: RigidScene) -> tuple[RigidScene, NDArray[np.int64]]:
    """Without frames and points that see, or are seen, too little, and which points are left."""
    rows = scene.observations[np.isfinite(scene.points[scene.observations[:, 1].astype(int)]).all(1)]
    rows = rows[np.isin(rows[:, 0], scene.frames)]
    while len(rows):
        frame, point = rows[:, 0].astype(int), rows[:, 1].astype(int)
        keep = (np.bincount(frame)[frame] >= MIN_OBSERVATIONS) & (np.bincount(point)[point] >= MIN_LENGTH)
        if keep.all():
            break
        rows = rows[keep]
    kept, number = np.unique(rows[:, 1].astype(int), return_inverse=True)
    left = scene.select(np.flatnonzero(np.isin(scene.frames, rows[:, 0])))
    return replace(
        left, points=scene.points[kept], observations=np.column_stack([rows[:, 0], number, rows[:, 2:]])
    ), kept


def _resected(
    scene: RigidScene,
    tracks: FeatureTracks,
    kept: NDArray[np.int64],
    landmarks: Landmarks,
    camera: Camera,
    progress: Callable[[int, int], None] | None,
) -> RigidScene:
    """The scene with the frames that were followed but not adjusted, each where its points put it.

    kept: [Q], numbers of the tracks that are the scene's points.
    """
    model = camera_model(camera.focal_px, camera.principal_px, camera.size)
    frames, poses, seen = [], [], []
    known = tracks.observations[np.isin(tracks.observations[:, 1], kept)].astype(np.float64)
    known[:, 1] = np.searchsorted(kept, known[:, 1])
    left_over = np.setdiff1d(tracks.frames, scene.frames).tolist()
    for count, frame in enumerate(left_over, 1):
        if progress is not None:
            progress(count, len(left_over))
        first, last = np.searchsorted(known[:, 0], (frame, frame + 1))
        rows = known[first:last]
        right, left = landmarks.points[frame, [RIGHT_EYE_OUTER, LEFT_EYE_OUTER], :2]
        error = TRACK_OUTLIER * float(np.linalg.norm(left - right))
        if len(rows) < MIN_OBSERVATIONS:
            continue
        pose = absolute_pose(rows[:, 2:], scene.points[rows[:, 1].astype(int)], model, error)
        if pose is not None:
            frames.append(frame)
            poses.append(pose)
            seen.append(rows)
    if not frames:
        return scene
    order = np.argsort(np.concatenate([scene.frames, frames]))
    return replace(
        scene,
        frames=np.concatenate([scene.frames, np.array(frames, np.int32)])[order],
        rotation=np.concatenate([scene.rotation, [rotation for rotation, _ in poses]])[order],
        translation=np.concatenate([scene.translation, [translation for _, translation in poses]])[order],
        observations=np.concatenate([scene.observations, *seen]),
    )


def _settled(scene: RigidScene, surface: SurfacePoints) -> RigidScene:
    """The whole moved, turned and scaled onto the mean head, where its shape leaves it loose."""
    turn, scale, shift = _similarity(scene.points, surface.mean)
    rotation = scene.rotation @ turn.T
    return replace(
        scene,
        points=scale * scene.points @ turn.T + shift,
        rotation=rotation,
        translation=scale * scene.translation - rotation @ shift,
    )


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
        scale, turn, shift = similarity(source[near], target[near])
        departure = np.linalg.norm(scale * source @ turn.T + shift - target, axis=1)
        near = departure <= 2.5 * np.median(departure)
    return turn, float(scale), shift
