"""What the skin looks like: sample points on it, which of them a picture shows, their albedo and the light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tracker.energy import LandmarkModel
from tracker.modes import movements
from tracker.raster import project, rasterize, vertex_normals
from tracker.track import F32, F64

if TYPE_CHECKING:
    from tracker.head import HeadModel

Bool = NDArray[np.bool_]

POINTS = 3000
INSIDE = ("mouth", "teeth", "tongue", "eyes", "eyelids")  # regions that are no skin, or turn out of sight
MOUTH_M = 0.015  # from the lips: skin that belongs to the mouth
DENSER = 8  # points along each edge of the inner lips: their distance is that of the line
COARSE = 0.4  # of the picture's size is enough for the raster that tells what hides what
MARGIN_M = 0.004  # how far behind the raster's surface skin may lie and still be seen
FACING = 0.25  # cosine to the line of sight below which skin is too oblique to compare
HARMONICS = 9
RIDGE = 1e-3  # weight of the clip's usual light, as a share of the points'
ROUNDS = 4  # of light and albedo in turn
OUTLIER = 4.0  # median deviations beyond which a grey level hardly tells the albedo


@dataclass(frozen=True)
class Skin:
    """P points on one subject's skin, in the solver's head frame (centred on the landmarks).

    triangles: [P] of the head's faces. barycentric: [P, 3]. rest: [P, 3] m. expression: [P, 3, K] m, the modes of
    LandmarkModel. mouth: [P], on the lips and around them. to_inside: [P] m, from where the lips meet.
    """

    triangles: NDArray[np.int64]
    barycentric: F32
    rest: F32
    expression: F32
    mouth: Bool
    to_inside: F32

    def __len__(self) -> int:
        return len(self.rest)


def skin_triangles(head: HeadModel) -> NDArray[np.int64]:
    """Those of a head's faces that are skin; eyes, eyelids and the inside of the mouth are left out."""
    inside = np.concatenate([head.regions[name] for name in INSIDE if name in head.regions])
    inside = np.union1d(np.setdiff1d(inside, head.regions["lips"]), head.behind_lips())
    bare = np.setdiff1d(head.regions["face"], inside)
    return np.flatnonzero(np.isin(head.faces, bare).all(1))


def skin_of(head: HeadModel, model: LandmarkModel, identity: F32) -> Skin:
    """Points spread evenly over a subject's face."""
    triangles = skin_triangles(head)
    neutral = head.vertices(identity, np.zeros(len(head.expression_basis), np.float32))
    chosen, share = _spread(neutral[head.faces[triangles]])
    corners = head.faces[triangles[chosen]]
    points = np.einsum("pc,pcx->px", share, neutral[corners])
    moves = np.einsum("pc,kpcx->pxk", share, movements(head)[:, corners])
    distance, _ = cKDTree(neutral[head.regions["lips"]]).query(points)
    return Skin(
        triangles=triangles[chosen],
        barycentric=share,
        rest=(points - model.centre).astype(np.float32),
        expression=np.ascontiguousarray(moves @ model.modes.to_head.T, np.float32),
        mouth=distance < MOUTH_M,
        to_inside=_to_line(points, [neutral[head.regions[f"inner_lip_{lip}"]] for lip in ("upper", "lower")]),
    )


def _to_line(points: F32, lines: Sequence[F32]) -> F32:
    """[P] m from points [P, 3] to the nearest of lines [.., 3], which may be of one point."""
    share = np.linspace(0, 1, DENSER)[:, None, None]
    dense = [(line[:-1] + share * np.diff(line, axis=0)).reshape(-1, 3) for line in lines]
    return cKDTree(np.concatenate([*lines, *dense])).query(points)[0].astype(np.float32)


def _spread(corners: F32) -> tuple[NDArray[np.int64], F32]:
    """Triangle [P] and barycentric weights [P, 3] of points at equal steps of area over triangles [F, 3, 3]."""
    side = corners[:, 1:] - corners[:, :1]
    area = np.cumsum(np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1))
    order = np.arange(POINTS)
    chosen = np.searchsorted(area, (order + 0.5) / POINTS * area[-1])
    # Powers of the plastic number: a sequence without clumps places the points inside their triangles.
    u, v = (order[:, None] * (0.7548776662466927, 0.5698402909980532) % 1.0).T
    root = np.sqrt(u)
    return chosen, np.stack([1 - root, root * (1 - v), root * v], axis=1).astype(np.float32)


