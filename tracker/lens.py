"""What stands between a pinhole and a picture: a lens that draws straight lines bent, and shots that are enlarged."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
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
        if not self.distortion or not flat.size:
            return flat
        matrix, coefficients = self._opencv()
        seen = flat.reshape(-1, 1, 2)
        straight = cv2.undistortPoints(seen, matrix, coefficients, P=matrix, criteria=CONVERGED)
        return straight.reshape(flat.shape)

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
        return cv2.undistort(rgb, *self._opencv()) if self.distortion else rgb

    def ends(self, size: tuple[int, int], frames: NDArray[np.integer]) -> F64:
        """[n, 2, 2] px, first and last (x, y) that the frames [n] show of pictures of this size, without the zoom."""
        corners = np.tile([[0.0, 0.0], [size[0] - 1, size[1] - 1]], (len(frames), 1, 1))
        return np.clip(self._smaller(corners, frames), corners[:, :1], corners[:, 1:])

    def times(self, frames: NDArray[np.integer]) -> F64:
        """[n] times that the pictures of the frames [n] are enlarged."""
        return self.zoom[frames, 0].astype(np.float64) if len(self.zoom) else np.ones(len(frames))

    def _smaller(self, xy: F64, frames: NDArray[np.integer]) -> F64:
        """Points [n, ..., 2] px of the frames [n] without the zoom."""
        if not len(self.zoom):
            return xy
        about = self.zoom[frames, 1:].astype(np.float64).reshape(-1, *[1] * (xy.ndim - 2), 2)
        return about + (xy - about) / self.times(frames).reshape(-1, *[1] * (xy.ndim - 1))

    def _opencv(self) -> tuple[F64, F64]:
        """Camera matrix [3, 3] and distortion [5]."""
        k1, k2, k3 = (*self.distortion, 0.0, 0.0)[:3]
        (cx, cy), f = self.principal_px, self.focal_px
        return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]), np.array([k1, k2, 0.0, 0.0, k3])
