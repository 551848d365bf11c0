"""The part of the base mesh that is the head: skin with mouth bag, finer eyeballs, teeth, tongue; and its rings."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, vstack
from scipy.sparse.csgraph import connected_components

from tools.head_source import Source

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]

# Rings of the eyeball by their angle from the gaze direction: pupil, iris, white; behind the last is never seen.
EYE_RINGS_DEG = (5.0, 8.5, 10.0, 15.0, 19.0, 21.0, 24.0, 33.0, 45.0, 60.0, 80.0, 100.0)
EYE_SECTORS = 24
IRIS_RING = 5
EYES = ("helper-l-eye", "helper-r-eye")
PARTS = ("helper-upper-teeth", "helper-lower-teeth", "helper-tongue")

# Vertices of the base mesh on its midline where the lips meet, with the three rings of the mesh on either side.
LIP_RINGS = {0: 474, 1: 468, 2: 509, 3: 467, -1: 520, -2: 537, -3: 554}
# Vertices on the left upper lid's margin, front edge first, and two rings up the lid.
LID_RINGS = {0: 6785, 1: 11465, 2: 6787, 3: 6789, -1: 13352, -2: 7748}


@dataclass(frozen=True)
class Mesh:
    """The head as a linear function of the base mesh.

    select: sparse [D + 3, base vertices]; the three last rows are the jaw hinge, the left and the right eye centre.
    faces: [F, 3], mirror: [D], parts: part name -> vertex indices, base: base vertex -> head vertex (-1: left out).
    """

    select: csr_array
    faces: NDArray[np.int32]
    mirror: I64
    base: I64
    parts: dict[str, I64] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """D, the number of vertices."""
        return len(self.mirror)

    def of(self, displacement: F64) -> F64:
        """[base vertices, 3] dm -> [D + 3, 3] m."""
        return 0.1 * (self.select @ displacement)


def build_mesh(source: Source) -> Mesh:
    """Cut, resample the eyeballs, triangulate symmetrically."""
    skin = _skin_quads(source)
    quads = np.concatenate([skin, *(source.quads(part) for part in PARTS)])
    kept = np.unique(quads)
    base = np.full(len(source.vertices), -1)
    base[kept] = np.arange(len(kept))
    half = quads[source.vertices[quads, 0].mean(1) > 0]
    triangles = np.concatenate([half[:, [0, 1, 2]], half[:, [0, 2, 3]]])
    triangles = np.concatenate([triangles, source.mirror[triangles][:, ::-1]])
    rows = [coo_array((np.ones(len(kept)), (np.arange(len(kept)), kept)), (len(kept), len(base)))]
    faces, mirror = [base[triangles]], [base[source.mirror[kept]]]
    parts = {"skin": base[np.unique(skin)]} | {part: base[source.group(part)] for part in PARTS}
    directions, eye_faces = _eyeball()
    for side, group in enumerate(EYES):
        flip = np.array([1 - 2 * side, 1, 1])
        first = len(kept) + side * len(directions)
        rows.append(_resample_ball(source, group, directions * flip))
        faces.append(first + (eye_faces[:, ::-1] if side else eye_faces))
        mirror.append(len(kept) + (1 - side) * len(directions) + np.arange(len(directions)))
        parts[group] = first + np.arange(len(directions))
    rows += [_mean_row(source, group) for group in ("joint-mouth", *EYES)]
    select = csr_array(vstack(rows))
    return Mesh(select, np.concatenate(faces).astype(np.int32), np.concatenate(mirror), base, parts)


def _skin_quads(source: Source) -> I64:
    """The body's quads above a plane through the neck, without the eye sockets behind the balls."""
    vertices = source.vertices
    quads = source.quads("body")
    y, z = vertices[:, 1], vertices[:, 2]
    keep = y > 5.9 - 0.35 * (z - 0.3)
    for group in EYES:
        ball = vertices[source.group(group)]
        centre = ball.mean(0)
        radius = np.linalg.norm(ball - centre, axis=1).mean()
        keep &= (np.linalg.norm(vertices - centre, axis=1) > 1.17 * radius) | (z > centre[2] + 0.4 * radius)
    quads = quads[keep[quads].all(1)]
    # The plane also cuts the raised hands off: keep the piece with the highest vertex, the crown.
    a, b = quads.ravel(), np.roll(quads, 1, axis=1).ravel()
    _, label = connected_components(coo_array((np.ones(len(a)), (a, b)), (len(vertices),) * 2))
    return quads[label[quads[:, 0]] == label[quads.ravel()[np.argmax(y[quads.ravel()])]]]


