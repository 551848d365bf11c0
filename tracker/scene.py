"""One frame of a track ready to be drawn on: a cut of the picture, and where the fitted face lies in it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from numpy.typing import NDArray
from torch import from_numpy

from tracker.head import HeadModel
from tracker.raster import Raster, project, rasterize
from tracker.track import F32, Landmarks, Track

U8 = NDArray[np.uint8]

OUTSIDE = (30, 30, 30)


@dataclass(frozen=True)
class Crop:
    """The part of a picture that is shown: point q of the picture is at (q - origin + 1/2) * scale - 1/2.

    origin: (x, y) and extent: (width, height) of the part in px of the picture, which it may overhang. size: (width,
    height) in px as shown.
    """

    origin: tuple[int, int]
    extent: tuple[int, int]
    size: tuple[int, int]

    @property
    def scale(self) -> F32:
        """[2] px shown per px of the picture, along x and y."""
        return np.divide(self.size, self.extent, dtype=np.float32)

    def picture(self, rgb: U8) -> U8:
        """The part of rgb [H, W, 3] at its size; what lies outside of rgb is dark."""
        low, high = np.array(self.origin), np.array(self.origin) + self.extent
        limit = np.array(rgb.shape[1::-1])
        first, last = np.clip(low, 0, limit), np.clip(high, 0, limit)
        if (first == last).any():
            return np.full((*self.size[::-1], 3), OUTSIDE, np.uint8)
        part = rgb[first[1] : last[1], first[0] : last[0]]
        if (missing := np.concatenate([first - low, high - last])).any():
            left, top, right, bottom = missing.tolist()
            part = cv2.copyMakeBorder(part, top, bottom, left, right, cv2.BORDER_CONSTANT, value=OUTSIDE)
        way = cv2.INTER_CUBIC if self.scale[1] > 1 else cv2.INTER_AREA
        shown: U8 = cv2.resize(part, self.size, interpolation=way)
        return shown

    def place(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Points [.., 2] px of the picture -> px as shown."""
        return (points - np.array(self.origin, np.float32) + 0.5) * self.scale - 0.5


@dataclass(frozen=True)
class Scene:
    """The fitted face in one cut picture [H, W, 3] u8.

    vertices: [D, 3] m, camera frame. pixels: [D, 3], their px in the picture and depth in m. faces: [F, 3] of the
    face region: the skull has no evidence. low: (x, y) px, the corner of the part that `raster` covers: the face.
    detected, fitted: [L, 2] px, the embedded landmarks, and px_per_m at the face.
    """

    picture: U8
    vertices: F32
    pixels: F32
    faces: NDArray[np.int32]
    low: tuple[int, int]
    raster: Raster
    detected: F32
    fitted: F32
    px_per_m: float

    def part(self, picture: U8) -> U8:
        """A view of the part of a picture [H, W, 3] that `raster` covers."""
        (x, y), (height, width) = self.low, self.raster.triangle.shape
        return picture[y : y + height, x : x + width]


def place(track: Track, frame: int, head: HeadModel) -> tuple[F32, F32]:
    """Vertices [D, 3] and embedded landmarks [L, 3] of one frame in the camera frame, m."""
    posed = {"jaw": track.jaw[frame], "neck": track.neck[frame], "eyes": track.eyes[frame]}
    rotation = axis_angle_to_rotation_matrix(from_numpy(track.rotation[frame : frame + 1]))[0].numpy()
    vertices = head.vertices(track.identity, track.expression[frame], **posed)
    embedding = head.landmark_embedding
    landmarks = np.einsum("lc,lcx->lx", embedding.barycentric, vertices[head.faces[embedding.triangles]])
    translation = track.translation[frame]
    return vertices @ rotation.T + translation, landmarks @ rotation.T + translation


def scene(rgb: U8, crop: Crop, track: Track, frame: int, landmarks: Landmarks, head: HeadModel) -> Scene:
    """The scene of one frame whose picture is rgb [H, W, 3] u8."""
    vertices, points = place(track, frame, head)
    pixels = np.concatenate(
        [crop.place(project(vertices, track.focal, track.principal)), vertices[:, 2:]], axis=1
    ).astype(np.float32)
    face = head.regions["face"]
    shown = np.zeros(len(vertices), bool)
    shown[face] = True
    faces = head.faces[shown[head.faces].all(1)]
    size = np.array(crop.size)
    low = np.clip(np.floor(pixels[face, :2].min(0)).astype(int), 0, size - 1)
    high = np.clip(np.ceil(pixels[face, :2].max(0)).astype(int) + 1, low + 1, size)
    width, height = (high - low).tolist()
    return Scene(
        picture=crop.picture(rgb),
        vertices=vertices,
        pixels=pixels,
        faces=faces,
        low=(int(low[0]), int(low[1])),
        raster=rasterize(pixels - [*low, 0], faces, (width, height)),
        detected=crop.place(landmarks.points[frame, head.landmark_embedding.landmarks, :2]),
        fitted=crop.place(project(points, track.focal, track.principal)),
        px_per_m=float(crop.scale[1] * track.focal / track.translation[frame, 2]),
    )
