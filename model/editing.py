"""Edits of a motion: what is kept of it, and the motion that goes through what is kept."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from model.basis import common_basis, orthonormal
from model.checkpoint import Checkpoint
from model.errors import ModelError
from model.metrics import isometry, seam
from model.motion import Motion
from model.synthesis import Keep, Sampling, synthesize
from model.vertex_mask import VertexMask

F32 = NDArray[np.float32]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Kept:
    """What an edit keeps.

    motion: N frames of the checkpoint's mesh, in any basis. frames [N] bool: kept whole, all of them valid. share [D]
    f32: how far each vertex is kept in every other valid frame, 0 made anew .. 1 kept; None keeps no part of the face.
    """

    motion: Motion
    frames: Bool
    share: F32 | None = None


def edit(
    checkpoint: Checkpoint,
    features: F32 | None,
    kept: Kept,
    **sampling: Unpack[Sampling],
) -> list[Motion]:
    """Speech features [N, W] at the motion's frames -> motions on its template and clock, drawn like `synthesize`'s.

    features None: unconditional, guidance is 0 then. Kept frames and vertices return as they are, to rounding of
    float32. The basis is the checkpoint's where whole frames in that basis are kept; else one that holds the result.
    Raises ModelError where motion, features and checkpoint do not fit each other, or like `synthesize`.
    """
    motion = kept.motion
    check_motion(checkpoint, motion)
    _check(kept)
    if features is None:
        features = np.zeros((len(motion.valid), checkpoint.config.audio_width), np.float32)
        sampling["guidance"] = 0.0
    basis, ours, theirs = common_basis(checkpoint.basis, motion.basis)
    known = np.where(motion.valid[:, None], motion.coefficients, 0) @ theirs
    mask = None
    if kept.share is not None:
        mask = VertexMask.of(checkpoint.basis, kept.share, motion, motion.valid & ~kept.frames)
    keep = Keep((known @ ours.T).astype(np.float32), kept.frames, mask)
    drawn = synthesize(checkpoint, features, keep=keep, **sampling)
    made = np.where(kept.frames[:, None], known, drawn @ ours)
    if kept.share is not None:
        # displacement = (1 - m) · made + m · known, and only here the vertices that are kept leave the basis.
        m = kept.share[:, None]
        basis, mixing = orthonormal(np.concatenate([basis * (1 - m), basis * m]))
        partly = np.where(motion.valid[:, None], known, made)
        made = np.concatenate([made, partly], axis=-1) @ mixing
    everywhere = np.ones(len(motion.valid), bool)
    return [
        dataclasses.replace(motion, basis=basis, coefficients=sample.astype(np.float32), valid=everywhere)
        for sample in made
    ]


def check_motion(checkpoint: Checkpoint, motion: Motion) -> None:
    """ModelError where the motion is of another mesh or rate."""
    if motion.topology != checkpoint.topology:
        raise ModelError(
            f"the motion is of the mesh topology {motion.topology[:12]}, the checkpoint of"
            f" {checkpoint.topology[:12]}: give a checkpoint of the motion's own mesh"
        )
    if motion.fps != checkpoint.fps:
        raise ModelError(
            f"the motion has {motion.fps:g} frames a second, the checkpoint makes {checkpoint.fps:g}"
        )


def _check(kept: Kept) -> None:
    """ModelError where a frame to keep was not seen, or a vertex has no share."""
    motion = kept.motion
    if kept.frames.shape != motion.valid.shape or (kept.frames & ~motion.valid).any():
        raise ModelError("frames to keep must be frames of the motion in which the face was seen")
    if kept.share is not None and kept.share.shape != (len(motion.template),):
        raise ModelError(f"{len(kept.share)} shares for the {len(motion.template)} vertices of the mesh")


def with_frames(motion: Motion, other: Motion, frames: Bool, source: NDArray[np.integer]) -> Motion:
    """The motion with its `frames` [N] taken from the frames `source` [frames.sum()] of another one of its mesh.

    Displacements are taken, so the other one may be of another person. Raises ModelError for another mesh.
    """
    if other.topology != motion.topology:
        raise ModelError(
            f"the other motion is of the mesh topology {other.topology[:12]}, not {motion.topology[:12]}:"
            " only frames of the same mesh can be taken over"
        )
    basis, ours, theirs = common_basis(motion.basis, other.basis)
    coefficients, valid = motion.coefficients @ ours, motion.valid.copy()
    coefficients[frames] = other.coefficients[source] @ theirs
    valid[frames] = other.valid[source]
    return dataclasses.replace(motion, basis=basis, coefficients=coefficients.astype(np.float32), valid=valid)


def seam_of(edited: Motion, frames: Bool, reference: Motion, face: NDArray[np.integer]) -> float:
    """`seam` (model/metrics.py) over the face's vertices: the edited motion, its kept frames [N], and the person's own
    motion."""
    valid = reference.valid
    shot = np.cumsum(np.diff(valid.astype(int), prepend=0) == 1)[valid]
    own = reference.coefficients[valid] @ isometry(reference.basis, face)
    return seam(edited.coefficients @ isometry(edited.basis, face), frames, own, shot)
