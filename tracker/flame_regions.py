"""FLAME's regions: from its own vertex masks where the user has them, from landmarks and skin weights where not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from tracker.head import LandmarkEmbedding
from tracker.landmark_indices import INNER_LIP_LOWER, INNER_LIP_UPPER, LEFT_EYE, LIPS, RIGHT_EYE
from tracker.skinning import LEFT_EYE as LEFT_EYE_JOINT
from tracker.skinning import RIGHT_EYE as RIGHT_EYE_JOINT
from tracker.skinning import Skeleton
from tracker.track import F64, TrackError

I32 = NDArray[np.int32]

LIP_WIDTH_M, LID_WIDTH_M = 0.008, 0.006  # of the skin around the landmarks that belongs to them
FACE_MARGIN = 1.35  # landmarks lie inside the face: it ends so much farther from their middle
ABSENT = ("teeth", "tongue", "mouth")  # FLAME has none


def regions_of(
    template: F64,
    skeleton: Skeleton,
    faces: I32,
    embedding: LandmarkEmbedding,
    masks: Mapping[str, I32],
) -> dict[str, I32]:
    """Name -> vertex indices, HeadModel's names. Raises TrackError without inner lips, and for wrong masks."""
    at = np.einsum("lc,lcx->lx", embedding.barycentric, template[faces[embedding.triangles]])
    point = {int(index): at[row] for row, index in enumerate(embedding.landmarks)}
    upper, lower = inner_lips(faces, embedding)
    balls = [np.flatnonzero(skeleton.weights[:, row] > 0.5) for row in (LEFT_EYE_JOINT, RIGHT_EYE_JOINT)]
    eyes = np.concatenate(balls)
    skin = np.setdiff1d(np.arange(len(template)), eyes)
    lids = _near(template, skin, [point[i] for i in (*LEFT_EYE, *RIGHT_EYE) if i in point], LID_WIDTH_M)
    face = _front(template, skin, at)
    brow = at[:, 1].max()
    told = {
        "lips": _near(template, skin, [point[i] for i in LIPS if i in point], LIP_WIDTH_M),
        "face": face,
        "forehead": face[template[face, 1] > brow],
        "scalp": np.setdiff1d(skin[template[skin, 1] > brow], face),
        "neck": np.flatnonzero(skeleton.weights[:, 0] > 0.25),
    }
    given = {name: mask for name, mask in masks.items() if name in told and len(mask)}
    if any(mask.min() < 0 or mask.max() >= len(template) for mask in given.values()):
        raise TrackError(f"the vertex masks are for another head: they name vertices above {len(template)}")
    regions = told | given
    regions |= {"eyelids": lids, "left_eye": balls[0], "right_eye": balls[1], "eyes": eyes}
    regions |= {"inner_lip_upper": upper, "inner_lip_lower": lower}
    regions |= {name: np.zeros(0, np.int32) for name in ABSENT}
    return {name: vertices.astype(np.int32) for name, vertices in regions.items()}


def inner_lips(faces: I32, embedding: LandmarkEmbedding) -> tuple[I32, I32]:
    """Vertices of the inner lips from the right corner to the left one, upper and lower paired."""
    row = {int(index): i for i, index in enumerate(embedding.landmarks)}
    pairs = [pair for pair in zip(INNER_LIP_UPPER, INNER_LIP_LOWER, strict=True) if row.keys() >= set(pair)]
    if (13, 14) not in pairs:
        raise TrackError(
            "the landmark embedding lacks the middle of the inner lips (13 and 14 of MediaPipe's points): "
            "give one with inner lips"
        )
    # lip_gap_mm takes the pair in the middle: the same number on both sides of it.
    middle = pairs.index((13, 14))
    reach = min(middle, len(pairs) - 1 - middle)
    rows = np.array([[row[a], row[b]] for a, b in pairs[middle - reach : middle + reach + 1]])
    corners = faces[embedding.triangles[rows]]
    nearest = np.take_along_axis(corners, embedding.barycentric[rows].argmax(-1)[..., None], -1)[..., 0]
    return nearest[:, 0], nearest[:, 1]


def _near(template: F64, vertices: NDArray[np.intp], points: list[F64], width_m: float) -> NDArray[np.intp]:
    """Those of the vertices within `width_m` of a point."""
    if not points:
        return vertices[:0]
    distance, _ = cKDTree(np.array(points)).query(template[vertices])
    return vertices[distance < width_m]


def _front(template: F64, vertices: NDArray[np.intp], landmarks: F64) -> NDArray[np.intp]:
    """Vertices that lie, seen from the front, within the landmarks' outline made larger, and not behind them."""
    middle = landmarks.mean(0)
    outline = Delaunay((landmarks[:, :2] - middle[:2]) * FACE_MARGIN + middle[:2])
    inside = outline.find_simplex(template[vertices, :2]) >= 0
    deep = landmarks[:, 2].min() - 0.5 * np.ptp(landmarks[:, 0])
    return vertices[inside & (template[vertices, 2] > deep)]
