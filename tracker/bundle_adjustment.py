"""Rigid head poses: robust absolute pose per frame, then one bundle adjustment with a shared focal and a shape prior.

The adjustment finds the most probable poses, points and focal length together: Levenberg-Marquardt, in which points
and then poses are eliminated. A point may lie off the surface (glasses) and a track may fail, so both
count by Cauchy's loss. pycolmap, which gives the absolute poses, puts pixel centres at halves; everything here takes
and gives them at integers.
"""

from __future__ import annotations

import signal
import threading
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from tracker.rigid_surface import SurfacePoints
from tracker.track import F64

LOSS_SCALE = 2.0  # standard deviations of an observation
OFF_SCALE, NO_OUTLIERS = 3.0, 1e3  # standard deviations of a point's departure from the surface
LEAST_NOISE_PX = 0.1
# Points are let go from the surface by so much (m), for so many iterations; then the noise is measured anew.
ROUNDS = ((0.01, 3), (0.01, 3), (0.004, 3), (0.0, 3), (0.0, 12))
CONVERGED = 1e-4  # of the cost
MOST_DAMPING = 100.0
LONGEST_STEP = 0.5  # of log(focal)
SEED = 0

pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value  # a rejected step is no news to a user
if threading.current_thread() is threading.main_thread():
    # What was there before it was imported: pycolmap's own handler takes an ended process for a crash, and says so.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


@dataclass(frozen=True)
class RigidScene:
    """A rigid head before a moving camera (or the other way round).

    frames: [M], numbers of the frames. rotation: [M, 3, 3] and translation: [M, 3] m: head to camera (OpenCV axes).
    points: [Q, 3] m, head frame. observations: [O, 4] (frame, point, x px, y px).
    """

    frames: NDArray[np.int32]
    rotation: F64
    translation: F64
    points: F64
    observations: F64

    def select(self, frames: NDArray[np.integer]) -> RigidScene:
        """Some of the frames, and what they see."""
        return replace(
            self,
            frames=self.frames[frames],
            rotation=self.rotation[frames],
            translation=self.translation[frames],
            observations=self.observations[np.isin(self.observations[:, 0], self.frames[frames])],
        )

    def rows(self) -> NDArray[np.int64]:
        """[O] place of each observation's frame among the frames."""
        return np.searchsorted(self.frames, self.observations[:, 0].astype(int))


def camera_model(focal: float, principal: tuple[float, float], size: tuple[int, int]) -> pycolmap.Camera:
    """pycolmap's pinhole camera; focal, principal and size (width, height) in px."""
    params = [focal, principal[0] + 0.5, principal[1] + 0.5]
    return pycolmap.Camera(model="SIMPLE_PINHOLE", width=size[0], height=size[1], params=params, camera_id=1)


def absolute_pose(xy: F64, points: F64, camera: pycolmap.Camera, max_error: float) -> tuple[F64, F64] | None:
    """Rotation [3, 3] and translation [3] of `points` [L, 3] m seen at xy [L, 2] px; None where there is none.

    max_error: px, beyond which a point counts as an outlier.
    """
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = max_error
    estimation.ransac.random_seed = SEED
    refinement = pycolmap.AbsolutePoseRefinementOptions(loss_function_scale=max_error / 4)
    found = pycolmap.estimate_and_refine_absolute_pose(xy + 0.5, points, camera, estimation, refinement)
    if found is None:
        return None
    pose = found["cam_from_world"].matrix()
    return pose[:, :3], pose[:, 3]


