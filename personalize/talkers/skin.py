"""Skin and surroundings for rendered talkers: texture that feature tracks can hold on to."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tracker.raster import Raster

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

VOXEL_M = 0.0006
SIDE = 128  # voxels; the texture repeats every 77 mm
MOTTLE = ((1.2, 0.030), (3.0, 0.040), (9.0, 0.040))  # (size in voxels, contrast)
FRECKLES = 900  # in the whole block
FRECKLE_SIZE = 1.6  # voxels
FRECKLE_DEPTH = 0.22


def skin_block(seed: int) -> F32:
    """A block [128, 128, 128] of reflectance factors about 1 that repeats: mottling of several sizes, freckles."""
    random = np.random.default_rng((seed, 3))
    block = np.ones((SIDE, SIDE, SIDE), np.float32)
    for size, contrast in MOTTLE:
        grain = gaussian_filter(random.standard_normal(block.shape).astype(np.float32), size, mode="wrap")
        block += contrast * grain / grain.std()
    spots = np.zeros_like(block)
    place = random.integers(0, SIDE, (FRECKLES, 3))
    spots[tuple(place.T)] = random.uniform(0.3, 1.0, FRECKLES)
    spots = gaussian_filter(spots, FRECKLE_SIZE, mode="wrap")
    return np.clip(block - FRECKLE_DEPTH * np.minimum(spots / (0.6 * spots.max()), 1), 0.5, 1.4)


def backdrop(size: tuple[int, int], seed: int) -> U8:
    """A blurred room [H, W, 3] u8: a gradient with soft shapes, no two alike. size: (width, height) px."""
    random = np.random.default_rng((seed, 4))
    width, height = size
    picture = np.empty((height, width, 3), np.float32)
    picture[:] = random.uniform(90, 120) + random.uniform(-12, 12, 3)
    picture += np.linspace(25, -25, height, dtype=np.float32)[:, None, None]
    for _ in range(14):
        corner = random.uniform(-0.1, 1.0, 2) * (width, height)
        extent = random.uniform(0.06, 0.35, 2) * (width, height)
        (left, top), (right, bottom) = corner.astype(int), (corner + extent).astype(int)
        colour = random.uniform(-35, 35) + random.uniform(-12, 12, 3)
        picture[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] += colour
    picture = cv2.GaussianBlur(picture, (0, 0), 0.012 * width)
    return np.clip(picture, 0, 255).astype(np.uint8)


def texture(picture: U8, raster: Raster, faces: NDArray[np.int32], places: F32, block: F32) -> None:
    """Multiply the skin's texture into a shaded picture [H, W, 3], in place.

    places: [D, 3] m, where each vertex lies in the block: the neutral shape, so that the texture sticks to the skin.
    """
    _texture(picture, raster.triangle, raster.barycentric, faces, places / np.float32(VOXEL_M), block)


@njit(cache=True)
def _texture(picture, triangle, barycentric, faces, places, block):  # type: ignore[no-untyped-def]
    height, width = triangle.shape
    side = len(block)
    cell = np.empty(3, np.int64)
    for y in range(height):
        for x in range(width):
            if triangle[y, x] < 0:
                continue
            corner = faces[triangle[y, x]]
            for axis in range(3):
                place = np.float32(0)
                for k in range(3):
                    place += barycentric[y, x, k] * places[corner[k], axis]
                cell[axis] = int(np.floor(place)) % side
            # The nearest voxel will do: a voxel is about a pixel. The picture is a square root of light.
            factor = np.sqrt(block[cell[0], cell[1], cell[2]])
            for channel in range(3):
                picture[y, x, channel] = np.uint8(min(picture[y, x, channel] * factor + 0.5, 255))