def _eyeball() -> tuple[F64, I64]:
    """Unit directions [n, 3] of the left eyeball, gaze along z, and its triangles."""
    angle = np.deg2rad(np.array(EYE_RINGS_DEG))[:, None]
    turn = 2 * np.pi * np.arange(EYE_SECTORS) / EYE_SECTORS
    ring = [
        np.sin(angle) * np.cos(turn),
        np.sin(angle) * np.sin(turn),
        np.broadcast_to(np.cos(angle), (len(angle), EYE_SECTORS)),
    ]
    directions = np.concatenate([[[0, 0, 1]], np.stack(ring, axis=-1).reshape(-1, 3)])
    index = 1 + np.arange(angle.size * EYE_SECTORS).reshape(angle.size, EYE_SECTORS)
    following = np.roll(index, -1, axis=1)
    cap = np.stack([np.zeros_like(index[0]), index[0], following[0]], axis=1)
    inner = np.stack([index[:-1], index[1:], following[1:]], axis=-1).reshape(-1, 3)
    outer = np.stack([index[:-1], following[1:], following[:-1]], axis=-1).reshape(-1, 3)
    return directions, np.concatenate([cap, inner, outer])


def _resample_ball(source: Source, group: str, directions: F64) -> coo_array:
    """Rows that carry `directions` of the unit sphere by the affine map that best fits the group's ball."""
    members = source.group(group)
    ball = source.vertices[members]
    centre = ball.mean(0)
    unit = (ball - centre) / np.linalg.norm(ball - centre, axis=1).mean()
    system = np.c_[unit, np.ones(len(unit))]
    weights = np.c_[directions, np.ones(len(directions))] @ np.linalg.pinv(system)
    row, column = np.indices(weights.shape)
    return coo_array(
        (weights.ravel(), (row.ravel(), members[column.ravel()])), (len(directions), len(source.vertices))
    )


def _mean_row(source: Source, group: str) -> coo_array:
    members = source.group(group)
    zero = np.zeros(len(members), int)
    return coo_array((np.full(len(members), 1 / len(members)), (zero, members)), (1, len(source.vertices)))


class Rings:
    """Walks the rings of quads of the body."""

    def __init__(self, source: Source) -> None:
        self.vertices = source.vertices
        self.quads_at: dict[int, list[set[int]]] = defaultdict(list)
        self.neighbours: dict[int, set[int]] = defaultdict(set)
        for quad in source.quads("body").tolist():
            for a, b in zip(quad, quad[1:] + quad[:1]):
                self.neighbours[a].add(b)
                self.neighbours[b].add(a)
                self.quads_at[a].append(set(quad))

    def walk(self, start: int) -> list[int]:
        """The closed ring through `start`, first step towards larger x, straight on at every vertex."""
        step = self.vertices[list(self.neighbours[start])] - self.vertices[start]
        sideways = step[:, 0] - 2 * np.abs(step[:, 1]) - np.abs(step[:, 2])
        ring = [start, list(self.neighbours[start])[int(np.argmax(sideways))]]
        while True:
            beside = set().union(*(quad for quad in self.quads_at[ring[-1]] if ring[-2] in quad))
            (following,) = self.neighbours[ring[-1]] - beside
            if following == start:
                return ring
            ring.append(following)

    def halves(
        self, rings: dict[int, int], corners: int
    ) -> tuple[dict[int, list[int]], dict[int, list[int]]]:
        """Upper and lower half of several rings, each from its right to its left corner, both corners in each.

        rings: number -> start vertex; the starts lie on one line across the rings. corners: number of the ring whose
        extremes in x are the corners of all.
        """
        walks = {number: self.walk(start) for number, start in rings.items()}
        x = self.vertices[walks[corners], 0]
        right, left = int(np.argmin(x)), int(np.argmax(x))
        # The walk starts in the middle of the upper half towards the left corner: left < right.
        upper = {number: (walk[right:] + walk[: left + 1]) for number, walk in walks.items()}
        lower = {number: walk[left : right + 1][::-1] for number, walk in walks.items()}
        return upper, lower
