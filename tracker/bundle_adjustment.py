"""Rigid head poses by pycolmap: robust absolute pose per frame, then one bundle adjustment with a shared focal.

pycolmap puts pixel centres at halves; everything here takes and gives them at integers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracker.track import F64

LOSS_SCALE = 0.7  # px, Cauchy: corners on brows, or under a moving highlight, count ever less beyond it
MAX_ITERATIONS = 40
SEED = 0

pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value  # a rejected step is no news to a user


@dataclass(frozen=True)
class RigidScene:
    """A rigid head before a moving camera (or the other way round).

    frames: [M], numbers of the frames. rotation: [M, 3, 3] and translation: [M, 3] m: head to camera (OpenCV axes).
    points: [Q, 3] m, head frame. observations: [O, 4] (frame, point, x px, y px). window: [M], frames of different
    windows share no point.
    """

    frames: NDArray[np.int32]
    rotation: F64
    translation: F64
    points: F64
    observations: F64
    window: NDArray[np.int32]

    def residuals(self, focal: float, principal: tuple[float, float]) -> F64:
        """[O, 2] px, projected minus observed."""
        row = np.searchsorted(self.frames, self.observations[:, 0].astype(int))
        point = self.points[self.observations[:, 1].astype(int)]
        seen = np.einsum("oij,oj->oi", self.rotation[row], point) + self.translation[row]
        return focal * seen[:, :2] / seen[:, 2:] + principal - self.observations[:, 2:]


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
    scene: RigidScene,
    camera: pycolmap.Camera,
    refine_focal: bool,
    fixed: NDArray[np.bool_] | None = None,
) -> tuple[RigidScene, float, float] | None:
    """Bundle adjustment over poses, points and, if asked, the focal length; None where it fails.

    fixed: [Q] bool, points that stay where they are.
    Returns the adjusted scene, the focal px and the formal standard deviation of its logarithm, which counts every
    observation as independent with an error of 1 px (0 when not refined).
    """
    world = _reconstruction(scene, camera)
    config = pycolmap.BundleAdjustmentConfig()
    for frame in scene.frames:
        config.add_image(int(frame) + 1)
    held = np.zeros(len(scene.points), bool) if fixed is None else fixed
    for point in np.flatnonzero(held):
        config.add_constant_point(int(point) + 1)
    # Each window is free to move and scale as a whole: one pose holds it, damping holds its scale.
    row = np.searchsorted(scene.frames, scene.observations[:, 0].astype(int))
    free = np.unique(scene.window[row[~held[scene.observations[:, 1].astype(int)]]])
    for number in free:
        first = int(np.argmax(scene.window == number))
        config.set_constant_rig_from_world_pose(int(scene.frames[first]) + 1)
    if not refine_focal:
        config.set_constant_cam_intrinsics(1)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(_options(refine_focal), config, world)
    try:
        usable = adjuster.solve().is_solution_usable()
    except (RuntimeError, ValueError):  # its own checks of a problem it cannot take
        return None
    focal = float(world.cameras[1].params[0])
    if not usable or not 0 < focal < np.inf:
        return None
    formal = 0.0
    if refine_focal:
        covariance = pycolmap.estimate_ba_covariance(
            pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.ALL), world, adjuster
        )
        block = covariance and covariance.get_other_params_cov(world.cameras[1].params)
        if block is None:
            return None
        formal = float(np.sqrt(block[0, 0])) / focal
    poses = np.stack([world.images[int(frame) + 1].cam_from_world().matrix() for frame in scene.frames])
    points = np.stack([world.points3D[i + 1].xyz for i in range(len(scene.points))])
    adjusted = replace(scene, rotation=poses[..., :3], translation=poses[..., 3], points=points)
    return adjusted, focal, formal


def _options(refine_focal: bool) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=refine_focal,
        refine_extra_params=False,
        refine_sensor_from_rig=False,
        print_summary=False,
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.solver_options.num_threads = 1
    return options


def _reconstruction(scene: RigidScene, camera: pycolmap.Camera) -> pycolmap.Reconstruction:
    """Images are numbered by frame + 1, points by point + 1: 0 is no number in pycolmap."""
    world = pycolmap.Reconstruction()
    world.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in scene.points]
    order = np.argsort(scene.observations[:, 0], kind="stable")
    rows = scene.observations[order]
    begin = np.searchsorted(rows[:, 0], scene.frames)
    end = np.searchsorted(rows[:, 0], scene.frames, side="right")
    for i, frame in enumerate(scene.frames.tolist()):
        mine = rows[begin[i] : end[i]]
        image = pycolmap.Image(
            name=str(frame), keypoints=mine[:, 2:] + 0.5, camera_id=camera.camera_id, image_id=frame + 1
        )
        rotation = pycolmap.Rotation3d(Rotation.from_matrix(scene.rotation[i]).as_quat())
        world.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, scene.translation[i]))
        for place, point in enumerate(mine[:, 1].astype(int).tolist()):
            tracks[point].add_element(frame + 1, place)
    for point, track in zip(scene.points, tracks):
        world.add_point3D(point, track)
    return world
