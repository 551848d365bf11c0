"""Fit the head to a clip's landmarks: one identity from key frames, then every frame, smooth in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from kornia.geometry import axis_angle_to_rotation_matrix
from numpy.typing import NDArray

from tracker.confidence import confidence
from tracker.energy import (
    LIP_PAIRS,
    POSE,
    Energy,
    LandmarkModel,
    Weights,
    landmark_model,
    rotation_axis_angle,
    rotation_matrix,
    rotation_vector,
    visibility,
)
from tracker.gaze import eye_rotations
from tracker.key_frames import FEW, KeyFrames, key_frames
from tracker.landmarker import MIN_PRESENCE
from tracker.similarity import similarity
from tracker.solver import Smoothness, solve_frames, solve_subject
from tracker.track import F32, F64, Camera, Landmarks, Track, TrackError

if TYPE_CHECKING:
    from tracker.head import HeadModel

LEAST_EVIDENCE = 0.02  # of a covered frame: enough to hold a pose where no neighbour does
LIP_BIAS = 0.001  # m
# Frames that are shut if any are (one may be a slip), and by how much shut lips differ from frame to frame, m.
SURELY_SHUT, AS_SHUT_M = 2, 0.0007
# Times the usual time between measured frames, and at least so long: what is missing does not end a run sooner.
MISSING, MISSING_S = 2.5, 0.15

Frames = NDArray[np.int64]


def fit_track(
    landmarks: Landmarks,
    camera: Camera,
    head: HeadModel,
    usable: NDArray[np.bool_],
    segment: NDArray[np.int32],
    progress: Callable[[int, int], None] | None = None,
    evidence: F32 | None = None,
) -> Track:
    """The head's identity, and expression, pose and gaze in every frame, under the given camera.

    usable: [T] bool, frames that may be measured. segment: [T], number of the uninterrupted shot;
    smoothness never crosses from one to another.
    evidence: [T] 0..1, how far each frame's landmarks are followed, less where something covers the face: below one
    half they tell nothing of the identity, unless few are above, and the frames around them tell the pose.
    Raises TrackError when no frame can be measured.
    """
    weights = Weights()
    model = landmark_model(head, weights)
    good = _measurable(landmarks, model, usable)
    straight = landmarks.through(camera.lens).points[good]
    observed = straight[..., :2].astype(np.float64)
    energy, start = _start(model, weights, camera, straight)
    share, sound = _share(evidence, good), trusted(evidence, good)
    keys = key_frames(observed[sound], energy.px_per_m[sound]).of(sound)
    energy = with_lips_shut(energy, start, keys.rest)
    identity = fit_identity(energy, start, keys)
    followed = replace(energy, visible=energy.visible * share[:, None])
    smoothness = smoothness_between(energy, landmarks.time, good, segment)
    x = solve_frames(followed, energy.shape(identity), start, smoothness, progress=progress)
    return make_track(landmarks, camera, head, energy, observed, identity, x, good)


def _share(evidence: F32 | None, good: Frames) -> F64:
    """[n] how far the landmarks of the frames `good` are followed."""
    return np.ones(len(good)) if evidence is None else np.maximum(evidence[good], LEAST_EVIDENCE)


def trusted(evidence: F32 | None, good: Frames) -> Frames:
    """Rows of the frames `good` [n] that tell something on their own, see `fit_track`; of the best if few do."""
    share = _share(evidence, good)
    few = np.sort(share)[-min(FEW, len(share))]
    return np.flatnonzero(share >= min(0.5, max(few, min(0.25, share.max() / 2))))


def _measurable(landmarks: Landmarks, model: LandmarkModel, usable: NDArray[np.bool_]) -> Frames:
    finite = np.isfinite(landmarks.points[:, model.landmarks]).all(axis=(1, 2))
    good = np.flatnonzero(usable & finite & (landmarks.presence >= MIN_PRESENCE))
    if not len(good):
        raise TrackError(
            f"no face to fit: of {len(usable)} frames {int(usable.sum())} are usable and none shows a face "
            "clearly; give a clip in which one face is seen from the front"
        )
    return good


def _start(model: LandmarkModel, weights: Weights, camera: Camera, straight: F32) -> tuple[Energy, F64]:
    """The clip's energy, and poses of the mean head by Procrustes against landmarks [n, 478, 3] with their depth."""
    seen = straight[:, model.landmarks].astype(np.float64)
    px_per_m, matrix, _ = similarity(model.mean, seen)
    centre = seen.mean(1)
    principal = np.array(camera.principal_px, np.float64)
    ray = np.concatenate([centre[:, :2] - principal, np.full((len(seen), 1), camera.focal_px)], axis=1)
    translation = ray / px_per_m[:, None]
    rotation = rotation_vector(matrix)
    x = np.concatenate([np.zeros((len(seen), model.expressions)), rotation, translation], axis=1)
    return _energy(model, weights, camera, straight[..., :2].astype(np.float64), px_per_m, x), x


