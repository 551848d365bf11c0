"""Builds tracker/assets/head.landmarks.npz: where the landmarker's 478 points lie on the embedded head.

    python -m tools.build_embedding

Random heads are rendered from several sides, the landmarker reads the pictures, and its points are carried back through
the pixels onto the mesh. The median over heads and views, made symmetric, becomes the embedding, but for the upper lip,
which is thicker on this head than on people; heads that were not used measure it.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tracker.head import ASSET, HeadModel, LandmarkEmbedding, read_head
from tracker.landmark_indices import LEFT_EYE, MIRRORED, RIGHT_EYE
from tracker.landmarker import MIN_PRESENCE, FaceLandmarker, roi_from_face, roi_from_points
from tracker.raster import project, rasterize, render

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

HEADS, HELD_OUT, SEED = 24, 12, 7
YAWS_DEG = (-22.0, 0.0, 22.0)
HELD_OUT_YAWS_DEG = (-15.0, 5.0, 30.0)
SIZE, FOCAL, DISTANCE = 512, 1200.0, 0.75  # px, px, m
FINE = 4  # the mesh is looked up on a grid this much finer than the picture

TO_CAMERA = np.array([1, -1, -1], np.float32)  # head axes to OpenCV's, for a head seen from the front
CENTRE = ((SIZE - 1) / 2, (SIZE - 1) / 2)

# Points of the outline: the landmarker slides them over the skin as the head turns.
SLIDING = (93, 132, 234, 323, 361, 454, 127, 356, 162, 389, 227, 447)
INNER_UPPER = (78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308)
INNER_LOWER = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308)
OUTER_LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 185, 40, 39, 37, 0, 267, 269, 270, 409)
# From the inner upper lip outwards; the corners stay.
UPPER_RINGS = (
    (191, 80, 81, 82, 13, 312, 311, 310, 415),
    (183, 42, 41, 38, 12, 268, 271, 272, 407),
    (184, 74, 73, 72, 11, 302, 303, 304, 408),
    (185, 40, 39, 37, 0, 267, 269, 270, 409),
)
# By so much of its height the upper lip of people is thinner than this head's. Of 13 people filmed from the front the
# outer edge was seen 1.1 mm below the fitted one and the inner edge .8 above, though the identity may thin a lip: a
# third of its 10 mm would explain that. Half of it is left to the identity.
THINNER = 0.2
OVAL = (10, 338, 297, 332, 284, 251, 397, 365, 379, 378, 400, 377, 152)
RIGHT_IRIS, LEFT_IRIS = tuple(range(468, 473)), tuple(range(473, 478))


@dataclass(frozen=True)
class View:
    """One picture read: vertices [D, 3] m in the camera frame, points [478, 2] px."""

    vertices: F32
    points: F32


def look(head: HeadModel, count: int, yaws_deg: tuple[float, ...], seed: int) -> list[View]:
    """Render `count` random heads at some yaws under varied light and read their landmarks."""
    rng = np.random.default_rng(seed)
    landmarker = FaceLandmarker()
    views = []
    for identity in rng.standard_normal((count, len(head.identity_basis))):
        tint = np.clip(head.albedo * rng.uniform(0.55, 1.2), 0, 255).astype(np.uint8)
        for yaw in yaws_deg:
            angles = [np.deg2rad(yaw), np.deg2rad(rng.uniform(-8, 8))]
            turn = Rotation.from_euler("yx", angles).as_matrix().astype(np.float32)
            vertices = head.vertices(identity, np.zeros(len(head.expression_basis))) @ turn.T
            vertices = vertices * TO_CAMERA + np.array([0, 0, DISTANCE], np.float32)
            picture = render(vertices, head.faces, tint, FOCAL, CENTRE, (SIZE, SIZE))
            points = read(landmarker, picture)
            if points is not None:
                views.append(View(vertices, points[:, :2]))
    return views


def read(landmarker: FaceLandmarker, picture: NDArray[np.uint8]) -> F32 | None:
    """Landmarks [478, 3] px of the face in a picture, in the region that a film's later frames have; None without."""
    faces = landmarker.detector.detect(picture)
    if not faces:
        return None
    points, _, _ = landmarker.landmarks(picture, roi_from_face(faces[0]))
    points, presence, _ = landmarker.landmarks(picture, roi_from_points(points))
    return points if presence > MIN_PRESENCE else None


def carry_back(head: HeadModel, view: View) -> F64:
    """[478, 3] m: what each point sees, as a place on the template; NaN where it sees no face."""
    centre = [FINE * value + (FINE - 1) / 2 for value in CENTRE]
    pixels = np.concatenate([project(view.vertices, FINE * FOCAL, centre), view.vertices[:, 2:]], axis=1)
    raster = rasterize(pixels, head.faces, (FINE * SIZE, FINE * SIZE))
    x, y = np.clip(np.round(FINE * view.points + (FINE - 1) / 2), 0, FINE * SIZE - 1).astype(int).T
    triangle = raster.triangle[y, x]
    places = np.einsum("pc,pcx->px", raster.barycentric[y, x], head.template[head.faces[triangle]])
    return np.where(triangle[:, None] < 0, np.nan, places)


