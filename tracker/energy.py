"""The landmark energy of one face: what it measures, how it is weighted, and its analytic derivatives.

A frame's unknowns are one row x = [weights of the modes (K), rotation (3), translation (3)]: the rotation
is the axis-angle r (rad) of exp(r) against a head that faces the camera upright, the translation (m) that
of the centre of the model's landmarks, so that both stay small and hardly coupled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import kornia.geometry as kg
import numpy as np
import torch
from numpy.typing import NDArray

from tracker.jacobian import fill_rows
from tracker.landmark_indices import of_rigid_face
from tracker.modes import Modes, head_modes, movements
from tracker.track import F64

if TYPE_CHECKING:
    from tracker.head import HeadModel

FACING = np.diag([1.0, -1.0, -1.0])  # head axes (y up, z out of the face) to camera axes (y down, z forward)
POSE = 6  # rotation and translation
TOGETHER = 1000  # frames, to bound memory

# Upper and lower inner lip and eyelids, point above point: their distance is the opening.
LIP_PAIRS = (
    *((191, 95), (80, 88), (81, 178), (82, 87), (13, 14)),
    *((312, 317), (311, 402), (310, 318), (415, 324)),
)
LID_PAIRS = (
    *((246, 7), (161, 163), (160, 144), (159, 145), (158, 153), (157, 154), (173, 155)),
    *((466, 249), (388, 390), (387, 373), (386, 374), (385, 380), (384, 381), (398, 382)),
)
IRISES = range(468, 478)  # they turn with the eyes: gaze reads them, the fit of the face does not
# These slide along the face's outline as it turns: no point of the skin.
SLIDING = frozenset((93, 132, 234, 323, 361, 454, 127, 356, 162, 389, 227, 447))


@dataclass(frozen=True)
class Weights:
    """How much each part of the energy counts; lengths in mm on the face."""

    noise_mm: float = 1.0
    """Standard deviation of one landmark, embedding bias included."""
    pair_noise_mm: float = 0.4
    """Standard deviation of an opening between paired lip or lid landmarks, which err together."""
    pair_noise_share: float = 0.0
    """What this grows by with the opening itself: shut skin touches, but where open lips end is a matter of opinion."""
    robust: float = 6.0
    """Cauchy scale, in standard deviations: residuals beyond it count ever less."""
    evidence: float = 0.2
    """Share of the landmarks that err independently; neighbours err together."""
    identity: float = 2.0
    """Inverse variance of an identity coefficient, per key frame: a static bias repeats in every frame."""
    expression_mean: float = 0.5
    """Mean of the exponential prior on an expression weight."""
    ambiguous_mean: float = 0.02
    """The same for shapes that trade depth against pose, or that landmarks cannot see."""
    aside_mean: float = 0.1
    """The same for shapes that trade a shift to the side against pose."""
    expression_sd: float = 0.5
    """Standard deviation of the Gaussian prior on an expression weight."""
    lip_shape_sd: float = 0.6
    """The same for the profile in which the lips open, of 5 mm."""
    signed_sd: float = 1.0
    """The same for shapes in standard deviations of either sign."""
    jaw_open_sd: float = 0.2
    """Standard deviation of a jaw joint's opening, rad."""
    jaw_side_sd: float = 0.02
    """The same of its turn to the side."""
    contact_mm: float = 0.05
    """Standard deviation of how far lips, or lids, pass through each other."""
    rest: float = 30.0
    """Factor on the expression prior in frames at rest: identity, not expression, explains them."""
    acceleration: tuple[float, float, float] = (0.2, 0.005, 0.001)
    """Standard deviation of the second difference at 25 fps: weights, rotation (rad), translation (m)."""
    jerk: float = 3.0
    """Cauchy scale, in standard deviations, of a pose's second difference: a head can be turned at once."""


