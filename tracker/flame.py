"""FLAME (Li et al. 2017; 2020, 2023 and 2023 Open) as a HeadModel, from the arrays of a user's own file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tracker.appearance import skin_triangles
from tracker.flame_regions import regions_of
from tracker.head import HeadModel, Joint, LandmarkEmbedding
from tracker.landmark_indices import IRIS_CENTRES, POINTS, of_rigid_face
from tracker.skinning import JAW, LEFT_EYE, NECK, RIGHT_EYE, Skeleton
from tracker.track import F32, TrackError

IDENTITIES = 300  # of the columns of shapedirs; the others are expressions
PARENTS = (-1, 0, 1, 1, 1)  # root, neck, jaw, left eye, right eye
ARRAYS = ("v_template", "f", "shapedirs", "posedirs", "J_regressor", "kintree_table", "weights")
JOINT_ROWS = {"neck": NECK, "jaw": JAW, "left_eye": LEFT_EYE, "right_eye": RIGHT_EYE}
LARGEST = 1e6  # number in the arrays: vertices are fewer, everything else is far below
CLAY = (205, 186, 174)
# Landmarks of the rigid upper face tell the head's pose: how many, and how far off any one line they lie (rms).
LEAST_RIGID, LEAST_BREADTH_M = 6, 0.005
LEAST_AREA_M2 = 1e-12  # of a face under a landmark, whose normal it tells

Arrays = Mapping[str, NDArray[np.generic]]


@dataclass(frozen=True)
class EmbeddedPoints:
    """Landmarks on FLAME's surface: [L] of the 478 points, [L] faces, [L, 3] barycentric coordinates."""

    landmarks: NDArray[np.int32]
    triangles: NDArray[np.int32]
    barycentric: F32


def flame_head(
    name: str, arrays: Arrays, points: EmbeddedPoints, masks: Mapping[str, NDArray[np.int32]]
) -> HeadModel:
    """FLAME with signed expressions and joints for neck, jaw and eyes.

    arrays: `v_template` [D, 3] m, `f` [F, 3], `shapedirs` [D, 3, 300 + Ke], `posedirs` [D, 3, 36],
    `J_regressor` [5, D], `kintree_table` [2, 5], `weights` [D, 5]. points: at least the inner lips. masks: FLAME's own
    vertex masks, empty where there are none; the regions are then told from the landmarks. Irises are added to the
    landmarks. Raises TrackError for arrays that are missing, not finite, or do not fit each other, and for landmarks
    that do not tell the head's pose.
    """
    checked = _checked(arrays)
    template, faces, weights = checked["v_template"], checked["f"].astype(np.int32), checked["weights"]
    _check_points(points, len(faces))
    shapes = np.ascontiguousarray(np.moveaxis(checked["shapedirs"], -1, 0), np.float32)
    identity, expression = shapes[:IDENTITIES], shapes[IDENTITIES:]
    regressor = checked["J_regressor"]
    skeleton = Skeleton(
        parents=np.array(PARENTS, np.int32),
        joints=(regressor @ template).astype(np.float32),
        identity_basis=np.einsum("jd,kdx->kjx", regressor, identity).astype(np.float32),
        expression_basis=np.einsum("jd,kdx->kjx", regressor, expression).astype(np.float32),
        weights=weights.astype(np.float32),
        pose_basis=np.ascontiguousarray(np.moveaxis(checked["posedirs"], -1, 0), np.float32),
    )
    digest = hashlib.sha256()
    for key in ARRAYS:
        digest.update(np.ascontiguousarray(checked[key]).tobytes())
    embedding = _embedding(points, skeleton, template, faces, digest.hexdigest())
    _check_rigid(embedding, template, faces)
    _check_area(points, template, faces)
    flipped = template * np.array([-1, 1, 1])
    head = HeadModel(
        name=name,
        sha256=digest.hexdigest(),
        template=template.astype(np.float32),
        faces=faces,
        mirror=cKDTree(template).query(flipped)[1].astype(np.int32),
        identity_basis=identity,
        expression_basis=expression,
        expression_names=tuple(f"expression{k + 1:03d}" for k in range(len(expression))),
        joints={key: _joint(skeleton, row) for key, row in JOINT_ROWS.items()},
        regions=regions_of(template, skeleton, faces, embedding, masks),
        albedo=np.tile(np.asarray(CLAY, np.uint8), (len(template), 1)),
        landmark_embedding=embedding,
        skeleton=skeleton,
        signed=True,
    )
    if not len(skin_triangles(head)):
        raise TrackError("not a FLAME model: its masks leave no face of bare skin")
    return head