def settle(head: HeadModel, places: F64) -> tuple[NDArray[np.int32], F64]:
    """Landmarks kept [L] and their places [L, 3] m on the template: median, symmetric, inner lips on the lip edges.

    places: [views, 478, 3]. The rest of the upper lip lies THINNER nearer to its inner edge than it was seen. A point
    that half of the views see beside the face is dropped, and so is its twin.
    """
    seen = np.isfinite(places[..., 0]).mean(0)
    median = np.nanmedian(np.where(seen[:, None] > 0, places, 0), axis=0)
    symmetric = (median + median[MIRRORED] * [-1, 1, 1]) / 2
    for points, edge in ((INNER_UPPER, "upper_lip_edge"), (INNER_LOWER, "lower_lip_edge")):
        line = head.template[head.regions[edge]]
        # Both lips take the same x, so that partners meet when the mouth is shut.
        x = (symmetric[list(INNER_UPPER), 0] + symmetric[list(INNER_LOWER), 0]) / 2
        x[[0, -1]] = line[[0, -1], 0]
        symmetric[list(points)] = np.stack(
            [np.interp(x, line[:, 0], line[:, axis]) for axis in range(3)], axis=1
        )
    inner, *rings = (symmetric[list(ring)] for ring in UPPER_RINGS)
    for ring, seen_at in zip(UPPER_RINGS[1:], rings):
        symmetric[list(ring)] = seen_at + THINNER * (inner - seen_at)
    sure = (seen > 0.5) & (seen[MIRRORED] > 0.5) & ~np.isin(np.arange(len(seen)), SLIDING)
    kept = np.flatnonzero(sure).astype(np.int32)
    return kept, symmetric[kept]


def embed(head: HeadModel, landmarks: NDArray[np.int32], places: F64) -> LandmarkEmbedding:
    """The nearest places on the right part of the surface: irises on the eyeballs, everything else on the skin.

    The lips touch, so the nearest place may be the other lip's: each inner lip stays with the faces on its own edge.
    """
    balls = np.isin(head.faces, head.regions["eyes"]).all(1)
    inside = np.concatenate([head.regions[name] for name in ("eyes", "teeth", "tongue", "mouth")])
    skin = ~np.isin(head.faces, np.setdiff1d(inside, head.regions["lower_lip_edge"])).any(1)
    upper, lower = (
        np.isin(head.faces, head.regions[f"{lip}_lip_edge"][1:-1]).any(1) for lip in ("upper", "lower")
    )
    parts = {
        RIGHT_IRIS + LEFT_IRIS: balls,
        INNER_UPPER[1:-1]: skin & upper & ~lower,
        INNER_LOWER[1:-1]: skin & lower & ~upper,
    }
    rest = tuple(np.setdiff1d(landmarks, np.concatenate(list(parts))))
    triangles, shares = np.zeros(len(landmarks), np.int32), np.zeros((len(landmarks), 3), np.float32)
    for points, allowed in (parts | {rest: skin}).items():
        members = np.isin(landmarks, points)
        triangles[members], shares[members] = _nearest(head, np.flatnonzero(allowed), places[members])
    return LandmarkEmbedding(landmarks, triangles, shares, head.sha256)


def _nearest(head: HeadModel, faces: NDArray[np.intp], places: F64) -> tuple[NDArray[np.intp], F64]:
    """Triangle and barycentric weights of the point of some triangles nearest to each place."""
    corners = head.template[head.faces[faces]].astype(float)
    _, candidates = cKDTree(corners.mean(1)).query(places, k=40)
    near = corners[candidates]
    repeated = np.repeat(places, candidates.shape[1], axis=0)
    points = trimesh.triangles.closest_point(near.reshape(-1, 3, 3), repeated)
    distance = np.linalg.norm(points - repeated, axis=1).reshape(candidates.shape)
    best = distance.argmin(1)
    rows = np.arange(len(places))
    shares = trimesh.triangles.points_to_barycentric(
        near[rows, best], points.reshape(*candidates.shape, 3)[rows, best]
    )
    return faces[candidates[rows, best]], np.clip(shares, 0, 1) / np.clip(shares, 0, 1).sum(1, keepdims=True)


def measure(head: HeadModel, views: list[View]) -> F64:
    """[views, L] mm between the projected embedding and the points read, at the depth of the face."""
    embedding = head.landmark_embedding
    errors = []
    for view in views:
        points = np.einsum(
            "lc,lcx->lx", embedding.barycentric, view.vertices[head.faces[embedding.triangles]]
        )
        apart = project(points, FOCAL, CENTRE) - view.points[embedding.landmarks]
        errors.append(1e3 * np.linalg.norm(apart, axis=1) * points[:, 2] / FOCAL)
    return np.array(errors)


def report(head: HeadModel, errors: F64) -> None:
    """Print the median of groups of landmarks."""
    kept = head.landmark_embedding.landmarks
    groups: dict[str, tuple[int, ...]] = {
        "all": tuple(kept),
        "inner lips": INNER_UPPER + INNER_LOWER,
        "outer lips": OUTER_LIPS,
        "eyes": LEFT_EYE + RIGHT_EYE,
        "irises": RIGHT_IRIS + LEFT_IRIS,
        "oval": OVAL,
    }
    print(f"{len(kept)} landmarks; held-out heads, {len(errors)} views:")
    for name, members in groups.items():
        chosen = errors[:, np.flatnonzero(np.isin(kept, members))]
        print(f"  {name}: median {np.median(chosen):.2f} mm, mean {chosen.mean():.2f} mm")


def main() -> None:
    """Look, settle, embed, measure, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--head", type=Path, default=ASSET)
    head = read_head(path := parser.parse_args().head)
    places = np.array([carry_back(head, view) for view in look(head, HEADS, YAWS_DEG, SEED)])
    embedding = embed(head, *settle(head, places))
    head = replace(head, landmark_embedding=embedding)
    report(head, measure(head, look(head, HELD_OUT, HELD_OUT_YAWS_DEG, SEED + 1)))
    out = path.with_suffix(".landmarks.npz")
    np.savez_compressed(
        out,
        landmarks=embedding.landmarks,
        triangles=embedding.triangles,
        barycentric=embedding.barycentric,
        head_sha256=np.str_(embedding.head_sha256),
    )
    print(f"{out}: {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