@dataclass(frozen=True)
class LandmarkModel:
    """The head at its L fitted landmarks, centred. landmarks: [L] of the 478. pairs: [Q, 2] into L.

    mean [L, 3], identity [Ki, L, 3], expression [K, L, 3] (the modes) and centre [3] in m, head frame;
    normals [L, 3]. touch: [Q] m, the height of a pair's upper landmark above the lower one at which skin meets skin.
    """

    landmarks: NDArray[np.int32]
    mean: F64
    identity: F64
    expression: F64
    centre: F64
    normals: F64
    pairs: NDArray[np.int64]
    touch: F64
    modes: Modes

    @property
    def expressions(self) -> int:
        """Number of modes."""
        return len(self.modes)

    @property
    def upper_face(self) -> F64:
        """[U, 3] m, the landmarks of the rigid upper face on the mean head."""
        return self.mean[of_rigid_face(self.landmarks)]

    def of_lids(self) -> NDArray[np.bool_]:
        """[K] modes that move nothing more than a lid's rim."""
        lids = np.isin(self.landmarks, np.array(LID_PAIRS))
        farthest = np.linalg.norm(self.expression, axis=2).argmax(1)
        return np.asarray(lids[farthest])

    def heights(self, points: F64) -> F64:
        """[.., Q] of each pair's upper landmark above its lower one, of points or movements [.., L, 3]."""
        upper, lower = self.pairs.T
        return points[..., upper, 1] - points[..., lower, 1]


def landmark_model(head: HeadModel, weights: Weights) -> LandmarkModel:
    """The head at the landmarks that the fit uses. Raises TrackError for named shapes without ARKit's jaw."""
    modes = head_modes(head, weights)
    embedding = head.landmark_embedding
    skip = SLIDING | set(IRISES)
    keep = np.array([index not in skip for index in embedding.landmarks.tolist()])
    corners = np.asarray(head.faces)[embedding.triangles[keep]]
    share = embedding.barycentric[keep].astype(np.float64)

    def at(field: NDArray[np.floating]) -> F64:
        return np.einsum("lc,...lcx->...lx", share, np.asarray(field, np.float64)[..., corners, :])

    mean = at(head.template)
    expression = np.tensordot(modes.to_head, at(movements(head)), axes=1)
    row = {int(index): i for i, index in enumerate(embedding.landmarks[keep])}
    pairs = [pair for pair in (*LIP_PAIRS, *LID_PAIRS) if row.keys() >= set(pair)]
    side = np.asarray(head.template, np.float64)[corners]
    normal = np.cross(side[:, 1] - side[:, 0], side[:, 2] - side[:, 0])
    model = LandmarkModel(
        landmarks=embedding.landmarks[keep].astype(np.int32),
        mean=mean - mean.mean(0),
        identity=at(head.identity_basis),
        expression=expression,
        centre=mean.mean(0),
        normals=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        pairs=np.array([(row[a], row[b]) for a, b in pairs], int).reshape(-1, 2),
        touch=np.zeros(len(pairs)),
        modes=modes,
    )
    # A head of named shapes is built to be shut, lips and lids, at rest with both blinks at 1.
    blinks = [i for i, name in enumerate(head.expression_names) if name.startswith("eyeBlink")]
    return model if head.signed else replace(model, touch=model.heights(mean + expression[blinks].sum(0)))


def rotation_matrix(rotation: F64) -> F64:
    """[n, 3, 3] head axes to camera axes from the solver's rotation [n, 3]."""
    return kg.axis_angle_to_rotation_matrix(torch.from_numpy(np.ascontiguousarray(rotation))).numpy() @ FACING


def rotation_vector(matrix: F64) -> F64:
    """The inverse of `rotation_matrix`."""
    return rotation_axis_angle(matrix @ FACING)


def rotation_axis_angle(matrix: F64) -> F64:
    """[n, 3] rad, head axes to camera axes as one rotation, from `rotation_matrix`'s result."""
    return kg.rotation_matrix_to_axis_angle(torch.from_numpy(np.ascontiguousarray(matrix))).numpy()


def left_jacobian(rotation: F64) -> F64:
    """[n, 3, 3] J with exp(r + d) = exp(J d) exp(r) to first order in d."""
    angle = np.linalg.norm(rotation, axis=-1)[:, None, None]
    tiny = angle < 1e-4
    safe = np.where(tiny, 1.0, angle)
    a = np.where(tiny, 0.5, (1 - np.cos(safe)) / safe**2)
    b = np.where(tiny, 1 / 6, (safe - np.sin(safe)) / safe**3)
    x, y, z = rotation.T
    o = np.zeros_like(x)
    skew = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(-1, 3, 3)
    return np.eye(3) + a * skew + b * (skew @ skew)