def adjust(
    scene: RigidScene, surface: SurfacePoints, principal: tuple[float, float], focal: float, sd_log: float
) -> tuple[RigidScene, float, float] | None:
    """The most probable scene, its focal length px and the standard deviation of its logarithm; None if it fails.

    scene: where to begin; its points are taken from the surface. focal: px, the middle of a log-normal prior of
    standard deviation sd_log; 0 holds it.
    """
    problem = _Problem(scene, surface, np.array(principal, np.float64), focal, sd_log)
    state = _State(
        log_focal=float(np.log(focal)),
        shape=np.zeros(surface.modes.shape[2]),
        departure=np.zeros_like(surface.mean),
        rotation=scene.rotation,
        translation=scene.translation,
    )
    try:
        for loose, iterations in ROUNDS:
            problem.let_go(loose, state)
            state = problem.descended(state, iterations)
        sd_log = problem.focal_sd_log(state)
    except np.linalg.LinAlgError:
        return None
    found = replace(
        scene, rotation=state.rotation, translation=problem.placed(state), points=problem.points(state)
    )
    px = float(np.exp(state.log_focal))
    whole = np.isfinite(px) and np.isfinite(found.translation).all() and np.isfinite(found.points).all()
    return (found, px, sd_log) if whole else None


@dataclass(frozen=True)
class _State:
    """shape: [R] weights of the modes. departure: [Q, 3] m, of the points. translation: [M, 3] m, its depth that for
    the prior's focal length: the two would otherwise hold each other (the head's size in the picture is well known).
    """

    log_focal: float
    shape: F64
    departure: F64
    rotation: F64
    translation: F64


@dataclass(frozen=True)
class _Linear:
    """Residuals [O, 2] and their derivatives by pose [O, 2, 6], point [O, 2, 3] and log(focal) [O, 2]; weighted."""

    residual: F64
    pose: F64
    point: F64
    focal: F64


@dataclass(frozen=True)
class _Points:
    """Points that are solved for. root: [Q, 3, 3], inverses of their blocks' Cholesky factors. half: [3Q, C], that
    times what couples them with all else; its square is what their going takes from the rest.
    """

    root: F64
    half: F64

    @classmethod
    def of(cls, blocks: F64, right: F64) -> _Points:
        """blocks: [Q, 3, 3]. right: [3Q, C]."""
        root: F64 = np.asarray(np.linalg.inv(np.linalg.cholesky(blocks)), np.float64)
        return cls(root, (root @ right.reshape(len(root), 3, -1)).reshape(right.shape))

    def solved(self, change: F64) -> F64:
        """[Q, 3], for a change [C] of all else."""
        whitened = (self.half @ change).reshape(-1, 3, 1)
        return (self.root.transpose(0, 2, 1) @ whitened)[..., 0]


