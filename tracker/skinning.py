"""Linear blend skinning with pose correctives (Li et al. 2017, equations 1-2): how FLAME turns neck, jaw and eyes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from tracker.track import F32

NECK, JAW, LEFT_EYE, RIGHT_EYE = (
    1,
    2,
    3,
    4,
)  # rows of the skeleton; row 0 is the root, which is the head's pose


@dataclass(frozen=True)
class Skeleton:
    """J joints that follow the face's shape, and how far each vertex goes with them.

    parents: [J] i32, -1 for the root, a parent before its children. joints: [J, 3] m of the template.
    identity_basis: [Ki, J, 3] and expression_basis: [Ke, J, 3] m, how the joints move with the shape.
    weights: [D, J] f32, rows sum to 1. pose_basis: [9 (J - 1), D, 3] m, linear in the entries of R - I of all
    joints but the root.
    """

    parents: NDArray[np.int32]
    joints: F32
    identity_basis: F32
    expression_basis: F32
    weights: F32
    pose_basis: F32

    def positions(self, identity: NDArray[np.floating], expression: NDArray[np.floating]) -> F32:
        """[.., J, 3] m, the joints of a shape that is not turned yet."""
        moved = np.tensordot(identity, self.identity_basis, 1) + np.tensordot(
            expression, self.expression_basis, 1
        )
        return np.asarray(self.joints + moved, np.float32)

    def pose(
        self,
        shaped: F32,
        select: NDArray[np.integer] | slice,
        joints: F32,
        jaw: ArrayLike | None,
        neck: ArrayLike | None,
        eyes: ArrayLike | None,
    ) -> F32:
        """Turn the selected vertices [.., S, 3] m about `joints` [.., J, 3]; rotations as for HeadModel.vertices."""
        turned = rotations(jaw, neck, eyes)
        feature = (turned[..., 1:, :, :] - np.eye(3, dtype=np.float32)).reshape(*turned.shape[:-3], -1)
        basis = self.pose_basis[:, select]
        shaped = shaped + (feature @ basis.reshape(len(basis), -1)).reshape(*feature.shape[:-1], -1, 3)
        matrix, shift = self._transforms(turned, joints)
        weights = self.weights[select]
        blended = np.einsum("sj,...jxy->...sxy", weights, matrix)
        return np.asarray(np.einsum("...sxy,...sy->...sx", blended, shaped) + weights @ shift, np.float32)

    def _transforms(self, turned: F32, joints: F32) -> tuple[F32, F32]:
        """[.., J, 3, 3] and [.., J, 3]: what carries a resting point along with each joint and its parents."""
        lead = np.broadcast_shapes(turned.shape[:-3], joints.shape[:-2])
        matrix = np.empty((*lead, len(self.parents), 3, 3), np.float32)
        shift = np.empty((*lead, len(self.parents), 3), np.float32)
        for joint, parent in enumerate(self.parents):
            centre = joints[..., joint, :]
            own = turned[..., joint, :, :]
            fixed = centre - np.einsum("...xy,...y->...x", own, centre)
            if parent < 0:
                matrix[..., joint, :, :], shift[..., joint, :] = own, fixed
                continue
            above = matrix[..., parent, :, :]
            matrix[..., joint, :, :] = above @ own
            shift[..., joint, :] = np.einsum("...xy,...y->...x", above, fixed) + shift[..., parent, :]
        return matrix, shift


def rotations(jaw: ArrayLike | None, neck: ArrayLike | None, eyes: ArrayLike | None) -> F32:
    """[.., 5, 3, 3] of root (none), neck, jaw, left and right eye, from axis-angle [.., 3] and, eyes, [.., 2, 3]."""
    parts = [np.zeros(shape, np.float32) if part is None else np.asarray(part, np.float32)
             for part, shape in ((neck, 3), (jaw, 3), (eyes, (2, 3)))]  # fmt: skip
    neck_turn, jaw_turn, eye_turns = parts
    lead = np.broadcast_shapes(neck_turn.shape[:-1], jaw_turn.shape[:-1], eye_turns.shape[:-2])
    vectors = np.zeros((*lead, 5, 3), np.float32)
    vectors[..., NECK, :], vectors[..., JAW, :] = neck_turn, jaw_turn
    vectors[..., LEFT_EYE:, :] = eye_turns
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return matrices.reshape(*vectors.shape, 3).astype(np.float32)
