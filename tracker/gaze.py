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
    observed: [n, 478, 2] px. The iris lies where the ray through it enters the eyeball; eyes do not roll, nor
    turn by more than LIMIT. Zero if the head's landmark embedding has no irises. That the eyes differ in the
    clip's median is the head's error rather than a squint: both take the mean of their medians.
    """
    at = [np.flatnonzero(head.landmark_embedding.landmarks == index) for index in IRIS_CENTRES]
    if any(len(index) != 1 for index in at):
        return np.zeros((len(x), 2, 3))
    rows = np.concatenate(at)
    straight = _from_eyeballs(head, rows, identity)
    matrix = rotation_matrix(x[:, -6:-3])
    rays = np.ones((len(x), 2, 3))
    rays[..., :2] = (observed[:, IRIS_CENTRES] - energy.principal) / energy.focal
    # In head axes, from the camera.
    rays = rays @ matrix / np.linalg.norm(rays, axis=-1, keepdims=True)
    eyeballs = _embedded(head, rows, identity, expression) - energy.model.centre - straight
    eyeballs += x[:, None, -3:] @ matrix
    along = (eyeballs * rays).sum(-1)
    inside = (straight**2).sum(-1) - (eyeballs**2).sum(-1) + along**2
    seen = (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays - eyeballs
    out = _turns(straight, seen)
    return out - np.median(out, axis=0) + np.median(out, axis=0).mean(0)


def _turns(start: F64, end: F64) -> F64:
    """[n, 2, 3] rad, the turns about axes across z that take the directions start [2, 3] to end [n, 2, 3]."""
    start, end = (towards / np.linalg.norm(towards, axis=-1, keepdims=True) for towards in (start, end))
    # A turn moves along circles about its axis, which is therefore square to where it moves something.
    axis = np.cross([0.0, 0.0, 1.0], end - start)
    axis /= np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-12)
    across = start - (start * axis).sum(-1, keepdims=True) * axis
    sine = (np.cross(across, end) * axis).sum(-1, keepdims=True)
    angle = np.arctan2(sine, (across * end).sum(-1, keepdims=True))
    return np.clip(angle, -LIMIT, LIMIT) * axis


def _from_eyeballs(head: HeadModel, rows: NDArray[np.int64], identity: F64) -> F64:
    """[2, 3] m from the centre of each eyeball to the middle of its iris, the eyes straight."""
    iris = _embedded(head, rows, identity, np.zeros((1, len(head.expression_basis)), np.float32))[0]
    joints = [head.joints[name] for name in ("left_eye", "right_eye")]
    centre = np.stack([joint.position + identity @ joint.identity_basis for joint in joints])
    return iris - centre


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