class _Problem:
    """The negative logarithm of the probability, doubled, and how to go down it."""

    def __init__(
        self, scene: RigidScene, surface: SurfacePoints, principal: F64, focal: float, sd_log: float
    ) -> None:
        self._surface, self._principal, self._focal = surface, principal, focal
        self._focal_precision = sd_log**-2 if sd_log else 0.0
        self._free = slice(0 if sd_log else 1, None)  # of log(focal) and shape
        self._row, self._point = scene.rows(), scene.observations[:, 1].astype(int)
        # [O] px, as the prior's camera sees points that go along with the lips: the whole of it in either direction,
        # since neighbours go alike, and do not average out.
        self._moving = focal * surface.moving[self._point] / scene.translation[self._row, 2]
        self._seen = scene.observations[:, 2:]
        length = np.bincount(self._point)
        # The error of a track hardly changes from one frame to the next: tracks count, not observations.
        self._repeats = float((length**2).sum() / length.sum())
        ones, columns = np.ones(len(self._row)), np.arange(len(self._row))
        self._by_frame = csr_array((ones, (self._row, columns)), shape=(len(scene.frames), len(ones)))
        self._by_point = csr_array((ones, (self._point, columns)), shape=(len(scene.points), len(ones)))

    def let_go(self, loose: float, state: _State) -> None:
        """Allow points to lie `loose` m from the surface at least, and measure the noise."""
        # Let go, all points may lie off alike, and must not pass for outliers.
        self._off_scale = NO_OUTLIERS if loose else OFF_SCALE
        covariance = np.linalg.inv(self._surface.precision) + loose**2 * np.eye(3)
        self._precision = np.linalg.inv(covariance)
        noise = max(LEAST_NOISE_PX, 1.4826 * float(np.median(np.abs(self._residuals(state)[0]))))
        self._noise = np.hypot(noise, self._moving)

    def points(self, state: _State) -> F64:
        """[Q, 3] m."""
        return self._surface.mean + self._surface.modes @ state.shape + state.departure

    def placed(self, state: _State) -> F64:
        """[M, 3] m, translations for the state's focal length."""
        return state.translation * (1, 1, np.exp(state.log_focal) / self._focal)

    def descended(self, state: _State, iterations: int) -> _State:
        """The state after so many steps, none of them up."""
        damping, cost = 1e-4, self._cost(state)
        for _ in range(iterations):
            moved = self._step(state, damping)
            while not (new := self._cost(moved)) <= cost and damping < MOST_DAMPING:
                damping *= 10
                moved = self._step(state, damping)
            if not new <= cost:
                break
            gain, cost, state, damping = cost - new, new, moved, max(damping / 10, 1e-6)
            if gain < CONVERGED * cost:
                break
        return state

    def focal_sd_log(self, state: _State) -> float:
        """Standard deviation of log(focal) here; 0 where it is held."""
        return 0.0 if self._free.start else float(np.sqrt(np.linalg.inv(self._normal(state, 0.0)[0])[0, 0]))

    def _residuals(self, state: _State) -> tuple[F64, F64, F64]:
        """Residuals [O, 2] px, points turned [O, 3] and seen from the camera [O, 3], m."""
        turned = (state.rotation[self._row] @ self.points(state)[self._point][..., None])[..., 0]
        seen = turned + self.placed(state)[self._row]
        projected = np.exp(state.log_focal) * seen[:, :2] / seen[:, 2:] + self._principal
        return projected - self._seen, turned, seen

    def _off(self, state: _State) -> F64:
        """[Q] squared distance of the points from the surface, in standard deviations, of which an outlier has some."""
        return (
            np.einsum("qi,qij,qj->q", state.departure, self._precision, state.departure) / self._off_scale**2
        )

    def _cost(self, state: _State) -> float:
        residual, _, seen = self._residuals(state)
        if not (seen[:, 2] > 0).all():
            return np.inf
        data = np.log1p((residual**2).sum(1) / (LOSS_SCALE * self._noise) ** 2).sum()
        cost = LOSS_SCALE**2 / self._repeats * data + self._off_scale**2 * np.log1p(self._off(state)).sum()
        away = state.log_focal - np.log(self._focal)
        return float(cost + (state.shape**2).sum() + self._focal_precision * away**2)

    def _linear(self, state: _State) -> _Linear:
        residual, turned, seen = self._residuals(state)
        focal, depth = np.exp(state.log_focal), seen[:, 2:]
        loss = 1 + (residual**2).sum(1) / (LOSS_SCALE * self._noise) ** 2
        weight = 1 / (np.sqrt(loss * self._repeats) * self._noise)
        by_place = np.zeros((len(residual), 2, 3))
        by_place[:, 0, 0] = by_place[:, 1, 1] = focal / depth[:, 0]
        by_place[:, :, 2] = -focal * seen[:, :2] / depth**2
        by_place *= weight[:, None, None]
        moved = by_place * (1, 1, focal / self._focal)
        along = moved[:, :, 2] * state.translation[self._row, 2:]
        return _Linear(
            residual=weight[:, None] * residual,
            pose=np.concatenate([np.cross(turned[:, None], by_place), moved], axis=2),
            point=by_place @ state.rotation[self._row],
            focal=weight[:, None] * focal * seen[:, :2] / depth + along,
        )

    def _step(self, state: _State, damping: float) -> _State:
        """One step of Levenberg-Marquardt."""
        normal, slope, points, poses = self._normal(state, damping)
        common = np.zeros(len(slope))
        common[self._free] = -np.linalg.solve(normal[self._free, self._free], slope[self._free])
        change = -(poses[:, -1] + poses[:, :-1] @ common)
        turn = change.reshape(-1, 6)
        longer = float(np.clip(common[0], -LONGEST_STEP, LONGEST_STEP))
        return _State(
            log_focal=state.log_focal + longer,
            shape=state.shape + common[1:],
            departure=state.departure - points.solved(np.array([*change, *common, 1.0])),
            rotation=Rotation.from_rotvec(turn[:, :3]).as_matrix() @ state.rotation,
            translation=state.translation + turn[:, 3:],
        )

    def _normal(self, state: _State, damping: float) -> tuple[F64, F64, _Points, F64]:
        """Normal matrix [1 + R, 1 + R] and slope [1 + R] of log(focal) and shape, with points and poses solved for.

        Then what gives these back: the points, and for poses [6M, 1 + R + 1] by focal and shape, and 1.
        """
        off = 1 / (1 + self._off(state))
        precision = off[:, None, None] * self._precision
        pull = np.einsum("qij,qj->qi", precision, state.departure)
        whole, points = self._without_points(self._linear(state), precision, pull, damping)
        count = whole.shape[0] - len(state.shape) - 2
        poses: F64 = np.asarray(np.linalg.solve(whole[:count, :count], whole[:count, count:]), np.float64)
        rest = whole[count:, count:] - whole[:count, count:].T @ poses
        away = state.log_focal - np.log(self._focal)
        prior = np.array([self._focal_precision, *np.ones(len(state.shape))])
        return rest[:-1, :-1] + np.diag(prior), rest[:-1, -1] + prior * [away, *state.shape], points, poses

    def _without_points(
        self, linear: _Linear, precision: F64, pull: F64, damping: float
    ) -> tuple[F64, _Points]:
        """What observations tell of poses, log(focal) and shape, points solved for.

        Their normal matrix, in which the slope is one more column: [6M + 1 + R + 1, 6M + 1 + R + 1]. Of the block
        left of focal's and shape's rows, which mirrors the one above, nothing is to be read.
        """
        residual, pose, point, focal = linear.residual, linear.pose, linear.point, linear.focal
        modes = self._surface.modes
        m, q, r = self._by_frame.shape[0], len(modes), modes.shape[2]
        points = _summed(self._by_point, point.transpose(0, 2, 1) @ point)
        points_focal = _summed(self._by_point, np.einsum("oki,ok->oi", point, focal)).reshape(-1)
        points_slope = _summed(self._by_point, np.einsum("oki,ok->oi", point, residual))
        cells = np.zeros((m, 6, q, 3))
        cells[self._row, :, self._point] = pose.transpose(0, 2, 1) @ point
        cross = cells.reshape(6 * m, 3 * q)
        basis = modes.reshape(3 * q, r)
        points_shape = (points @ modes).reshape(3 * q, r)

        whole: F64 = np.zeros((6 * m + r + 2, 6 * m + r + 2))
        poses, common = whole[: 6 * m], whole[6 * m :, 6 * m :]
        blocks = np.zeros((m, 6, m, 6))
        own = _summed(self._by_frame, pose.transpose(0, 2, 1) @ pose)
        blocks[np.arange(m), :, np.arange(m)] = own * (1 + damping * np.eye(6))
        poses[:, : 6 * m] = blocks.reshape(6 * m, 6 * m)
        poses[:, 6 * m] = _summed(self._by_frame, np.einsum("oki,ok->oi", pose, focal)).reshape(-1)
        poses[:, 6 * m + 1 : -1] = cross @ basis
        poses[:, -1] = _summed(self._by_frame, np.einsum("oki,ok->oi", pose, residual)).reshape(-1)
        common[0, 0], common[0, -1] = (focal**2).sum(), (focal * residual).sum()
        common[0, 1:-1] = common[1:-1, 0] = points_focal @ basis
        common[1:-1, 1:-1] = basis.T @ points_shape
        common[1:-1, -1] = basis.T @ points_slope.reshape(-1)

        right = np.column_stack([cross.T, points_focal, points_shape, (points_slope + pull).reshape(-1)])
        gone = _Points.of(points * (1 + damping) + precision, right)
        # One product of a matrix with itself, which takes half of the time of another.
        return whole - gone.half.T @ gone.half, gone


def _summed(sums: csr_array, values: F64) -> F64:
    return (sums @ values.reshape(len(values), -1)).reshape(sums.shape[0], *values.shape[1:])
