"""A subject's colours at the vertices, learned from a few frames, and the face re-rendered with them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.appearance import MARGIN_M, appearance, frame_light, harmonics, shaded
from tracker.raster import interpolate, vertex_normals
from tracker.scene import U8, Scene
from tracker.track import F32, F64

Bool = NDArray[np.bool_]

BLUR_M = 0.0012  # standard deviation: what vertices a few mm apart can tell
FACING = 0.4  # cosine to the line of sight below which the blur brings in what is behind the face
TIMES_SEEN = 3  # a vertex seen in fewer of the frames has no albedo
OUTLIER = 12.0  # grey levels beyond which a vertex hardly tells the light: it is covered


@dataclass(frozen=True)
class Albedo:
    """vertices: [V] of the head, that were seen. colour: [V, 3] RGB, times the light in grey levels. usual: [3, 9]."""

    vertices: NDArray[np.int64]
    colour: F32
    usual: F64


@dataclass(frozen=True)
class Rendering:
    """The face as it should look, on the part of the picture that the scene's raster covers.

    colour: [h, w, 3]. known: [h, w], 255 where the surface was seen when the albedo was learned, else 0.
    blurred: [h, w, 3], that part of the picture as finely as the albedo can be.
    """

    colour: U8
    known: U8
    blurred: U8


def learn_albedo(scenes: Iterable[Scene]) -> Albedo:
    """The colours of the face's vertices from pictures of a clip, freed from the light of each."""
    looks = [(_seen(scene), *_look(scene, _blurred(scene))) for scene in scenes]
    seen = np.stack([look[0] for look in looks])
    known = np.flatnonzero(seen.sum(0) >= min(TIMES_SEEN, len(looks)))
    colour = np.stack([look[1][known] for look in looks])
    basis = np.stack([look[2][known] for look in looks])
    weight = seen[:, known].astype(np.float32)
    channels = [appearance(colour[..., k].astype(np.float32), basis, weight) for k in range(3)]
    return Albedo(
        known, np.stack([channel[0] for channel in channels], 1), np.stack([usual for _, usual in channels])
    )


def rerender(scene: Scene, albedo: Albedo) -> Rendering:
    """The subject's albedo in the light of this frame, which the vertices in sight tell."""
    blurred = _blurred(scene)
    colour, basis = (field[albedo.vertices] for field in _look(scene, blurred))
    weight = _seen(scene)[albedo.vertices].astype(np.float32)
    expected = np.zeros((len(scene.vertices), 3), np.float32)
    for k in range(3):
        one = (colour[None, :, k], albedo.colour[:, k], basis[None])
        level = shaded(*one[1:], frame_light(*one, weight[None], albedo.usual[k]))
        # Once more without what covers the face, which should not pass for light.
        sure = weight / (1 + ((level - one[0]) / OUTLIER) ** 2)
        expected[albedo.vertices, k] = shaded(*one[1:], frame_light(*one, sure, albedo.usual[k]))[0]
    known = np.zeros(len(scene.vertices), bool)
    known[albedo.vertices] = True
    # Raster's -1, where there is no triangle, is the last.
    mask = np.append(known[scene.faces].all(1), False).astype(np.uint8) * 255
    painted = interpolate(scene.raster, scene.faces, np.clip(expected, 0, 255))
    return Rendering(cv2.convertScaleAbs(painted), mask[scene.raster.triangle], blurred)


def _blurred(scene: Scene) -> U8:
    blurred: U8 = cv2.GaussianBlur(scene.part(scene.picture), (0, 0), max(0.5, BLUR_M * scene.px_per_m))
    return blurred


def _look(scene: Scene, blurred: U8) -> tuple[F32, F32]:
    """Grey levels [D, 3] of the picture at the vertices and `harmonics` [D, 9] of their normals."""
    at = (scene.pixels[:, :2] - scene.low).astype(np.float32)
    colour = cv2.remap(blurred, at[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    return colour.astype(np.float32), harmonics(vertex_normals(scene.vertices, scene.faces))


def _seen(scene: Scene) -> Bool:
    """[D] the vertices that the picture shows, not too obliquely."""
    height, width = scene.raster.depth.shape
    at = np.round(scene.pixels[:, :2] - scene.low)
    inside: Bool = np.all((at >= 0) & (at < (width, height)), axis=1)
    column, row = np.where(inside[:, None], at, 0).astype(int).T
    depth = scene.raster.depth[row, column]
    normal = vertex_normals(scene.vertices, scene.faces)
    facing = -(normal * scene.vertices).sum(1) / np.linalg.norm(scene.vertices, axis=1)
    # A vertex of the rim may fall beside the raster's surface, where the depth is infinite.
    return inside & np.isfinite(depth) & (scene.vertices[:, 2] < depth + MARGIN_M) & (facing > FACING)
