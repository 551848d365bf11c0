"""Triangles to pixels on the CPU: projection, a z-buffer, smooth shading.

Camera frame: OpenCV (x right, y down, z forward), metres. Pixel centres at integers. A triangle faces the
camera when its corners run counter-clockwise as seen on the screen.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

# Direction towards the light in the camera frame: from above, a little to the left of the camera.
LIGHT = (-0.35, -0.55, -0.76)
AMBIENT = 0.35
BACKGROUND = (60, 64, 72)


@dataclass(frozen=True)
class Raster:
    """What each pixel of a [H, W] picture sees.

    triangle: [H, W] i32, index of the triangle, -1 where there is none.
    barycentric: [H, W, 3] f32, weights of its corners on the surface (perspective-correct), 0 where none.
    depth: [H, W] f32 m, +inf where none.
    """

    triangle: NDArray[np.int32]
    barycentric: F32
    depth: F32


def project(points: NDArray[np.floating], focal: float, principal: ArrayLike) -> NDArray[np.floating]:
    """Pinhole projection, [.., 3] m in the camera frame -> [.., 2] px: focal · (x, y) / z + principal."""
    return focal * points[..., :2] / points[..., 2:] + np.asarray(principal, points.dtype)


def rasterize(vertices_px: NDArray[np.floating], faces: NDArray[np.int32], size: tuple[int, int]) -> Raster:
    """Find the nearest triangle in every pixel, of those that face the camera.

    vertices_px: [D, 3], x and y in px, depth > 0 in m. faces: [F, 3] i32. size: (width, height) px.
    Triangles with a corner behind the camera or not finite are skipped.
    """
    width, height = size
    triangle = np.full((height, width), -1, np.int32)
    barycentric = np.zeros((height, width, 3), np.float32)
    inverse_depth = np.zeros((height, width), np.float32)
    vertices = np.ascontiguousarray(vertices_px, np.float32)
    _fill(vertices, np.ascontiguousarray(faces, np.int32), triangle, barycentric, inverse_depth)
    depth = np.full_like(inverse_depth, np.inf)
    np.divide(1, inverse_depth, out=depth, where=inverse_depth > 0)
    return Raster(triangle, barycentric, depth)


def vertex_normals(vertices: NDArray[np.floating], faces: NDArray[np.int32]) -> F32:
    """[D, 3] unit normals, the area-weighted mean of the triangles around each vertex."""
    return _normals(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))


def interpolate(raster: Raster, faces: NDArray[np.int32], field: F32) -> F32:
    """[H, W, C] values of a vertex field [D, C] f32 on the surface that each pixel sees, 0 where there is none."""
    values = np.zeros((*raster.triangle.shape, field.shape[1]), np.float32)
    corners = np.ascontiguousarray(faces, np.int32)
    _spread(raster.triangle, raster.barycentric, corners, np.ascontiguousarray(field, np.float32), values)
    return values


def shade(
    raster: Raster,
    faces: NDArray[np.int32],
    vertices_cam: NDArray[np.floating],
    albedo: U8,
    background: U8 | tuple[int, int, int] = BACKGROUND,
    light: tuple[float, float, float] = LIGHT,
    ambient: float = AMBIENT,
) -> U8:
    """Colour a raster with smooth normals under one distant light and an even sky; [H, W, 3] u8 RGB.

    vertices_cam: [D, 3] m. albedo: [D, 3] u8 RGB, sRGB-like. background: a picture [H, W, 3] or one colour.
    light: direction towards the light, camera frame. ambient: share of the light that comes from everywhere.
    """
    picture = np.empty((*raster.triangle.shape, 3), np.uint8)
    picture[:] = np.asarray(background, np.uint8)
    direction = np.asarray(light, np.float32) / np.float32(np.linalg.norm(light))
    normals = vertex_normals(vertices_cam, faces)
    # Squares stand for linear light: close to sRGB's curve and cheap.
    reflectance = (albedo.astype(np.float32) / 255) ** 2
    brightness = ambient + (1 - ambient) * np.maximum(normals @ direction, 0)[:, None]
    corners = np.ascontiguousarray(faces, np.int32)
    _paint(raster.triangle, raster.barycentric, corners, reflectance, brightness.astype(np.float32), picture)
    return picture


def render(
    vertices_cam: NDArray[np.floating],
    faces: NDArray[np.int32],
    albedo: U8,
    focal: float,
    principal: tuple[float, float],
    size: tuple[int, int],
    background: U8 | tuple[int, int, int] = BACKGROUND,
    samples: int = 2,
) -> U8:
    """A smooth-edged picture [H, W, 3] u8 of a mesh, rasterized and shaded at `samples` times the size.

    vertices_cam: [D, 3] m. focal, principal: px. size: (width, height) px. background: a picture or a colour.
    """
    large = (size[0] * samples, size[1] * samples)
    # Pixel centres are at integers: the centre of pixel 0 is at (samples - 1) / 2 of the finer grid.
    centre = [samples * value + (samples - 1) / 2 for value in principal]
    pixels = np.concatenate([project(vertices_cam, focal * samples, centre), vertices_cam[:, 2:]], axis=1)
    raster = rasterize(pixels, faces, large)
    if isinstance(background, np.ndarray):
        background = cv2.resize(background, large, interpolation=cv2.INTER_NEAREST)
    picture = shade(raster, faces, vertices_cam, albedo, background)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if samples > 1 else picture


@njit(cache=True, nogil=True)
def _fill(vertices, faces, triangle, barycentric, inverse_depth):  # type: ignore[no-untyped-def]
    height, width = triangle.shape
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        bx, by, bz = vertices[j, 0], vertices[j, 1], vertices[j, 2]
        cx, cy, cz = vertices[k, 0], vertices[k, 1], vertices[k, 2]
        if not (az > 0 and bz > 0 and cz > 0):
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        # y runs down: what faces the camera has a negative area. The test also refuses what is not finite.
        if not -1e12 < area < 0:
            continue
        left = max(0, int(np.ceil(max(min(ax, bx, cx), -1e6))))
        right = min(width - 1, int(np.floor(min(max(ax, bx, cx), 1e6))))
        top = max(0, int(np.ceil(max(min(ay, by, cy), -1e6))))
        bottom = min(height - 1, int(np.floor(min(max(ay, by, cy), 1e6))))
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                u = (bx - x) * (cy - y) - (by - y) * (cx - x)
                v = (cx - x) * (ay - y) - (cy - y) * (ax - x)
                w = (ax - x) * (by - y) - (ay - y) * (bx - x)
                if u * area < 0 or v * area < 0 or w * area < 0:
                    continue
                # 1 / depth and weight / depth are linear on the screen.
                p, q, r = u / area / az, v / area / bz, w / area / cz
                nearness = p + q + r
                if nearness > inverse_depth[y, x]:
                    inverse_depth[y, x] = nearness
                    triangle[y, x] = f
                    barycentric[y, x, 0] = p / nearness
                    barycentric[y, x, 1] = q / nearness
                    barycentric[y, x, 2] = r / nearness


@njit(cache=True, nogil=True)
def _normals(vertices, faces):  # type: ignore[no-untyped-def]
    normals = np.zeros_like(vertices)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        for axis in range(3):
            n, m = (axis + 1) % 3, (axis + 2) % 3
            cross = (vertices[j, n] - vertices[i, n]) * (vertices[k, m] - vertices[i, m])
            cross -= (vertices[j, m] - vertices[i, m]) * (vertices[k, n] - vertices[i, n])
            normals[i, axis] += cross
            normals[j, axis] += cross
            normals[k, axis] += cross
    for i in range(len(normals)):
        length = np.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2)
        if length > 0:
            normals[i] /= length
    return normals


@njit(cache=True, nogil=True)
def _spread(triangle, barycentric, faces, field, values):  # type: ignore[no-untyped-def]
    height, width = triangle.shape
    for y in range(height):
        for x in range(width):
            if triangle[y, x] >= 0:
                for channel in range(field.shape[1]):
                    values[y, x, channel] = _value(triangle, barycentric, faces, field, y, x, channel)


@njit(cache=True, nogil=True)
def _paint(triangle, barycentric, faces, reflectance, brightness, picture):  # type: ignore[no-untyped-def]
    height, width = triangle.shape
    for y in range(height):
        for x in range(width):
            if triangle[y, x] >= 0:
                light = _value(triangle, barycentric, faces, brightness, y, x, 0)
                for channel in range(3):
                    value = _value(triangle, barycentric, faces, reflectance, y, x, channel)
                    picture[y, x, channel] = np.uint8(min(255 * np.sqrt(value * light) + 0.5, 255))


@njit(cache=True, nogil=True)
def _value(triangle, barycentric, faces, field, y, x, channel):  # type: ignore[no-untyped-def]
    """One channel of a vertex field on the surface that pixel (x, y) sees."""
    value = np.float32(0)
    for k in range(3):
        value += barycentric[y, x, k] * field[faces[triangle[y, x], k], channel]
    return value
