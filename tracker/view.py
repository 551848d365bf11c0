"""Pictures cut around the face at a scale of their own, blurred, and read between pixels with their slope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from tracker.halving import halved
from tracker.track import F32, F64

U8 = NDArray[np.uint8]
Index = NDArray[np.int64]
Rows = slice | Sequence[int] | Index

LARGEST = 2.0  # times the usual face: all windows are as large, and for a frame or two memory is not to grow
MARGIN = 1.15  # of the extent of the face's landmarks
# Of a grey level: light becomes a sum. Where it is dark, colours are noise.
LOG = np.log(np.arange(256, dtype=np.float32) + np.float32(8.0))
BLUR = 0.6  # standard deviation in times of how far samples lie apart, and no less than LEAST_BLUR_PX
LEAST_BLUR_PX = 0.5


def sampled(rgb: U8, places: F64, apart: float) -> U8:
    """[.., 3] u8: the colours of a picture [H, W, 3] at places [.., 2] px that lie so many px apart."""
    size = np.array(rgb.shape[1::-1])
    low = np.clip(np.floor(places.min((0, 1))).astype(int) - 4, 0, size - 1)
    high = np.clip(np.ceil(places.max((0, 1))).astype(int) + 5, low + 1, size)
    part = cv2.GaussianBlur(rgb[low[1] : high[1], low[0] : high[0]], (0, 0), max(BLUR * apart, LEAST_BLUR_PX))
    x, y = np.moveaxis((places - low).astype(np.float32), 2, 0)
    return cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@dataclass(frozen=True)
class Window:
    """Where the face lies in each of n pictures: q of the whole picture is at (q - origin + 1/2) * scale - 1/2.

    origin: [n, 2] px of the whole picture, whole numbers. scale: at most 1. size: (width, height) of what is cut out.
    ends: [n, 2, 2] px, first and last (x, y) that the whole picture shows.
    """

    origin: F64
    scale: float
    size: tuple[int, int]
    ends: F64

    @classmethod
    def around(cls, observed: F64, px_per_m: F64, finest_px_per_m: float, ends: F64) -> Window:
        """Windows of one size around landmarks [n, L, 2] px, shrunk to `finest_px_per_m` in the clip's median.

        They hold the largest face, but for one that is more than LARGEST times the usual.
        """
        low, high = observed.min(1), observed.max(1)
        scale = min(1.0, finest_px_per_m / float(np.median(px_per_m)))
        extent = np.minimum((high - low).max(0), LARGEST * np.median(high - low, axis=0))
        size = np.ceil(extent * MARGIN * scale).astype(int)
        origin = np.floor((low + high) / 2 - size / scale / 2)
        return cls(origin, scale, (int(size[0]), int(size[1])), ends)

    def select(self, rows: Rows) -> Window:
        """Those of some of the pictures."""
        return replace(self, origin=self.origin[rows], ends=self.ends[rows])

    def cut(self, rgb: U8, row: int) -> U8:
        """[height, width] u8 grey; outside of the picture its border goes on."""
        times = int(np.log2(1 / self.scale))
        rest = self.scale * 2**times
        low = self.origin[row].astype(int)
        high = low + [2**times * int(np.ceil(side / rest)) for side in self.size]
        limit = np.array(rgb.shape[1::-1])
        first, last = np.clip(low, 0, limit - 1), np.clip(high, 1, limit)
        last = np.maximum(last, first + 1)
        grey = cv2.cvtColor(rgb[first[1] : last[1], first[0] : last[0]], cv2.COLOR_RGB2GRAY)
        if (missing := np.concatenate([first - low, high - last])).any():
            left, top, right, bottom = np.maximum(missing, 0)
            grey = cv2.copyMakeBorder(grey, top, bottom, left, right, cv2.BORDER_REPLICATE)
        # By the scale and not to a size, to which it would be stretched.
        shrunk = cv2.resize(halved(grey, times), None, fx=rest, fy=rest, interpolation=cv2.INTER_AREA)
        return shrunk[: self.size[1], : self.size[0]]

    def own(self, row: int, margin: float) -> F64:
        """[2, 2] px, first and last (x, y) of a cut picture that it shows: beyond them the whole one's border goes on.

        margin: px farther in where it does, of a blur that takes the border along.
        """
        first, last = (self.ends[row] - self.origin[row] + 0.5) * self.scale - 0.5
        edge = np.array(self.size) - 1.0
        return np.stack([np.where(first > 0, first + margin, 0), np.where(last < edge, last - margin, edge)])

    def principal(self, principal: F64, row: int | slice) -> F64:
        """[2] px, the principal point in one cut picture, or [.., 2] in several."""
        return (principal - self.origin[row] + 0.5) * self.scale - 0.5


@dataclass(frozen=True)
class View:
    """n cut pictures through one blur, [n, h, w] f32 grey levels."""

    grey: F32
    window: Window

    @classmethod
    def blurred(cls, cuts: Sequence[U8], window: Window, sd_px: float) -> View:
        """sd_px: standard deviation of the blur in px of the cut pictures."""
        grey = np.empty((len(cuts), *cuts[0].shape), np.float32)
        for picture, cut in zip(grey, cuts):
            cv2.GaussianBlur(cut.astype(np.float32), (0, 0), sd_px, dst=picture)
        return cls(grey, window)

    def select(self, rows: Rows) -> View:
        """Some of the pictures."""
        return View(self.grey[rows], self.window.select(rows))

    def read(self, points: F32, focal: float, principal: F64) -> tuple[F32, F32]:
        """Grey levels [n, P] where points [n, P, 3] m of the camera frame lie, and their slopes [n, P, 3] per m.

        focal, principal: px of the whole picture.
        """
        value, slope = np.empty(points.shape[:2], np.float32), np.empty(points.shape, np.float32)
        centres = self.window.principal(principal, slice(None)).astype(np.float32)
        scaled = np.float32(focal * self.window.scale)
        for picture, places, centre, level, change in zip(self.grey, points, centres, value, slope):
            _bilinear(picture, places, scaled, centre, level, change)
        return value, slope


@njit(cache=True, nogil=True)
def _bilinear(picture, points, focal, centre, value, slope):  # type: ignore[no-untyped-def]
    """Outside of the picture the value is that of its border, the slope zero."""
    height, width = picture.shape
    half = np.float32(0.5)
    for p in range(len(points)):
        per_m = focal / points[p, 2]
        x, y = per_m * points[p, 0] + centre[0], per_m * points[p, 1] + centre[1]
        inside = 0 <= x < width - 1 and 0 <= y < height - 1
        i = min(max(int(np.floor(x)), 0), width - 2) if x == x else 0
        j = min(max(int(np.floor(y)), 0), height - 2) if y == y else 0
        u = min(max(x - np.float32(i), half * 0), half + half)
        v = min(max(y - np.float32(j), half * 0), half + half)
        a, b, c, d = picture[j, i], picture[j, i + 1], picture[j + 1, i], picture[j + 1, i + 1]
        top, bottom = a + (b - a) * u, c + (d - c) * u
        value[p] = top + (bottom - top) * v
        right = per_m * ((b - a) + ((d - c) - (b - a)) * v) if inside else half * 0
        down = per_m * (bottom - top) if inside else half * 0
        slope[p, 0], slope[p, 1] = right, down
        slope[p, 2] = -(right * points[p, 0] + down * points[p, 1]) / points[p, 2]
