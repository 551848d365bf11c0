"""Accuracy of a track against a head of known geometry.

The neutrals are aligned once by a similarity (absolute size and the head frame's origin are conventions): by nearest
points where the meshes differ, by their vertices where they are the same mesh. Motion is compared about its mean.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from kornia.geometry import axis_angle_to_rotation_matrix
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_propagation, minimum_filter1d
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import rankdata
from torch import from_numpy

from benchmarks.ground_truth import GroundTruth
from personalize.settings import Settings
from tracker.head import HeadModel
from tracker.raster import project, vertex_normals
from tracker.similarity import similarity
from tracker.track import F64, Track

NORMAL_M = 0.01  # two points whose normals differ by a unit count as this far apart
MIDDLE_M = 3e-4  # from the face's middle
CLOSED_MM = 0.5
AJAR_MM = CLOSED_MM + 0.3  # true lips hover about the limit, and openings may err by so much
COVERED = 0.2  # share of the lips from which a frame counts as covered
ASIDE_DEG = 45.0  # of the face's axis from the line of sight: half of the lips is hidden
NEAR_DEG = 30.0  # below, a head that was turned aside counts as turned back
FAST_DEG = 4.0  # head rotation a frame from which a turn counts as fast
RECOVERED = 1.5  # times the median error
LIDS_OPEN = 0.5  # of how far lids are usually apart: with less, irises are hidden
SIDES = ("left", "right")
STILL_M = 1e-5  # a head that moves by less stands still

Bool = NDArray[np.bool_]
Similarity = tuple[F64, F64, F64]


def compare(track: Track, head: HeadModel, truth: GroundTruth) -> dict[str, float]:
    """Errors by name: mm, degrees, frames, shares, or r for correlations; NaN where the clip cannot tell.

    Frames in which the lips are hidden, because something covers them or the head is turned aside, count for confidence
    and recovery alone; others that have no fit for recovery and as lost_pct, their share in %. left_out_pct, kept_pct:
    of those in which they are seen that have a fit and of the hidden ones, the share that is left out and used by
    default, %.
    """
    fitted = axis_angle_to_rotation_matrix(from_numpy(track.rotation.astype(np.float64))).numpy()
    bare = (truth.covered <= COVERED) & (aside_deg(truth) <= ASIDE_DEG)
    judged = track.valid & bare
    used = track.valid & (track.confidence >= Settings().min_confidence)
    resting = np.zeros(len(head.expression_names), np.float32)
    neutral = head.vertices(track.identity, resting).astype(np.float64)
    mean = head.template.astype(np.float64)
    surface, frame = surface_error(neutral, head, truth)
    errors = {"surface_mm": surface, "mean_surface_mm": surface_error(mean, head, truth)[0]}
    if truth.vertices is not None:
        errors |= face_errors(neutral, track, fitted, judged, head, truth)
    errors |= lip_errors(neutral, frame, track, judged, head, truth)
    errors |= opening_errors(openings(neutral, frame, track, head, truth), truth.lip_gap_mm, judged)
    errors |= eye_errors(neutral, frame[0], track, judged, head, truth)
    return errors | {
        "rotation_deg": rotation_error(fitted[judged], truth.rotation[judged]),
        "focal_pct": 100 * (track.focal / truth.focal - 1),
        "turn_deg": turn(truth.rotation),
        "confidence_auc": separation(track.confidence, ~bare),
        "lost_pct": 100 * float(1 - track.valid[bare].mean()),
        "left_out_pct": 100 * float(1 - used[judged].mean()),
        "kept_pct": 100 * float(used[~bare].mean()) if not bare.all() else np.nan,
    }


def surface_error(neutral: F64, head: HeadModel, truth: GroundTruth) -> tuple[float, Similarity]:
    """Mean distance of the face of a neutral [D, 3] m from the true surface, mm, after the similarity given with it."""
    face = neutral[head.regions["face"]]
    if truth.vertices is None:
        frame = _align(face, truth)
    else:
        frame = similarity(neutral[truth.vertices], truth.neutral)
    scale, turned, shift = frame
    surface = trimesh.Trimesh(truth.neutral, truth.faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point(surface, scale * face @ turned.T + shift)
    return 1e3 * float(distance.mean()), frame


def face_errors(
    neutral: F64, track: Track, fitted: F64, judged: Bool, head: HeadModel, truth: GroundTruth
) -> dict[str, float]:
    """Errors of the face's vertices, for the same mesh.

    face_rigid_mm, face_scaled_mm: neutral and motion in the head frame, after one rigid transform and one similarity a
    clip. still_mm: rms of what moves in the head frame on a clip where nothing does, still_posed_mm: in the camera
    frame. recovery_frames: after what disturbed the view, until the face in the picture is back within RECOVERED times
    the clip's median.
    """
    face, seen = truth.vertices, np.flatnonzero(judged)
    moves = head.expression_basis[:, face].astype(np.float64)
    found = neutral[face] + np.tensordot(track.expression, moves, axes=1)
    true = truth.neutral + truth.displacement
    few = seen[:: max(1, len(seen) // 25)]
    alignments = {
        name: similarity(found[few].reshape(-1, 3), true[few].reshape(-1, 3), scaled)
        for name, scaled in (("face_rigid_mm", False), ("face_scaled_mm", True))
    }
    errors = {
        name: 1e3 * float(np.linalg.norm(scale * found[seen] @ turned.T + shift - true[seen], axis=-1).mean())
        for name, (scale, turned, shift) in alignments.items()
    }
    posed = found @ fitted.transpose(0, 2, 1) + track.translation[:, None]
    true_posed = true @ truth.rotation.transpose(0, 2, 1) + truth.translation[:, None]
    offset = project(posed, track.focal, (0, 0)) - project(true_posed, truth.focal, (0, 0))
    in_picture = np.linalg.norm(offset - np.median(offset[seen], axis=0), axis=-1).mean(1)
    in_picture[~track.valid] = np.inf
    errors["recovery_frames"] = recovery_frames(in_picture, disturbed(truth))
    still = float(np.ptp(true_posed, axis=0).max()) < STILL_M
    rms = {"still_mm": _rms_about_mean(found[seen]), "still_posed_mm": _rms_about_mean(posed[seen])}
    return errors | {name: 1e3 * value if still else np.nan for name, value in rms.items()}


def lip_errors(
    neutral: F64, frame: Similarity, track: Track, judged: Bool, head: HeadModel, truth: GroundTruth
) -> dict[str, float]:
    """Errors of the lips' vertices: about the mean over time (in all, in the face's plane, in depth), and against the
    neutral; `jitter_mm` is the mean second difference of the error over frames that follow each other.
    """
    lips, seen = head.regions["lips"], np.flatnonzero(judged)
    scale, turned, shift = frame
    if truth.vertices is None:
        partner = _partners(scale * neutral @ turned.T + shift, head.faces, truth)[lips]
    else:
        partner = np.searchsorted(truth.vertices, lips)
    moves = head.expression_basis[:, lips].astype(np.float64)
    moved = 1e3 * scale * np.tensordot(track.expression[seen], moves, axes=1) @ turned.T
    true = 1e3 * truth.displacement[seen][:, partner]
    difference = moved - true
    error = difference - difference.mean(0)
    bend = np.diff(difference, 2, axis=0)[seen[2:] - seen[:-2] == 2]
    return {
        "lip_motion_mm": _mean_norm(error),
        "lip_in_plane_mm": _mean_norm(error[..., :2]),
        "lip_depth_mm": float(np.abs(error[..., 2]).mean()),
        "lip_neutral_mm": _mean_norm(difference),
        "lip_motion_truth": _mean_norm(true - true.mean(0)),
        "jitter_mm": _mean_norm(bend),
    }


def openings(neutral: F64, frame: Similarity, track: Track, head: HeadModel, truth: GroundTruth) -> F64:
    """[T] mm, how far the fitted lips are apart, measured as the true ones are; see `GroundTruth`."""
    scale, turned, _ = frame
    if truth.vertices is not None:
        return track.lip_gap_mm.astype(np.float64) * scale

    def heights(vertices: NDArray[np.integer]) -> F64:
        moved = np.tensordot(track.expression, head.expression_basis[:, vertices].astype(np.float64), axes=1)
        return 1e3 * scale * (neutral[vertices] + moved) @ turned[1]

    upper, lower = middle_of_lips(head)
    return heights(upper).min(1) - heights(lower).max(1)


def middle_of_lips(head: HeadModel) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Vertices of the upper and of the lower lip in the face's middle, from their outer rims to the mouth's inside."""
    lips = head.regions["lips"]
    middle = lips[np.abs(head.template[lips, 0]) < MIDDLE_M]
    sides = trimesh.geometry.faces_to_edges(head.faces)
    part = trimesh.graph.connected_component_labels(sides[np.isin(sides, middle).all(1)], len(head.template))
    lines = (head.regions[f"inner_lip_{lip}"] for lip in ("upper", "lower"))
    upper, lower = (middle[part[middle] == part[line[len(line) // 2]]] for line in lines)
    return upper, lower


def eye_errors(
    neutral: F64, scale: F64, track: Track, judged: Bool, head: HeadModel, truth: GroundTruth
) -> dict[str, float]:
    """RMSE about the mean of how far the lids are apart, and mean angle about the mean of where eyes look while open.

    NaN unless the truth knows both lids and eyes.
    """
    if truth.vertices is None or truth.eyes is None:
        return {"lids_mm": np.nan, "gaze_deg": np.nan}
    weights, basis, vertices = track.expression.astype(np.float64), head.expression_basis, truth.vertices

    def fitted(rim: NDArray[np.integer]) -> F64:
        return np.asarray(scale * (neutral[rim] + np.tensordot(weights, basis[:, rim], axes=1)))

    def true(rim: NDArray[np.integer]) -> F64:
        rows = np.searchsorted(vertices, rim)
        return truth.neutral[rows] + truth.displacement[:, rows]

    found, apart = (_lids_mm(places, head)[judged] for places in (fitted, true))
    open_ = apart > LIDS_OPEN * np.median(apart)
    looks = _looks_deg(track.eyes.astype(np.float64)) - _looks_deg(truth.eyes)
    off = looks[judged][open_]
    return {"lids_mm": float((found - apart).std()), "gaze_deg": _mean_norm(off - off.mean(0))}


def _lids_mm(places: Callable[[NDArray[np.integer]], F64], head: HeadModel) -> F64:
    """[T] mm, mean height of the upper lids' rims above the lower ones'. places: [T, n, 3] m, of n vertices."""
    apart = []
    for side in SIDES:
        above, below = (head.regions[f"{side}_eyelid_{lid}"] for lid in ("upper", "lower"))
        corners = np.intersect1d(above, below)
        upper, lower = (places(np.setdiff1d(rim, corners))[..., 1].mean(1) for rim in (above, below))
        apart.append(upper - lower)
    return np.asarray(1e3 * np.mean(apart, axis=0))


def _looks_deg(eyes: F64) -> F64:
    """[T, 2] degrees, how far both eyes, turned by [T, 2, 3] axis-angle rad, look to the left and up on average."""
    ahead = Rotation.from_rotvec(eyes.reshape(-1, 3)).apply((0.0, 0.0, 1.0)).reshape(eyes.shape)
    return np.degrees(np.arctan2(ahead[..., :2], ahead[..., 2:])).mean(1)


def opening_errors(gap: F64, true: F64, judged: Bool) -> dict[str, float]:
    """Lip opening [T] mm against the truth, over the judged frames [T]."""
    error = (gap - true)[judged]
    moves = float(true[judged].std()) > 0.1
    closed = true[judged] < CLOSED_MM
    return {
        "opening_r": float(np.corrcoef(gap[judged], true[judged])[0, 1]) if moves else np.nan,
        "opening_rmse_mm": float(np.sqrt(np.mean(error**2))),
        "opening_centred_mm": float(error.std()),
        "closed_mm": float(np.median(error[closed])) if closed.any() else np.nan,
        "closures": closures_reached(gap, np.where(judged, true, np.nan)),
        "false_closures": closures_invented(np.where(judged, gap, np.nan), true),
    }


def closures_reached(gap: F64, true: F64) -> float:
    """Share of the moments at which the true lips [T] mm close that have a fitted closing within one frame.

    A fitted closing serves one moment only.
    """
    moments, found = _closings(true), _closings(gap)
    if not len(moments):
        return np.nan
    near = csr_array(np.abs(moments[:, None] - found) <= 1)
    return float((maximum_bipartite_matching(near, perm_type="column") >= 0).mean())


def closures_invented(gap: F64, true: F64) -> float:
    """Share of the moments at which fitted lips [T] mm close where the true ones are open for a frame around.

    Open by AJAR_MM: a closing upon lips that are all but shut is a small error of the opening, no invention.
    """
    found = _closings(gap)
    if not len(found):
        return np.nan
    return float((minimum_filter1d(true, 3)[found] >= AJAR_MM).mean())


def _closings(gap: F64) -> NDArray[np.int64]:
    """The first frames in which the lips [T] mm are closed again; none beside NaN."""
    return np.flatnonzero((gap[1:] < CLOSED_MM) & (gap[:-1] >= CLOSED_MM)) + 1


def separation(confidence: NDArray[np.floating], covered: Bool) -> float:
    """Area under the ROC curve: how often a covered frame has less confidence than a clear one."""
    count, others = int(covered.sum()), int((~covered).sum())
    if not count or not others:
        return np.nan
    ranks = rankdata(-confidence)[covered]
    return float((ranks.sum() - count * (count + 1) / 2) / (count * others))


def aside_deg(truth: GroundTruth) -> F64:
    """[T] angle between the true face's axis and the line from the head to the camera, degrees."""
    sight = -truth.translation / np.linalg.norm(truth.translation, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip((truth.rotation[:, :, 2] * sight).sum(1), -1, 1)))


def disturbed(truth: GroundTruth) -> Bool:
    """[T] frames in which the lips are covered, the head turns fast, or is turned aside until it is turned back."""
    step = truth.rotation[1:] @ truth.rotation[:-1].transpose(0, 2, 1)
    fast = np.concatenate([[False], _angle_deg(step) > FAST_DEG])
    aside = aside_deg(truth)
    gone = binary_propagation(aside > ASIDE_DEG, mask=aside > NEAR_DEG)
    seen = fast | (truth.covered > COVERED) | gone
    return seen | binary_closing(seen, iterations=2)  # a turn's far end belongs to it


def recovery_frames(error: F64, disturbed: Bool) -> float:
    """The most frames that it takes after a disturbance [T] until the error [T] is below RECOVERED times its median.

    0: the first undisturbed frame is good. NaN without a disturbance. A clip's end counts as recovery.
    """
    ends = np.flatnonzero(disturbed[:-1] & ~disturbed[1:]) + 1
    if not len(ends):
        return np.nan
    good = np.append(error < RECOVERED * np.median(error[~disturbed]), True)
    return float(max(np.argmax(good[end:]) for end in ends))


def rotation_error(fitted: F64, true: F64) -> float:
    """Mean angle in degrees between [T, 3, 3] rotations, their constant difference removed."""
    difference = true.transpose(0, 2, 1) @ fitted
    return float(_angle_deg(difference @ _mean_rotation(difference).T).mean())


def turn(rotation: F64) -> float:
    """The largest angle in degrees of rotations [T, 3, 3] from their mean."""
    return float(_angle_deg(rotation @ _mean_rotation(rotation).T).max())


def _align(source: F64, truth: GroundTruth) -> Similarity:
    """Similarity between head frames whose axes point alike, by nearest points of source [n, 3] m and the truth.

    The farthest fifth does not count: the two heads do not end at the same rim.
    """
    spread = [np.linalg.norm(points - points.mean(0), axis=1).mean() for points in (truth.neutral, source)]
    scale, turned = np.asarray(spread[0] / spread[1]), np.eye(3)
    shift = truth.neutral.mean(0) - scale * source.mean(0)
    tree = cKDTree(truth.neutral)
    for _ in range(40):
        # Both ways: nearest points from one side alone let the scale collapse.
        aligned = scale * source @ turned.T + shift
        there, partner = tree.query(aligned)
        back, origin = cKDTree(aligned).query(truth.neutral)
        near, found = there < np.quantile(there, 0.8), back < np.quantile(back, 0.8)
        scale, turned, shift = similarity(
            np.concatenate([source[near], source[origin[found]]]),
            np.concatenate([truth.neutral[partner[near]], truth.neutral[found]]),
        )
    return scale, turned, shift


def _partners(aligned: F64, faces: NDArray[np.int32], truth: GroundTruth) -> NDArray[np.int64]:
    """[D] the true vertex for each of the fitted head's, near and turned alike: closed lips touch each other."""

    def features(vertices: F64, faces: NDArray[np.int32]) -> F64:
        return np.concatenate([vertices, NORMAL_M * vertex_normals(vertices, faces)], axis=1)

    return cKDTree(features(truth.neutral, truth.faces)).query(features(aligned, faces))[1]


def _mean_rotation(rotations: F64) -> F64:
    u, _, vt = np.linalg.svd(rotations.mean(0))
    return u @ vt


def _angle_deg(rotations: F64) -> F64:
    cosine = (np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _mean_norm(vectors: F64) -> float:
    return float(np.linalg.norm(vectors, axis=-1).mean())


def _rms_about_mean(places: F64) -> float:
    return float(np.sqrt(((places - places.mean(0)) ** 2).sum(-1).mean()))