def _checked(arrays: Arrays) -> dict[str, NDArray[np.float64]]:
    """The arrays that make the head, in double precision and of the shapes that fit each other."""
    missing = [key for key in ARRAYS if key not in arrays]
    if missing:
        raise TrackError(f"not a FLAME model: {', '.join(missing)} is missing")
    # Shapes first: what does not fit is not made larger by being made double.
    shapes = {key: np.shape(arrays[key]) or (1,) for key in ARRAYS}
    vertices, triangles = shapes["v_template"][0], shapes["f"][0]
    modes = shapes["shapedirs"][-1] if len(shapes["shapedirs"]) == 3 else 0
    expected = {
        "v_template": (vertices, 3),
        "f": (triangles, 3),
        "shapedirs": (vertices, 3, modes),
        "posedirs": (vertices, 3, 9 * (len(PARENTS) - 1)),
        "J_regressor": (len(PARENTS), vertices),
        "kintree_table": (2, len(PARENTS)),
        "weights": (vertices, len(PARENTS)),
    }
    checked = {}
    for key, shape in expected.items():
        if fits := shapes[key] == shape:
            try:
                checked[key] = np.asarray(arrays[key], np.float64)
            except (TypeError, ValueError, OverflowError) as error:
                raise TrackError(f"not a FLAME model: {key} holds no numbers ({error})") from error
            if key == "kintree_table":
                # The root's parent is 2^32 - 1.
                checked[key] = np.where(checked[key] >= len(PARENTS), -1, checked[key])
            fits = bool((np.abs(checked[key]) < LARGEST).all())  # NaN is not below it
        if not fits:
            raise TrackError(
                f"not a FLAME model: {key} is {shapes[key]}, numbers below {LARGEST:.0e} of {shape} needed"
            )
    if not vertices or not triangles:
        raise TrackError(f"not a FLAME model: it has {vertices} vertices and {triangles} faces")
    if modes <= IDENTITIES:
        raise TrackError(
            f"not a FLAME model with expressions: of the {modes} shapes in shapedirs {IDENTITIES} are the identity's"
        )
    if tuple(checked["kintree_table"][0]) != PARENTS:
        raise TrackError("not a FLAME model: its joints are not root, neck, jaw, left and right eye")
    if checked["f"].min() < 0 or checked["f"].max() >= vertices:
        raise TrackError(f"not a FLAME model: its faces name vertices above {vertices}")
    return checked


def _check_points(points: EmbeddedPoints, faces: int) -> None:
    count = len(points.landmarks)
    if points.triangles.shape != (count,) or points.barycentric.shape != (count, 3):
        raise TrackError(
            f"the landmark embedding holds {count} landmarks, {len(points.triangles)} faces and coordinates of "
            f"{points.barycentric.shape}: they must be as many, three each"
        )
    inside = bool(count) and points.triangles.min() >= 0 and points.triangles.max() < faces
    if not inside or points.landmarks.min() < 0 or points.landmarks.max() >= POINTS:
        raise TrackError(
            "the landmark embedding was made for another head: it names faces that this one lacks"
        )
    if not np.allclose(points.barycentric.sum(1), 1, atol=1e-3):
        raise TrackError("the landmark embedding is damaged: barycentric coordinates do not sum to 1")


def _check_area(points: EmbeddedPoints, template: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
    corners = template[faces[points.triangles]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    if not (area > LEAST_AREA_M2).all():
        raise TrackError("not a FLAME model: a face under a landmark has no area")


def _check_rigid(
    embedding: LandmarkEmbedding, template: NDArray[np.float64], faces: NDArray[np.int32]
) -> None:
    rigid = of_rigid_face(embedding.landmarks)
    count = int(rigid.sum())
    if count < LEAST_RIGID:
        raise TrackError(
            f"the landmark embedding holds {count} landmarks of the rigid upper face, at least {LEAST_RIGID} tell "
            "its pose: give one with nose and eyes"
        )
    corners = template[faces[embedding.triangles[rigid]], :2]
    seen = np.einsum("lc,lcx->lx", embedding.barycentric[rigid], corners)  # from the front
    if np.linalg.svd(seen - seen.mean(0), compute_uv=False)[-1] < LEAST_BREADTH_M * np.sqrt(count):
        raise TrackError(
            "the landmarks of the upper face lie in one place or on one line: the head is damaged, or not in metres"
        )


def _joint(skeleton: Skeleton, row: int) -> Joint:
    member = np.flatnonzero(skeleton.weights[:, row] > 0.5).astype(np.int32)
    return Joint(skeleton.joints[row], skeleton.identity_basis[:, row], member)


def _embedding(
    points: EmbeddedPoints,
    skeleton: Skeleton,
    template: NDArray[np.float64],
    faces: NDArray[np.int32],
    sha256: str,
) -> LandmarkEmbedding:
    """The user's points, and the middle of each iris: the vertex of the ball that is farthest to the front."""
    landmarks, triangles, shares = [points.landmarks], [points.triangles], [points.barycentric]
    for landmark, joint in zip(IRIS_CENTRES, (LEFT_EYE, RIGHT_EYE), strict=True):
        ball = np.intersect1d(np.flatnonzero(skeleton.weights[:, joint] > 0.5), faces)
        if not len(ball) or landmark in points.landmarks:
            continue
        front = ball[np.argmax(template[ball, 2])]
        row, corner = np.argwhere(faces == front)[0]
        landmarks.append(np.array([landmark], np.int32))
        triangles.append(np.array([row], np.int32))
        shares.append(np.eye(3, dtype=np.float32)[[corner]])
    return LandmarkEmbedding(
        np.concatenate(landmarks), np.concatenate(triangles), np.concatenate(shares), sha256
    )
