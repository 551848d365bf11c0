"""Accuracy of a track against a rendered head of known geometry.

The neutrals are aligned once by a similarity (absolute size and the head frame's origin are conventions),
points correspond to their nearest there, and motion is compared about its mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kornia.geometry import axis_angle_to_rotation_matrix
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import from_numpy

from tracker.head import HeadModel
from tracker.raster import vertex_normals
from tracker.track import F64, Track

NORMAL_M = 0.01  # two points whose normals differ by a unit count as this far apart


@dataclass(frozen=True)
class GroundTruth:
    """T frames: neutral [V, 3] and displacement [T, V, 3] m, faces [F, 3], pose to the OpenCV camera, lip_gap_mm."""

    neutral: F64
    faces: NDArray[np.int32]
    displacement: F64
    rotation: F64
    translation: F64
    focal: float
    lip_gap_mm: F64

    @classmethod
    def load(cls, path: Path) -> GroundTruth:
        """Read `NAME.npz` of the shared ground truth."""
        with np.load(path, allow_pickle=False) as file:
            return cls(
                neutral=file["neutral"].astype(np.float64),
                faces=file["faces"],
                displacement=file["displacement_q"] * float(file["displacement_scale"]),
                rotation=np.diag([1.0, -1.0, -1.0]) @ file["rotation"].astype(np.float64),
                translation=file["translation"].astype(np.float64),
                focal=float(file["focal_px"]),
                lip_gap_mm=file["lip_gap_mm"].astype(np.float64),
            )


def compare(track: Track, head: HeadModel, truth: GroundTruth) -> dict[str, float]:
    """Errors by name: mm, degrees, or r for correlations; `lip_motion_truth` is how large the motion was."""
    fitted = axis_angle_to_rotation_matrix(from_numpy(track.rotation.astype(np.float64))).numpy()
    resting = np.zeros(len(head.expression_names), np.float32)
    neutral: F64 = head.vertices(track.identity, resting).astype(np.float64)
    face, lips = head.regions["face"], head.regions["lips"]
    scale, turn, shift = _align(neutral, face, track, fitted, truth)
    aligned = scale * neutral @ turn.T + shift
    surface, _ = cKDTree(truth.neutral).query(aligned[face])
    near = surface < np.quantile(surface, 0.95)  # the two heads do not end at the same rim
    partner = _partners(aligned, head.faces, truth)[lips]
    seen = np.flatnonzero(track.valid)
    moves: F64 = head.expression_basis[:, lips].astype(np.float64)
    moved = 1e3 * scale * np.tensordot(track.expression[seen], moves, axes=1) @ turn.T
    true = truth.displacement[seen][:, partner] * 1e3
    error = (moved - moved.mean(0)) - (true - true.mean(0))
    gap, true_gap = track.lip_gap_mm[seen] * scale, truth.lip_gap_mm[seen]
    closed = true_gap < 0.5
    jitter = np.diff(moved, 2, axis=0) - np.diff(true, 2, axis=0)
    return {
        "surface_mm": 1e3 * float(surface[near].mean()),
        "lip_motion_mm": float(np.linalg.norm(error, axis=-1).mean()),
        "lip_in_plane_mm": float(np.linalg.norm(error[..., :2], axis=-1).mean()),
        "lip_depth_mm": float(np.abs(error[..., 2]).mean()),
        "lip_offset_mm": float(np.linalg.norm((moved - true).mean(0), axis=-1).mean()),
        "lip_motion_truth": float(np.linalg.norm(true - true.mean(0), axis=-1).mean()),
        "opening_r": float(np.corrcoef(gap, true_gap)[0, 1]),
        "opening_rmse_mm": float(np.sqrt(np.mean((gap - true_gap) ** 2))),
        "opening_centred_mm": float((gap - true_gap).std()),
        "opening_slope": float(np.polyfit(true_gap, gap, 1)[0]),
        "closed_mm": float(np.median((gap - true_gap)[closed])) if closed.any() else float("nan"),
        "jitter_mm": float(np.linalg.norm(jitter, axis=-1).mean()),
        "rotation_deg": rotation_error(fitted[seen], truth.rotation[seen]),
    }


def _partners(aligned: F64, faces: NDArray[np.int32], truth: GroundTruth) -> NDArray[np.int64]:
    """[D] the true vertex for each of the fitted head's, near and turned alike: closed lips touch each other."""

    def features(vertices: F64, faces: NDArray[np.int32]) -> F64:
        return np.concatenate([vertices, NORMAL_M * vertex_normals(vertices, faces)], axis=1)

    return cKDTree(features(truth.neutral, truth.faces)).query(features(aligned, faces))[1]


def rotation_error(fitted: F64, true: F64) -> float:
    """Mean angle in degrees between [T, 3, 3] rotations, their constant difference removed."""
    difference = true.transpose(0, 2, 1) @ fitted
    u, _, vt = np.linalg.svd(difference.mean(0))
    rest = difference @ (u @ vt).T
    return float(np.degrees(np.arccos(np.clip((np.trace(rest, axis1=1, axis2=2) - 1) / 2, -1, 1))).mean())


def _align(
    neutral: F64, face: NDArray[np.integer], track: Track, fitted: F64, truth: GroundTruth
) -> tuple[float, F64, F64]:
    """Similarity (scale, rotation, shift) from the fitted head frame to the true one, by nearest points."""
    first = int(np.flatnonzero(track.valid)[0])
    scale = float(truth.translation[first, 2] / track.translation[first, 2] * track.focal / truth.focal)
    turn = truth.rotation[first].T @ fitted[first]
    shift = truth.rotation[first].T @ (scale * track.translation[first] - truth.translation[first])
    tree = cKDTree(truth.neutral)
    source = neutral[face]
    for _ in range(40):
        # Both ways: nearest points from one side alone let the scale collapse.
        aligned = scale * source @ turn.T + shift
        there, partner = tree.query(aligned)
        back, origin = cKDTree(aligned).query(truth.neutral)
        near, found = there < np.quantile(there, 0.8), back < np.quantile(back, 0.8)
        scale, turn, shift = similarity(
            np.concatenate([source[near], source[origin[found]]]),
            np.concatenate([truth.neutral[partner[near]], truth.neutral[found]]),
        )
    return scale, turn, shift


def similarity(source: F64, target: F64) -> tuple[float, F64, F64]:
    """Least-squares (scale, rotation [3, 3], shift [3]) with target = scale * rotation source + shift."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, size, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    turn = (u * sign) @ vt
    scale = float((size * sign).sum() / (a**2).sum())
    return scale, turn, target.mean(0) - scale * turn @ source.mean(0)
