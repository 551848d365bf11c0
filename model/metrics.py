"""The metrics (docs/method.md): how far synthesized motion is from a reference, how alive and how diverse it is.

Every metric is a pure function of vertices, or of the lip opening, in millimetres; `score` computes all of
them for one span of a person, region by region.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numba import njit
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.dataset import Sequence
from model.errors import ModelError

F32 = NDArray[np.float32]
Regions = Mapping[str, NDArray[np.int32]]

# The rims of the lids, each from corner to corner, of both eyes.
EYELIDS = tuple((f"{side}_eyelid_upper", f"{side}_eyelid_lower") for side in ("left", "right"))
INNER_LIPS = ("inner_lip_upper", "inner_lip_lower")
# Lips count as closed below this opening.
CLOSED_MM = 0.5
# A closure may come this much early or late.
CLOSURE_TOLERANCE_S = 0.06
# An opening that varies less is rounding, which correlates with nothing.
STILL_MM = 1e-4


def score(samples: F32, sequence: Sequence, checkpoint: Checkpoint) -> dict[str, float]:
    """All metrics of samples [S, N, K] m of one span against its sequence; means over samples.

    Only valid frames count. The mesh and its regions (lips, face, inner lips) are the checkpoint's. Raises
    ModelError where shapes do not fit, no frame is valid, or the checkpoint lacks a region.
    """
    if samples.ndim != 3 or len(samples) == 0 or samples.shape[1:] != sequence.coefficients.shape:
        raise ModelError(
            f"samples of shape {samples.shape} for a reference of shape {sequence.coefficients.shape}"
        )
    valid = sequence.valid
    if not valid.any():
        raise ModelError("the span has no valid frame: there is nothing to compare with")
    shot = np.cumsum(np.diff(valid.astype(int), prepend=0) == 1)[valid]
    regions = {name: _Region(checkpoint, name) for name in ("lips", "face")}
    drawn, reference = samples[:, valid], sequence.coefficients[valid]
    rows = [_score_sample(sample, reference, shot, regions, checkpoint) for sample in drawn]
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return means | {
        "div_e": diversity(regions["face"].stacked_mm(drawn)),
        "div_lip": diversity(regions["lips"].stacked_mm(drawn)),
    }


def lip_opening_mm(template: F32, basis: F32, regions: Regions, coefficients: F32) -> F32:
    """Vertical gap of the middles of the inner lips, mm, < 0 where they overlap.

    template [D, 3] m, basis [K, D, 3], coefficients [..., K] m -> [...]. ModelError without those regions.
    """
    upper, lower = _middles_mm(template, basis, regions, coefficients, INNER_LIPS)
    return upper[..., 1] - lower[..., 1]


def eyelid_opening_mm(template: F32, basis: F32, regions: Regions, coefficients: F32) -> F32:
    """Vertical gap of the middles of the lids, mm, mean of both eyes; as `lip_opening_mm`."""
    gaps = []
    for pair in EYELIDS:
        upper, lower = _middles_mm(template, basis, regions, coefficients, pair)
        gaps.append(upper[..., 1] - lower[..., 1])
    opening: F32 = np.float32(0.5) * (gaps[0] + gaps[1])
    return opening


def vertex_distance(sample: F32, reference: F32) -> F32:
    """d[n, v] = |sample[n, v] - reference[n, v]|, mm: [N, V, 3] each -> [N, V]."""
    difference = sample - reference
    distance: F32 = np.sqrt(np.einsum("nvi,nvi->nv", difference, difference))
    return distance


def l2(sample: F32, reference: F32) -> float:
    """l2_lip, l2_face: mean over frames and the region's vertices of d[n, v], mm; [N, V, 3] each."""
    return float(vertex_distance(sample, reference).mean())


def l2_paper(sample: F32, reference: F32, vertices: int) -> float:
    """l2_lip_paper: mean over frames of (sum over lip vertices of d[n, v]) / D, mm; D = `vertices`, all."""
    return float(vertex_distance(sample, reference).sum(axis=1).mean() / vertices)


def lip_max(sample: F32, reference: F32) -> float:
    """Mean over frames of max over lip vertices of d[n, v], mm; [N, V, 3] each."""
    return float(vertex_distance(sample, reference).max(axis=1).mean())


def lve(sample: F32, reference: F32) -> float:
    """Mean over frames of max over lip vertices of d[n, v]^2, mm^2; [N, V, 3] each."""
    return float((vertex_distance(sample, reference).max(axis=1) ** 2).mean())


def lip_sync(sample: F32, reference: F32) -> float:
    """Dynamic time warping of two curves of lip distance [N], [M] mm: min over paths of sum |a_i - b_j|, / M."""
    curves = (np.ascontiguousarray(curve, np.float32)[:, None, None] for curve in (sample, reference))
    return _warp(*curves) / len(reference)


