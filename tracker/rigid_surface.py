"""What is known of the points on a rigid upper face before they are seen from many sides: the heads there are.

Points lie near the surface of a head, whose shape is the mean head's, the identity basis, and smooth bends beyond it.
That tells their depth, and with it the focal length, far better than the tracks of a head that turns a little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator

from tracker.energy import Weights
from tracker.feature_tracks import FeatureTracks
from tracker.head import HeadModel
from tracker.modes import head_modes, movements
from tracker.track import F64

# Heads beyond the basis, and landmarks that lie elsewhere on another head.
BEND_M, BEND_LENGTH_M = 0.003, 0.04
OFF_SURFACE_M = 0.001  # of a point from its smooth surface
ALONG_SURFACE_M = 0.004  # of a point on it: landmarks slide when the head turns
KEPT = 0.999  # of the variance
SPEECH_M = 0.0019  # by which lips move about their mean in speech: l2_lip of the mean motion, docs/figures.md


@dataclass(frozen=True)
class SurfacePoints:
    """A normal distribution of Q points: mean [Q, 3] m, what R modes of unit variance move together [Q, 3, R] m, and
    the precision of each one's own departure [Q, 3, 3] 1/m^2.

    moving: [Q] m, rms distance by which each goes along with speaking lips: no skin is quite rigid.
    """

    mean: F64
    modes: F64
    precision: F64
    moving: F64

    def select(self, rows: NDArray[np.integer]) -> SurfacePoints:
        """Some of the points."""
        return SurfacePoints(self.mean[rows], self.modes[rows], self.precision[rows], self.moving[rows])


def surface_points(
    tracks: FeatureTracks, xy: F64, head: HeadModel, rigid: NDArray[np.bool_]
) -> SurfacePoints:
    """The points of the tracks, each where it lies between the landmarks on average; NaN where outside of them.

    xy: [M, L, 2] px, the head's `rigid` landmarks in the frames of the tracks.
    """
    mean, modes, normals = _landmark_surface(head, rigid)
    moving = moved_by_speech(head)[rigid, None]
    known = np.concatenate([mean, normals, moving, modes.reshape(len(mean), -1)], axis=1)
    number = tracks.observations[:, 1].astype(int)
    count = int(number.max(initial=-1)) + 1
    total, seen = np.zeros((count, known.shape[1])), np.zeros(count)
    for row, frame in enumerate(tracks.frames):
        mine = np.flatnonzero(tracks.observations[:, 0] == frame)
        if not len(mine):
            continue
        between = LinearNDInterpolator(xy[row], known)(tracks.observations[mine, 2:])
        inside = np.isfinite(between[:, 0])
        total[number[mine[inside]]] += between[inside]
        seen[number[mine[inside]]] += 1
    total /= np.where(seen > 0, seen, np.nan)[:, None]
    normal = total[:, 3:6] / np.linalg.norm(total[:, 3:6], axis=1, keepdims=True)
    outward = normal[:, :, None] * normal[:, None]
    precision = outward / OFF_SURFACE_M**2 + (np.eye(3) - outward) / ALONG_SURFACE_M**2
    return SurfacePoints(total[:, :3], total[:, 7:].reshape(count, 3, modes.shape[2]), precision, total[:, 6])


def moved_by_speech(head: HeadModel) -> F64:
    """[L] m, rms distance by which the head's landmarks go along with lips that move by SPEECH_M.

    Each of the head's movements counts as it moves the lips: brows and lids, which do not, for nothing.
    """
    embedding = head.landmark_embedding
    moves = np.tensordot(head_modes(head, Weights()).to_head, movements(head), axes=1)
    lips = (moves[:, head.regions["lips"]] ** 2).sum(2).mean(1)
    corners, share = head.faces[embedding.triangles], embedding.barycentric
    along = (np.einsum("lc,klci->kli", share, moves[:, corners]) ** 2).sum(2)
    return np.asarray(SPEECH_M * np.sqrt(lips @ along / (lips @ lips)), np.float64)


def _landmark_surface(head: HeadModel, rigid: NDArray[np.bool_]) -> tuple[F64, F64, F64]:
    """Mean [L, 3] m, modes [L, 3, R] m and normals [L, 3] of the surface at the chosen landmarks."""
    embedding = head.landmark_embedding
    corners, share = head.faces[embedding.triangles[rigid]], embedding.barycentric[rigid].astype(np.float64)
    triangle = head.template[corners].astype(np.float64)
    mean = np.einsum("lc,lci->li", share, triangle)
    normals = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    identity = np.einsum("lc,klci->kli", share, head.identity_basis[:, corners].astype(np.float64))
    identity = identity.reshape(len(identity), -1)
    apart = ((mean[:, None] - mean) ** 2).sum(-1)
    bends = BEND_M**2 * np.exp(-apart / (2 * BEND_LENGTH_M**2))
    variance, modes = np.linalg.eigh(identity.T @ identity + np.kron(bends, np.eye(3)))
    order = np.argsort(variance)[::-1]
    enough = int(np.searchsorted(np.cumsum(variance[order]), KEPT * variance.sum())) + 1
    modes = modes[:, order[:enough]] * np.sqrt(variance[order[:enough]])
    return mean, modes.reshape(len(mean), 3, enough), normals