def seen_skin(
    skin: Skin, head: HeadModel, vertices: F32, focal: float, principal: F64, size: tuple[int, int], own: F64
) -> tuple[Bool, F32]:
    """Which points [P] a picture shows, by rasterization, and their normals [P, 3] in the camera frame.

    vertices: [D, 3] m, camera frame. focal, principal, size: of the picture, px. own: [2, 2] px, the first and last
    (x, y) in it that the camera saw.
    """
    corners = head.faces[skin.triangles]
    fields = (vertices, vertex_normals(vertices, head.faces))
    points, normal = (np.einsum("pc,pcx->px", skin.barycentric, field[corners]) for field in fields)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    facing = -(normal * points).sum(1) / np.linalg.norm(points, axis=1)
    pixels = np.concatenate([COARSE * project(vertices, focal, principal), vertices[:, 2:]], axis=1)
    width, height = (int(np.ceil(COARSE * side)) for side in size)
    depth = rasterize(pixels, head.faces, (width, height)).depth
    place = project(points, focal, principal)
    inside = np.all((place >= own[0]) & (place <= own[1]), axis=1)
    at = np.round(COARSE * np.where(inside[:, None], place, 0)).astype(int)
    column, row = np.minimum(at, (width - 1, height - 1)).T
    return inside & (points[:, 2] < depth[row, column] + MARGIN_M) & (facing > FACING), normal


def harmonics(normals: F32) -> F32:
    """[.., 9] real spherical harmonics up to the second order of unit normals [.., 3], without their constants."""
    x, y, z = np.moveaxis(normals, -1, 0)
    return np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x - y * y, 3 * z * z - 1], axis=-1)


def frame_light(grey: F32, albedo: F32, basis: F32, weight: F32, usual: F64) -> F64:
    """[n, 9] the light of each frame by weighted least squares, where undecided the `usual` one [9].

    grey, weight: [n, P]. albedo: [P]. basis: [n, P, 9], `harmonics`.
    """
    columns = basis * albedo[:, None]
    weighted = (columns * weight[..., None]).transpose(0, 2, 1)
    normal = np.matmul(weighted, columns).astype(np.float64)
    ridge = RIDGE * np.maximum(np.einsum("nii->n", normal) / HARMONICS, 1e-6)[:, None]
    normal += ridge[..., None] * np.eye(HARMONICS)
    right = np.matmul(weighted, grey[..., None])[..., 0] + ridge * usual
    return np.linalg.solve(normal, right[..., None])[..., 0]


def shaded(albedo: F32, basis: F32, light: F64) -> F32:
    """[n, P] grey levels expected of the albedo [P] under each frame's light [n, 9]; basis: [n, P, 9]."""
    return albedo * np.matmul(basis, light[..., None].astype(np.float32))[..., 0]


def appearance(grey: F32, basis: F32, seen: F32) -> tuple[F32, F64]:
    """Albedo [P] and usual light [9] of the skin in n frames: each in turn, the other known.

    grey, seen: [n, P]. basis: [n, P, 9], `harmonics`. Points that no frame shows have albedo 0.
    """
    albedo, weight, usual = np.ones(grey.shape[1], np.float32), seen, np.zeros(HARMONICS)
    for _ in range(ROUNDS):
        light = frame_light(grey, albedo, basis, weight, usual)
        usual = np.median(light, axis=0)
        bright = np.maximum(shaded(np.ones_like(albedo), basis, light), 1.0)
        albedo = (weight * bright * grey).sum(0) / np.maximum((weight * bright**2).sum(0), 1e-6)
        error = grey - albedo * bright
        spread = float(np.median(np.abs(error[seen > 0]))) if seen.any() else 0.0
        weight = seen / (1 + (error / (OUTLIER * spread + 1.0)) ** 2)
    return albedo, usual
