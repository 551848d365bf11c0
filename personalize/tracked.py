"""Another tracker's result as the run's Track: on the video's clock, and in the video's pixels.

A tracker may have seen a crop of the video, made larger or smaller, which its files do not tell. The run's own
landmarks do: one scale and one shift bring its projections onto them. Where they do not come to lie on the face,
the folder is another video's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from personalize.errors import UserError
from personalize.shots import Frames
from personalize.tracked_files import TrackedFace, read_tracked
from tracker.confidence import confidence
from tracker.fit import lip_gaps
from tracker.head import HeadModel
from tracker.track import F32, F64, Landmarks, Track

TRACKER_FPS = 25  # metrical-tracker's and VHAP's default: other videos are resampled to it before tracking
FRAMES_AT_ONCE = 64
FARTHEST = 0.15  # of the face's extent: a median distance of landmarks that no tracked face has


def read_track_of(folder: Path, head: HeadModel, frames: Frames, landmarks: Landmarks) -> Track:
    """The folder's result as a Track of the video. Raises UserError, in one line, for one that does not fit it.

    Values between the tracker's frames are interpolated. Gaze, jaw and neck stay joints of the head: the motion taken
    from the Track later is free of the neck's and the head's rotation.
    """
    face = read_tracked(folder, head)
    at = frame_times(len(face), frames.time, folder)
    on_video = _resampled(face, at, frames.time)
    shown = frames.usable & np.isfinite(landmarks.points).all((1, 2))
    good = np.flatnonzero(shown & (frames.time >= at[0] - 1e-6) & (frames.time <= at[-1] + 1e-6))
    if not len(good):
        raise UserError(
            f"{folder}: no tracked frame shows a face in this video; is it the tracking of another one?"
        )
    pixels = projected(head, on_video)
    seen = landmarks.points[:, head.landmark_embedding.landmarks, :2].astype(np.float64)
    scale, shift = placement(pixels[good], seen[good])
    error = np.linalg.norm(scale * pixels + shift - seen, axis=-1)
    extent = np.ptp(seen[good], axis=1).max(-1, keepdims=True)
    if not np.median(error[good] / extent) <= FARTHEST:  # nor is a NaN near
        raise UserError(f"{folder}: its faces do not lie on this video's; is it the tracking of another one?")
    return _track(head, on_video, frames, landmarks, good, error, extent, scale, shift)


def frame_times(count: int, time: F64, folder: Path) -> F64:
    """[count] s: the video's own frames, or the 25 a second that the trackers take of it."""
    if count == len(time):
        return time
    wanted = (time[-1] - time[0]) * TRACKER_FPS + 1
    if abs(count - wanted) > 2:
        raise UserError(
            f"{folder}: {count} tracked frames, but the video has {len(time)}, or {round(wanted)} at {TRACKER_FPS} fps;"
            " is it the tracking of another video?"
        )
    return time[0] + np.arange(count) / TRACKER_FPS


def projected(head: HeadModel, face: TrackedFace) -> F64:
    """[n, L, 2] px, the head's landmarks in the tracker's own pictures."""
    parts = []
    for start in range(0, len(face), FRAMES_AT_ONCE):
        rows = slice(start, start + FRAMES_AT_ONCE)
        posed = {"jaw": face.jaw[rows], "neck": face.neck[rows], "eyes": face.eyes[rows]}
        points = head.landmark_positions(face.identity, face.expression[rows], **posed)
        camera = points @ face.rotation[rows].transpose(0, 2, 1) + face.translation[rows, None]
        parts.append(face.focal * camera[..., :2] / camera[..., 2:] + face.principal)
    return np.concatenate(parts)


def placement(pixels: F64, seen: F64) -> tuple[float, F64]:
    """Scale and shift [2] with scale · pixels + shift = seen, both [n, L, 2]; half of the points may be wrong."""
    weight = np.ones(pixels.shape[:2])
    for _ in range(10):
        share = (weight / weight.sum())[..., None]
        middle, middle_seen = (share * pixels).sum((0, 1)), (share * seen).sum((0, 1))
        apart, apart_seen = pixels - middle, seen - middle_seen
        scale = float((share * apart * apart_seen).sum() / (share * apart**2).sum())
        error = np.linalg.norm(scale * apart - apart_seen, axis=-1)
        weight = 1 / np.maximum(error, 1e-3 + 0.1 * np.median(error))
    return scale, middle_seen - scale * middle


def _resampled(face: TrackedFace, at: F64, time: F64) -> TrackedFace:
    """The face at the video's times [T]; beyond the tracked ones it stays as it was last."""
    if len(at) == len(time) and np.array_equal(at, time):
        return face
    inside = np.clip(time, at[0], at[-1])

    def between(values: F64) -> F64:
        flat = values.reshape(len(values), -1)
        columns = [np.interp(inside, at, column) for column in flat.T]
        return np.stack(columns, axis=1).reshape(len(time), *values.shape[1:])

    turned = Slerp(at, Rotation.from_matrix(face.rotation))(inside).as_matrix()
    joints = {
        name: between(getattr(face, name)) for name in ("expression", "jaw", "neck", "eyes", "translation")
    }
    return TrackedFace(
        face.identity,
        rotation=turned,
        focal=face.focal,
        principal=face.principal,
        **joints,
    )


def _track(
    head: HeadModel,
    face: TrackedFace,
    frames: Frames,
    landmarks: Landmarks,
    good: NDArray[np.intp],
    error: F64,
    extent: F64,
    scale: float,
    shift: F64,
) -> Track:
    total, single = len(frames.time), _single
    valid = np.zeros(total, bool)
    valid[good] = True
    relative = error[good] / extent
    sure = confidence(relative, np.ones_like(relative), landmarks.presence[good], good, total)
    return Track(
        time=frames.time,
        valid=valid,
        confidence=sure,
        identity=single(face.identity),
        expression=single(face.expression),
        jaw=single(face.jaw),
        neck=single(face.neck),
        eyes=single(face.eyes),
        rotation=single(Rotation.from_matrix(face.rotation).as_rotvec()),
        translation=single(face.translation),
        focal=float(scale * face.focal),
        principal=single(scale * face.principal + shift),
        distortion=np.zeros(0, np.float32),
        size=landmarks.size,
        head=f"{head.name}@{head.sha256}",
        lip_gap_mm=lip_gaps(head, face.identity, single(face.expression), single(face.jaw)),
        reprojection_px=single(np.where(valid, np.nan_to_num(error.mean(1)), 0.0)),
    )


def _single(values: NDArray[np.floating]) -> F32:
    return np.asarray(values, np.float32)
