"""Eye rotations in closed form from the iris landmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tracker.energy import Energy, rotation_matrix
from tracker.landmark_indices import IRIS_CENTRES
from tracker.track import F64

if TYPE_CHECKING:
    from tracker.head import HeadModel

LIMIT = np.radians(45.0)


def eye_rotations(
    head: HeadModel, identity: F64, expression: NDArray[np.float32], x: F64, observed: F64, energy: Energy
) -> F64:
    """[n, 2, 3] rad, left then right: the turn that carries the head's straight iris onto the seen one.

    The head's own eyeballs turn: the embedded head's have a radius of 16.6 mm, real ones 12, and turn less for it.
    observed: [n, 478, 2] px. Yaw turns about y and pitch about x of the head; no roll. Zero if the head's
    landmark embedding has no irises. That the eyes differ in the clip's median is the head's error rather than a
    squint: both take the mean of their medians.
    """
    at = [np.flatnonzero(head.landmark_embedding.landmarks == index) for index in IRIS_CENTRES]
    out = np.zeros((len(x), 2, 3))
    if any(len(index) != 1 for index in at):
        return out
    rows = np.concatenate(at)
    straight = _embedded(head, rows, identity, expression) - energy.model.centre
    matrix = rotation_matrix(x[:, -6:-3])
    camera = straight @ matrix.transpose(0, 2, 1) + x[:, None, -3:]
    expected = energy.focal * camera[..., :2] / camera[..., 2:] + energy.principal
    shift = np.zeros((len(x), 2, 3))
    shift[..., :2] = (observed[:, IRIS_CENTRES] - expected) * camera[..., 2:] / energy.focal
    moved = shift @ matrix / _radii(head, rows, identity)[:, None]  # back to head axes
    out[..., 1] = np.arcsin(np.clip(moved[..., 0], -np.sin(LIMIT), np.sin(LIMIT)))
    out[..., 0] = -np.arcsin(np.clip(moved[..., 1], -np.sin(LIMIT), np.sin(LIMIT)))
    return out - np.median(out, axis=0) + np.median(out, axis=0).mean(0)


def _radii(head: HeadModel, rows: NDArray[np.int64], identity: F64) -> F64:
    """[2] m from the centre of each eyeball to the middle of its iris."""
    iris = _embedded(head, rows, identity, np.zeros((1, len(head.expression_basis)), np.float32))[0]
    joints = [head.joints[name] for name in ("left_eye", "right_eye")]
    centre = np.stack([joint.position + identity @ joint.identity_basis for joint in joints])
    return np.linalg.norm(iris - centre, axis=1)


def _embedded(
    head: HeadModel, rows: NDArray[np.int64], identity: F64, expression: NDArray[np.float32]
) -> F64:
    """[n, len(rows), 3] m, embedded landmarks of the moving face with its eyes straight."""
    embedding = head.landmark_embedding
    corners = np.asarray(head.faces)[embedding.triangles[rows]]
    share = embedding.barycentric[rows]
    neutral = head.template[corners] + np.tensordot(identity, head.identity_basis[:, corners], axes=1)
    moved = neutral + np.tensordot(expression, head.expression_basis[:, corners], axes=1)
    return np.einsum("lc,nlcx->nlx", share, moved)
