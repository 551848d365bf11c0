"""The lens of a camera that does not draw straight lines straight, by OpenCV's radial model."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
CONVERGED = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)  # px


@dataclass(frozen=True)
class Lens:
    """distortion: up to three radial coefficients (k1, k2, k3), none for a pinhole. They go with the focal length and
    the principal point (px, pixel centres at integers) that they were calibrated with.
    """

    focal_px: float
    principal_px: tuple[float, float]
    distortion: tuple[float, ...]

    def points(self, xy: NDArray[np.floating]) -> F64:
        """Points [..., 2] px as a camera without distortion would see them."""
        flat = xy.astype(np.float64)
        if not self.distortion or not flat.size:
            return flat
        matrix, coefficients = self._opencv()
        seen = flat.reshape(-1, 1, 2)
        straight = cv2.undistortPoints(seen, matrix, coefficients, P=matrix, criteria=CONVERGED)
        return straight.reshape(flat.shape)

    def picture(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture as a camera without distortion would see it."""
        return cv2.undistort(rgb, *self._opencv()) if self.distortion else rgb

    def _opencv(self) -> tuple[F64, F64]:
        """Camera matrix [3, 3] and distortion [5]."""
        k1, k2, k3 = (*self.distortion, 0.0, 0.0)[:3]
        (cx, cy), f = self.principal_px, self.focal_px
        return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]), np.array([k1, k2, 0.0, 0.0, k3])