def _energy(
    model: LandmarkModel, weights: Weights, camera: Camera, observed: F64, px_per_m: F64, x: F64
) -> Energy:
    """Of landmarks observed [n, 478, 2] px, seen as the poses of x [n, P] turn them."""
    return Energy(
        model=model,
        weights=weights,
        focal=camera.focal_px,
        principal=np.array(camera.principal_px, np.float64),
        observed=observed[:, model.landmarks],
        px_per_m=px_per_m,
        visible=visibility(model, x[:, -6:-3], x[:, -3:]),
        strictness=np.ones(len(x)),
    )


def with_lips_shut(energy: Energy, x: F64, rest: Frames) -> Energy:
    """The energy whose inner-lip landmarks are, on shut lips, as far apart as in the frames at rest that are most shut.

    The landmarker keeps the lips of a shut mouth apart, on each face by its own amount; what exceeds LIP_BIAS is taken
    for an open mouth. Of frames at rest many show open lips if a mouth seldom shuts: only the more shut half tells of
    it, and of that what is within AS_SHUT_M of the most shut ones. x: [n, P], of which the rotations are read.
    """
    model = energy.model
    named = model.landmarks[model.pairs]
    lips = np.isin(named, [index for pair in LIP_PAIRS for index in pair]).all(1)
    upper, lower = model.pairs[lips].T
    up = rotation_matrix(x[rest, -6:-3])[:, :2, 1] * energy.px_per_m[rest, None]
    apart = energy.observed[rest][:, upper] - energy.observed[rest][:, lower]
    height = np.einsum("nqi,ni->nq", apart, up) / (up**2).sum(1, keepdims=True)
    height -= model.touch[lips]
    narrow = height[np.argsort(height.mean(1), kind="stable")][: max(1, len(rest) // 2)]
    opening = narrow.mean(1)
    shut = narrow[opening <= opening[:SURELY_SHUT][-1] + AS_SHUT_M]
    bias = np.clip(np.median(shut, axis=0), -LIP_BIAS, LIP_BIAS)
    mean, touch = model.mean.copy(), model.touch.copy()
    mean[upper, 1] += bias / 2
    mean[lower, 1] -= bias / 2
    touch[lips] += bias
    return replace(energy, model=replace(model, mean=mean, touch=touch))


def fit_identity(energy: Energy, start: F64, keys: KeyFrames) -> F64:
    """[Ki] the subject, from the key frames at x `start` [n, P]."""
    chosen = at_ease(energy.select(keys.rows), keys)
    return solve_subject(chosen, np.zeros(len(energy.model.identity)), start[keys.rows]).identity


def at_ease(energy: Energy, keys: KeyFrames) -> Energy:
    """The energy of the key frames, whose expressions are held near zero where the face is at rest, and at ease."""
    strictness = energy.strictness.copy()
    strictness[: len(keys.rest)] *= energy.weights.rest**keys.ease
    return replace(energy, strictness=strictness)


def runs(good: Frames, segment: NDArray[np.int32], time: F64) -> NDArray[np.int64]:
    """[n] a number for each stretch of measured frames that follow each other within one shot.

    time: [T] s. Pictures that are repeated are not measured, and break nothing.
    """
    step = np.diff(time[good])
    far = step > max(MISSING * np.median(step), MISSING_S) if len(step) else np.zeros(0, bool)
    broken = far | (np.diff(segment[good]) != 0)
    return np.concatenate([[0], np.cumsum(broken)])


def smoothness_between(
    energy: Energy, time: F64, good: Frames, segment: NDArray[np.int32], factor: F64 | None = None
) -> Smoothness:
    """Smoothness of the measured frames `good` of a clip, inside its shots. time, segment: [T]. factor: [P], on it."""
    sd = np.repeat(energy.weights.acceleration, (energy.model.expressions, 3, 3))
    factor = np.ones(len(sd)) if factor is None else factor
    tolerated = float(factor[-1]) * energy.weights.jerk**2
    return Smoothness.between(runs(good, segment, time), time[good], factor / sd**2, tolerated)


def resume(
    track: Track, landmarks: Landmarks, camera: Camera, head: HeadModel, evidence: F32 | None = None
) -> tuple[Energy, F64, F64, Frames]:
    """Where a track stands, the inverse of `make_track`, for its n valid frames. evidence: see `fit_track`.

    Returns energy, unknowns x [n, P], all landmarks [n, 478, 2] px without distortion and zoom, and the frames [n].
    """
    weights = Weights()
    model = landmark_model(head, weights)
    finite = np.isfinite(landmarks.points[:, model.landmarks]).all(axis=(1, 2))
    good = np.flatnonzero(track.valid & finite)
    observed = camera.lens.points(landmarks.points[good][..., :2], good)
    turn = torch.from_numpy(track.rotation[good].astype(np.float64))
    matrix = axis_angle_to_rotation_matrix(turn).numpy()
    rotation, translation = rotation_vector(matrix), track.translation[good] + matrix @ model.centre
    moved = track.expression[good].astype(np.float64), track.jaw[good].astype(np.float64)
    x = np.concatenate([model.modes.of_head(*moved), rotation, translation], axis=1)
    energy = _energy(model, weights, camera, observed, camera.focal_px / translation[:, 2], x)
    energy = replace(energy, visible=energy.visible * _share(evidence, good)[:, None])
    if len(good):
        energy = with_lips_shut(energy, x, at_rest(observed, energy.px_per_m, trusted(evidence, good)))
    return energy, x, observed, good


def at_rest(observed: F64, px_per_m: F64, sound: Frames) -> Frames:
    """Of the rows `sound` of landmarks [n, 478, 2] px those at rest, as `key_frames` chooses them."""
    return key_frames(observed[sound], px_per_m[sound]).of(sound).rest


def make_track(
    landmarks: Landmarks,
    camera: Camera,
    head: HeadModel,
    energy: Energy,
    observed: F64,
    identity: F64,
    x: F64,
    good: Frames,
) -> Track:
    """The track of all frames; those not measured take the nearest measured frame's values."""
    total = len(landmarks.time)
    nearest = _nearest(total, good)
    matrix = rotation_matrix(x[:, -6:-3])
    weights = energy.model.modes.head_weights(x[:, :-POSE])
    expression, jaw = (part.astype(np.float32) for part in weights)
    fitted = energy.project(energy.shape(identity), x)
    error = np.linalg.norm(fitted - energy.observed, axis=-1)
    valid = np.zeros(total, bool)
    valid[good] = True
    eyes = eye_rotations(head, identity, expression, x, observed, energy)
    # By the pose alone: what covers a face is judged by the pictures.
    seen = visibility(energy.model, x[:, -6:-3], x[:, -3:])
    return Track(
        time=landmarks.time,
        valid=valid,
        confidence=confidence(error / energy.px_per_m[:, None], seen, landmarks.presence[good], good, total),
        identity=identity.astype(np.float32),
        expression=expression[nearest],
        jaw=jaw[nearest],
        neck=np.zeros((total, 3), np.float32),
        eyes=eyes.astype(np.float32)[nearest],
        rotation=rotation_axis_angle(matrix).astype(np.float32)[nearest],
        translation=(x[:, -3:] - matrix @ energy.model.centre).astype(np.float32)[nearest],
        focal=float(camera.focal_px),
        principal=np.array(camera.principal_px, np.float32),
        distortion=np.array(camera.distortion, np.float32),
        size=landmarks.size,
        head=f"{head.name}@{head.sha256}",
        lip_gap_mm=lip_gaps(head, identity, expression, jaw)[nearest],
        reprojection_px=error.mean(1).astype(np.float32)[nearest],
        zoom=camera.zoom,
    )


def _nearest(total: int, good: Frames) -> Frames:
    """[T] position in `good` of the measured frame nearest to each frame."""
    middle = (good[1:] + good[:-1]) / 2
    return np.searchsorted(middle, np.arange(total))


def lip_gaps(head: HeadModel, identity: NDArray[np.floating], expression: F32, jaw: F32) -> F32:
    """[n] mm, some hundred frames at a time to bound memory."""
    subject = np.asarray(identity, np.float32)
    parts = [
        head.lip_gap_mm(head.vertices(subject, expression[rows], jaw=jaw[rows]))
        for rows in np.array_split(np.arange(len(expression)), max(1, len(expression) // 100))
    ]
    return np.concatenate(parts).astype(np.float32)