def lip_dtw(sample: F32, reference: F32) -> float:
    """The same warping of lip vertices [N, V, 3], [M, V, 3] mm; local cost mean over v of |a_iv - b_jv|, mm."""
    # Coordinates first, so that the innermost loop runs over contiguous vertices.
    parts = (np.ascontiguousarray(part.transpose(0, 2, 1), np.float32) for part in (sample, reference))
    return _warp(*parts) / len(reference)


def diversity(samples: F32) -> float:
    """div_e, div_lip: mean over pairs (a, b) of samples and frames n of |x_a[n] - x_b[n]|, mm; 0 for one sample.

    [S, N, ...]; a frame's numbers are stacked into one vector before the distance is taken.
    """
    count = len(samples)
    if count < 2:
        return 0.0
    stacked = samples.reshape(count, samples.shape[1], -1)
    pairs = [(a, b) for a in range(count) for b in range(a)]
    return float(np.mean([np.linalg.norm(stacked[a] - stacked[b], axis=1).mean() for a, b in pairs]))


def lip_gap_r(sample: F32, reference: F32) -> float:
    """Pearson correlation of two lip openings [N], mm; 0 where either is constant."""
    a, b = (curve.astype(np.float64) - curve.mean(dtype=np.float64) for curve in (sample, reference))
    if min(a.std(), b.std()) < STILL_MM:
        return 0.0
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def closure(sample: F32, reference: F32, shot: NDArray[np.integer], fps: float) -> float:
    """Share of the reference's closures that the sample reaches; 1 where there are none.

    A closure is a run of frames of one shot whose opening is under CLOSED_MM; it is reached when the sample is
    under CLOSED_MM at some frame of it or at most CLOSURE_TOLERANCE_S beside it in that shot. Openings [N] mm, shot
    [N] int.
    """
    slack = int(CLOSURE_TOLERANCE_S * fps)
    closed = reference < CLOSED_MM
    edges = np.flatnonzero((closed[1:] != closed[:-1]) | (shot[1:] != shot[:-1])) + 1
    runs = zip([0, *edges], [*edges, len(closed)])
    reached = []
    for start, stop in runs:
        if closed[start]:
            near = slice(max(start - slack, 0), stop + slack)
            reached.append(bool((sample[near] < CLOSED_MM)[shot[near] == shot[start]].any()))
    return float(np.mean(reached)) if reached else 1.0


def spread(sample: F32, reference: F32) -> float:
    """sqrt(sum over coordinates of the variance over time), sample's over reference's; [N, ...] each.

    1 where the reference does not move.
    """
    sizes = [math.sqrt(float(motion.var(axis=0, dtype=np.float64).sum())) for motion in (sample, reference)]
    return _ratio(*sizes)


def velocity(sample: F32, reference: F32, shot: NDArray[np.integer]) -> float:
    """Root mean square of the change from frame to frame, sample's over reference's; [N, ...] each, shot [N] int.

    Changes across shots do not count; 1 where the reference does not move.
    """
    within = shot[1:] == shot[:-1]
    sizes = [
        math.sqrt(float((np.diff(motion, axis=0)[within].astype(np.float64) ** 2).sum()))
        for motion in (sample, reference)
    ]
    return _ratio(*sizes)


def seam(sample: F32, kept: NDArray[np.bool_], reference: F32, shot: NDArray[np.integer]) -> float:
    """How much an edit jerks where kept and new frames meet: 1 is as sharp as the person ever moves. 0 without a seam.

    The jump of velocity at frame n is |x[n+1] - 2 x[n] + x[n-1]|. A seam lies between two frames of which one is in
    `kept` [N] bool, and has the larger of the jumps at these two. The mean over seams is divided by the 99th percentile
    of the reference's jumps within its shots. sample [N, ...], reference [M, ...] in the same unit, shot [M] int.
    Infinite where the sample jumps and the reference never does.
    """
    jumps = np.pad(_velocity_jumps(sample), 1)
    seams = np.flatnonzero(kept[1:] != kept[:-1])
    if len(seams) == 0:
        return 0.0
    size = float(np.maximum(jumps[seams], jumps[seams + 1]).mean())
    own = _velocity_jumps(reference)[shot[2:] == shot[:-2]]
    usual = float(np.percentile(own, 99)) if len(own) else 0.0
    return size / usual if usual > 0 else (math.inf if size > 0 else 0.0)


def _velocity_jumps(motion: F32) -> NDArray[np.float64]:
    """[N, ...] -> [max(N - 2, 0)]: norm of the second difference about each inner frame."""
    second = np.diff(motion.reshape(len(motion), -1).astype(np.float64), n=2, axis=0)
    jumps: NDArray[np.float64] = np.linalg.norm(second, axis=1)
    return jumps