@dataclass(frozen=True)
class Quadratic:
    """Second-order model of the energy, one per frame: value [n], gradient [n, P], hessian [n, P, P]."""

    value: F64
    gradient: F64
    hessian: F64


@dataclass(frozen=True)
class Energy:
    """The energy of n frames under a fixed camera, apart from smoothness.

    observed: [n, L, 2] px. px_per_m: [n], the face's scale in the picture, which scales the landmark noise.
    visible: [n, L] 0..1. strictness: [n], factor on the expression prior.
    """

    model: LandmarkModel
    weights: Weights
    focal: float
    principal: F64
    observed: F64
    px_per_m: F64
    visible: F64
    strictness: F64

    def __len__(self) -> int:
        return len(self.observed)

    def select(self, frames: slice | Sequence[int] | NDArray[np.int64]) -> Energy:
        """The energy of some of the frames."""
        return replace(
            self,
            observed=self.observed[frames],
            px_per_m=self.px_per_m[frames],
            visible=self.visible[frames],
            strictness=self.strictness[frames],
        )

    def shape(self, identity: F64) -> F64:
        """[L, 3] m, the subject's landmarks at rest."""
        return self.model.mean + np.tensordot(identity, self.model.identity, axes=1)

    def value(self, shape: F64, x: F64) -> F64:
        """[n] the energy at x [n, P] of the subject with landmarks `shape` [L, 3] at rest."""
        residual, _ = self._residuals(self._points(shape, x)[1])
        contact = 0.5 * (self._overlap(shape, x) ** 2).sum(1)
        return self._robust(residual)[0].sum(1) + self._prior(x)[0] + contact

    def project(self, shape: F64, x: F64) -> F64:
        """[n, L, 2] px of the landmarks."""
        return self._pixels(self._points(shape, x)[1])

    def linearize(self, shape: F64, x: F64, with_identity: bool = False) -> Quadratic:
        """Gauss-Newton model at x [n, P]; with identity the unknowns are [identity (Ki), x]."""
        model, count = self.model, len(x)
        turned, camera = self._points(shape, x)
        residual, scale = self._residuals(camera)
        value, weight = self._robust(residual)
        moves = np.concatenate([model.identity, model.expression]) if with_identity else model.expression
        slope = self._projection_slope(camera)
        # Single precision from here: it halves the time of the fit, and residuals stay in double.
        jacobian = np.empty((count, len(model.mean), 2, len(moves) + POSE), np.float32)
        poses = turned, slope, rotation_matrix(x[:, -6:-3]), left_jacobian(x[:, -6:-3])
        parts = (*poses, np.ascontiguousarray(moves.transpose(1, 2, 0)))
        fill_rows(*(part.astype(np.float32) for part in parts), jacobian)
        rows = self._with_pairs(jacobian)
        rows *= (np.sqrt(weight) * scale).astype(np.float32)[..., None, None]
        rows = rows.reshape(count, -1, rows.shape[-1])
        weighted = (residual * np.sqrt(weight)[..., None]).reshape(count, -1, 1)
        gradient = (rows.transpose(0, 2, 1) @ weighted.astype(np.float32))[..., 0].astype(np.float64)
        hessian = (rows.transpose(0, 2, 1) @ rows).astype(np.float64)
        prior, slope_w, curve = self._prior(x)
        w = np.arange(-POSE - model.expressions, -POSE)
        gradient[:, w] += slope_w
        hessian[:, w, w] += curve
        overlap = self._overlap(shape, x)
        lift = model.heights(moves) * (1e3 / self.weights.contact_mm)
        gradient[:, :-POSE] += overlap @ lift.T
        hessian[:, :-POSE, :-POSE] += (lift * (overlap < 0)[:, None]) @ lift.T
        return Quadratic(value.sum(1) + prior + 0.5 * (overlap**2).sum(1), gradient, hessian)

    def _points(self, shape: F64, x: F64) -> tuple[F64, F64]:
        face = shape + np.tensordot(x[:, :-POSE], self.model.expression, axes=1)
        turned = face @ rotation_matrix(x[:, -6:-3]).transpose(0, 2, 1)
        return turned, turned + x[:, None, -3:]

    def _pixels(self, camera: F64) -> F64:
        return self.focal * camera[..., :2] / camera[..., 2:] + self.principal

    def _projection_slope(self, camera: F64) -> F64:
        """[n, L, 2, 3] px/m, derivative of the projection."""
        x, y, z = np.moveaxis(camera, -1, 0)
        o = np.zeros_like(z)
        return np.stack([1 / z, o, -x / z**2, o, 1 / z, -y / z**2], -1).reshape(*z.shape, 2, 3) * self.focal

    def _with_pairs(self, rows: NDArray[Any]) -> NDArray[Any]:
        """[n, L, ..] of landmarks, continued by the differences of the pairs: [n, L+Q, ..]."""
        upper, lower = self.model.pairs.T
        return np.concatenate([rows, rows[:, upper] - rows[:, lower]], axis=1)

    def _residuals(self, camera: F64) -> tuple[F64, F64]:
        """Residuals [n, L+Q, 2] of landmarks, then pairs, in standard deviations; their scales [n, L+Q]."""
        error = self._with_pairs(self._pixels(camera) - self.observed)
        points_mm = np.full(self.observed.shape[:2], self.weights.noise_mm)
        sd_mm = np.concatenate([points_mm, self._pair_noise_mm()], axis=1)
        scale = 1e3 / (sd_mm * self.px_per_m[:, None])
        return error * scale[..., None], scale

    def _pair_noise_mm(self) -> F64:
        """[n, Q] standard deviation of the openings observed."""
        upper, lower = self.model.pairs.T
        apart = np.linalg.norm(self.observed[:, upper] - self.observed[:, lower], axis=-1)
        opening_mm = 1e3 * np.maximum(apart / self.px_per_m[:, None] - self.model.touch, 0)
        return self.weights.pair_noise_mm + self.weights.pair_noise_share * opening_mm

    def _robust(self, residual: F64) -> tuple[F64, F64]:
        """Half the Cauchy loss and its weight, both [n, L+Q]."""
        pairs, c2 = self.model.pairs, self.weights.robust**2
        seen = np.concatenate([self.visible, self.visible[:, pairs].min(2)], axis=1) * self.weights.evidence
        square = (residual**2).sum(-1) / c2
        return 0.5 * c2 * seen * np.log1p(square), seen / (1 + square)

    def _overlap(self, shape: F64, x: F64) -> F64:
        """[n, Q] <= 0: how far the skin of each pair passes through the other's, in standard deviations."""
        model = self.model
        height = model.heights(shape) + x[:, :-POSE] @ model.heights(model.expression)
        return np.minimum(height - model.touch, 0.0) * (1e3 / self.weights.contact_mm)

    def _prior(self, x: F64) -> tuple[F64, F64, F64]:
        """Prior of the expression weights: value [n], gradient and curvature [n, K]."""
        w = x[:, :-POSE]
        rate = self.strictness[:, None] * self.model.modes.rate
        curve = self.strictness[:, None] * self.model.modes.precision
        return (rate * w + 0.5 * curve * w**2).sum(1), rate + curve * w, curve


def visibility(model: LandmarkModel, rotation: F64, translation: F64) -> F64:
    """[n, L] 0.05..1: how far each landmark's skin faces the camera; what is turned away is only guessed."""
    seen = np.empty((len(rotation), len(model.mean)))
    for start in range(0, len(seen), TOGETHER):
        rows = slice(start, start + TOGETHER)
        matrix = rotation_matrix(rotation[rows])
        points = model.mean @ matrix.transpose(0, 2, 1) + translation[rows, None]
        normals = model.normals @ matrix.transpose(0, 2, 1)
        facing = -(normals * points).sum(-1) / np.linalg.norm(points, axis=-1)
        seen[rows] = np.clip((facing + 0.1) / 0.5, 0.05, 1.0)
    return seen
