"""What stands between a pinhole and a picture: a lens that draws straight lines bent, and shots that are enlarged."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
EDGE = 65  # points along an edge
CONVERGED = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)  # px


def never() -> F32:
    """The zoom of a clip in which no picture is enlarged."""
    return np.zeros((0, 3), np.float32)


@dataclass(frozen=True)
class Lens:
    """distortion: up to three radial coefficients (k1, k2, k3) of OpenCV's model, none for a pinhole. They go with the
    focal length and the principal point (px, pixel centres at integers) that they were calibrated with.

    zoom: [T, 3] times that each frame's picture is enlarged, about (x, y) px; [0, 3] where none is.
    """

    focal_px: float
    principal_px: tuple[float, float]
    distortion: tuple[float, ...]
    zoom: F32 = field(default_factory=never)

    def points(self, xy: NDArray[np.floating], frames: NDArray[np.integer]) -> F64:
        """Points [n, ..., 2] px of the frames [n] as a camera without distortion and zoom would see them."""
        flat = self._smaller(xy.astype(np.float64), frames)
        return self._straight(flat) if self.distortion and flat.size else flat

    def picture(self, rgb: NDArray[np.uint8], frame: int) -> NDArray[np.uint8]:
        """A frame's picture as a camera without distortion and zoom would see it."""
        if len(self.zoom) and self.zoom[frame, 0] != 1:
            times, x, y = self.zoom[frame].tolist()
            if times > 1:  # what is too fine for the smaller picture
                rgb = np.asarray(cv2.GaussianBlur(rgb, (0, 0), 0.5 * (times**2 - 1) ** 0.5), np.uint8)
            to_picture = np.array([[times, 0, x - times * x], [0, times, y - times * y]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            rgb = np.asarray(
                cv2.warpAffine(
                    rgb, to_picture, rgb.shape[1::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
                ),
                np.uint8,
            )
        if not self.distortion:
            return rgb
        maps = _straightened(self.focal_px, self.principal_px, self.distortion, rgb.shape[1::-1])
        return np.asarray(cv2.remap(rgb, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)

    def ends(self, size: tuple[int, int], frames: NDArray[np.integer]) -> F64:
        """[n, 2, 2] px, first and last (x, y) that the frames [n] show of pictures of this size, see `picture`."""
        last = np.array(size, np.float64) - 1
        corners = np.tile([np.zeros(2), last], (len(frames), 1, 1))
        shown = np.clip(self._smaller(corners, frames), corners[:, :1], corners[:, 1:])
        if self.distortion:
            along = np.linspace(0, 1, EDGE)[:, None] * last
            first, beyond = along * (0, 1), along * (1, 0)  # left and upper edge
            left, top = self._straight(first)[:, 0].max(), self._straight(beyond)[:, 1].max()
            right = self._straight(first + last * (1, 0))[:, 0].min()
            bottom = self._straight(beyond + last * (0, 1))[:, 1].min()
            shown = np.clip(shown, (left, top), (right, bottom))
        return shown

    def times(self, frames: NDArray[np.integer]) -> F64:
        """[n] times that the pictures of the frames [n] are enlarged."""
        return self.zoom[frames, 0].astype(np.float64) if len(self.zoom) else np.ones(len(frames))

    def _smaller(self, xy: F64, frames: NDArray[np.integer]) -> F64:
        """Points [n, ..., 2] px of the frames [n] without the zoom."""
        if not len(self.zoom):
            return xy
        about = self.zoom[frames, 1:].astype(np.float64).reshape(-1, *[1] * (xy.ndim - 2), 2)
        return about + (xy - about) / self.times(frames).reshape(-1, *[1] * (xy.ndim - 1))

    def _straight(self, xy: F64) -> F64:
        """Points [..., 2] px without the distortion."""
        matrix, coefficients = _opencv(self.focal_px, self.principal_px, self.distortion)
        seen = xy.reshape(-1, 1, 2)
        straight = cv2.undistortPoints(seen, matrix, coefficients, P=matrix, criteria=CONVERGED)
        return straight.reshape(xy.shape)


def _opencv(
    focal_px: float, principal_px: tuple[float, float], distortion: tuple[float, ...]
) -> tuple[F64, F64]:
    """Camera matrix [3, 3] and distortion [5]."""
    k1, k2, k3 = (*distortion, 0.0, 0.0)[:3]
    (cx, cy), f = principal_px, focal_px
    return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]), np.array([k1, k2, 0.0, 0.0, k3])


@lru_cache(maxsize=1)
def _straightened(
    focal_px: float, principal_px: tuple[float, float], distortion: tuple[float, ...], size: tuple[int, int]
) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Where in a picture of this size (width, height) each pixel of the straight one is, as cv2.remap has it."""
    matrix, coefficients = _opencv(focal_px, principal_px, distortion)
    return cv2.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_16SC2)