def isometry(basis: F32, vertices: NDArray[np.integer]) -> F32:
    """basis [K, D, 3] -> [K, <= K]: coefficients through it are the stacked vertices in an orthonormal frame of theirs.

    With B = Q R over these vertices the distance of two frames is |B (a - b)| = |R (a - b)|: exact, without them.
    """
    frame: F32 = np.linalg.qr(basis[:, vertices].reshape(len(basis), -1).T)[1].T
    return frame


def _score_sample(
    sample: F32,
    reference: F32,
    shot: NDArray[np.integer],
    regions: dict[str, _Region],
    checkpoint: Checkpoint,
) -> dict[str, float]:
    """One sample [N, K] m against the reference [N, K] m; every metric but the diversities."""
    lips, face = regions["lips"], regions["face"]
    own_lips, true_lips = lips.vertices_mm(sample), lips.vertices_mm(reference)
    own_face, true_face = face.stacked_mm(sample), face.stacked_mm(reference)
    mesh = (checkpoint.template, checkpoint.basis, checkpoint.regions)
    own_gap, true_gap = (lip_opening_mm(*mesh, motion) for motion in (sample, reference))
    return {
        "lip_sync": lip_sync(*(_lip_distance_mm(*mesh, motion) for motion in (sample, reference))),
        "lip_dtw": lip_dtw(own_lips, true_lips),
        "lip_max": lip_max(own_lips, true_lips),
        "l2_lip": l2(own_lips, true_lips),
        "l2_lip_paper": l2_paper(own_lips, true_lips, len(checkpoint.template)),
        "l2_face": l2(face.vertices_mm(sample), face.vertices_mm(reference)),
        "lve": lve(own_lips, true_lips),
        "lip_gap_r": lip_gap_r(own_gap, true_gap),
        "closure": closure(own_gap, true_gap, shot, checkpoint.fps),
        "spread": spread(own_face, true_face),
        "velocity": velocity(own_face, true_face, shot),
    }


class _Region:
    """Some vertices of a checkpoint's mesh, as functions of its coefficients."""

    def __init__(self, checkpoint: Checkpoint, name: str) -> None:
        index = _vertices(checkpoint.regions, name)
        self._template = checkpoint.template[index]
        self._basis = checkpoint.basis[:, index]
        self._isometry = isometry(checkpoint.basis, index)

    def vertices_mm(self, coefficients: F32) -> F32:
        """[N, K] m -> positions [N, V, 3] mm."""
        return 1000 * (self._template + np.tensordot(coefficients, self._basis, axes=1))

    def stacked_mm(self, coefficients: F32) -> F32:
        """[..., K] m -> [..., <= K] mm: the stacked vertices in an orthonormal frame of the region's own motion."""
        return 1000 * (coefficients @ self._isometry)


def _vertices(regions: Regions, name: str) -> NDArray[np.int32]:
    if name not in regions:
        raise ModelError(f"the checkpoint does not name the vertices of the region {name!r}; make it again")
    return regions[name]


def _middles_mm(
    template: F32, basis: F32, regions: Regions, coefficients: F32, names: tuple[str, str]
) -> tuple[F32, F32]:
    """Middles of two loops that run from corner to corner, [..., 3] mm each."""
    ends = []
    for name in names:
        loop = _vertices(regions, name)
        middle = loop[len(loop) // 2]
        ends.append(1000 * (template[middle] + np.tensordot(coefficients, basis[:, middle], axes=1)))
    return ends[0], ends[1]


def _lip_distance_mm(template: F32, basis: F32, regions: Regions, coefficients: F32) -> F32:
    """Distance of the middles of the inner lips, mm: what the paper's Lip-Sync compares; [..., K] -> [...]."""
    upper, lower = _middles_mm(template, basis, regions, coefficients, INNER_LIPS)
    distance: F32 = np.linalg.norm(upper - lower, axis=-1)
    return distance


def _ratio(sample: float, reference: float) -> float:
    return sample / reference if reference > 0 else 1.0


@njit(cache=True, fastmath=True)
def _warp(sample: F32, reference: F32) -> float:  # pragma: no cover
    """Cost of the best warping path between [N, C, V] and [M, C, V], local cost the mean vertex distance.

    Steps (1, 0), (0, 1), (1, 1); memory of one row.
    """
    channels, vertices = reference.shape[1], reference.shape[2]
    best = np.full(len(reference) + 1, np.inf)
    best[0] = 0.0
    squares = np.empty(vertices, np.float32)
    for i in range(len(sample)):
        diagonal = best[0]
        best[0] = np.inf
        for j in range(len(reference)):
            squares[:] = 0.0
            for c in range(channels):
                for v in range(vertices):
                    difference = sample[i, c, v] - reference[j, c, v]
                    squares[v] += difference * difference
            cost = np.float32(0.0)
            for v in range(vertices):
                cost += np.sqrt(squares[v])
            above = best[j + 1]
            best[j + 1] = cost / vertices + min(above, diagonal, best[j])
            diagonal = above
    return best[-1]
