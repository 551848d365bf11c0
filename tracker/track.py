"""What the tracker measures: landmarks, camera and track of one clip, as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tracker.lens import Lens, never

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

STEP_S = 0.04  # from frame to frame: what smooths is told for this step, and follows at others


class TrackError(ValueError):
    """The clip cannot be tracked; the message says what is missing, in one line."""


@dataclass(frozen=True)
class Landmarks:
    """478 face landmarks per video frame.

    time: [T] s, presentation time from the first video frame.
    points: [T, 478, 3], x right and y down in pixels of the upright picture (pixel centres at integers),
        z in the same scale; NaN where there is no face.
    presence: [T], 0..1; the landmarker's own face probability, less where a crop and its mirror image are read
        apart; 0 where there is no face.
    blendshapes: [T, 52], 0..1, in the order of `blendshape_names`.
    size: (width, height) of the upright picture in pixels.
    """

    time: F64
    points: F32
    presence: F32
    blendshapes: F32
    blendshape_names: tuple[str, ...]
    size: tuple[int, int]

    def through(self, lens: Lens) -> Landmarks:
        """As a camera without distortion and zoom would see them."""
        if not lens.distortion and not len(lens.zoom):
            return self
        frames = np.arange(len(self.points))
        depth = self.points[..., 2:] / lens.times(frames)[:, None, None]
        points = np.concatenate([lens.points(self.points[..., :2], frames), depth], axis=-1)
        return replace(self, points=points.astype(np.float32))


@dataclass(frozen=True)
class Camera:
    """Pinhole camera of one clip. `focal_sd_log` is the standard deviation of log(focal).

    distortion: radial coefficients (k1, k2, k3) of OpenCV's model, empty for none.
    method: `bundle` when the clip's own motion decided, or had its say beside a lens that the camera wrote down;
    `prior` when the stated prior did; `given` by the user.
    prior: the sentence that states the prior used.
    zoom: [T, 3] of each frame, see `Lens`.
    """

    focal_px: float
    focal_sd_log: float
    principal_px: tuple[float, float]
    distortion: tuple[float, ...]
    size: tuple[int, int]
    method: str
    prior: str
    zoom: F32 = field(default_factory=never)

    @property
    def lens(self) -> Lens:
        """What takes distortion and zoom out of its pictures."""
        return Lens(self.focal_px, self.principal_px, self.distortion, self.zoom)


@dataclass(frozen=True)
class Bundle:
    """Rigid evidence of the feature tracks on the upper face.

    frame: [M] i4, frames that have a pose. rotation: [M, 3] axis-angle, rad, and translation: [M, 3] m take
    `points` to the camera frame (OpenCV axes). points: [Q, 3] m. observations: [O, 4] (frame, point, x px, y px),
    distortion and zoom taken out.
    """

    frame: NDArray[np.int32]
    rotation: F32
    translation: F32
    points: F32
    observations: F32


@dataclass(frozen=True)
class Track:
    """The fitted face of one clip. Head frame: x to the subject's left, y up, z out of the face, metres.

    X_camera = R(rotation) X_head + translation, camera frame OpenCV (x right, y down, z forward).
    time: [T] s. valid: [T] bool. confidence: [T] 0..1. identity: [Ki]. expression: [T, Ke]. jaw, neck: [T, 3]
    axis-angle rad. eyes: [T, 2, 3] axis-angle rad, left then right. rotation: [T, 3] axis-angle rad. translation: [T,
    3] m. focal px. principal: [2] px. distortion: [0..3] radial coefficients, and zoom: [T, 3] or [0, 3], see
    `Lens`; both go between the pinhole and the picture. size: (width, height).
    head: `name@sha256` of the head model. lip_gap_mm: [T]. reprojection_px: [T], mean over landmarks, from where they
    lie without distortion and zoom; refined, inner lips' as the colours have them. Rows of invalid frames are finite
    and tell nothing: the nearest good pose, or another tracker's own.
    """

    time: F64
    valid: NDArray[np.bool_]
    confidence: F32
    identity: F32
    expression: F32
    jaw: F32
    neck: F32
    eyes: F32
    rotation: F32
    translation: F32
    focal: float
    principal: F32
    distortion: F32
    size: tuple[int, int]
    head: str
    lip_gap_mm: F32
    reprojection_px: F32
    zoom: F32 = field(default_factory=never)

    @property
    def lens(self) -> Lens:
        """What takes distortion and zoom out of its camera's pictures."""
        x, y = self.principal.tolist()
        return Lens(self.focal, (x, y), tuple(self.distortion.tolist()), self.zoom)
