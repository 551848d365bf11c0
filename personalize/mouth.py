"""The regions that the metrics need, on a mesh whose vertices nobody has named: found from how it moves in speech."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from model.motion_basis import MotionBasis
from personalize.errors import UserError

F32 = NDArray[np.float32]
Index = NDArray[np.int32]

MIDLINE_M = 0.005  # half the width of the strip in the middle of the face where the inner lips are sought
TOUCHING_M = 0.006  # the inner lips lie nearer than this at rest
PARTING_SHARE = 0.8  # of pairs that part nearly as far as the furthest, the nearest at rest is taken
# Without a mask the lips are this box about the middle of the mouth: half a usual mouth's width, height and depth.
LIP_BOX_M = (0.027, 0.013, 0.025)


def mouth_regions(template: F32, motion: MotionBasis, masks: Mapping[str, Index]) -> dict[str, Index]:
    """`lips`, `face`, `inner_lip_upper`, `inner_lip_lower` of a head (x to its left, y up) in motion of speech.

    lips: FLAME's mask of that name, or a box about the middle of the mouth. face: all vertices, as the paper's L2
    face has it. The inner lips are one vertex each, the middles that Lip-Sync compares: of the pairs of vertices that
    touch in the middle of the face, the one that speech parts. Raises UserError where no such pair is.
    """
    among = masks.get("lips", np.arange(len(template), dtype=np.int32))
    upper, lower = _parting_pair(template, motion, among)
    lips = masks.get("lips")
    if lips is None:
        offset = np.abs(template - (template[upper] + template[lower]) / 2)
        lips = np.flatnonzero((offset <= LIP_BOX_M).all(axis=1)).astype(np.int32)
    return {
        "lips": lips,
        "face": np.arange(len(template), dtype=np.int32),
        "inner_lip_upper": np.array([upper], np.int32),
        "inner_lip_lower": np.array([lower], np.int32),
    }


def _parting_pair(template: F32, motion: MotionBasis, among: Index) -> tuple[int, int]:
    """Middle of the upper and of the lower inner lip."""
    beside = np.abs(template[among, 0] - template[:, 0].mean())
    strip = among[beside < MIDLINE_M]
    pairs = (
        cKDTree(template[strip]).query_pairs(TOUCHING_M, output_type="ndarray") if len(strip) else strip[:0]
    )
    if len(pairs) == 0:
        raise UserError("the mesh has no lips that touch in the middle of its face: are its units metres?")
    first, second = strip[pairs].T
    parting = _swing(motion, motion.basis[:, first] - motion.basis[:, second])
    far = np.flatnonzero(parting >= PARTING_SHARE * parting.max())
    nearest = far[np.linalg.norm(template[first[far]] - template[second[far]], axis=1).argmin()]
    pair = np.array([first[nearest], second[nearest]])
    # The jaw carries the lower lip; at rest their order in height means little.
    upper, lower = pair[_swing(motion, motion.basis[:, pair]).argsort()]
    return int(upper), int(lower)


def _swing(motion: MotionBasis, modes: F32) -> NDArray[np.float64]:
    """Root mean square length, m, of the motion of points whose share in the modes is [K, P, 3] -> [P]."""
    return np.sqrt(((motion.sizes[:, None, None] * modes) ** 2).sum(axis=(0, 2)))
