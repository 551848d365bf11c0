"""The photometric energy of one face: grey levels of the skin against those expected, and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from tracker.appearance import Skin
from tracker.energy import POSE, Energy, LandmarkModel, Quadratic, left_jacobian, rotation_matrix
from tracker.track import F32, F64
from tracker.view import Rows, View


@dataclass(frozen=True)
class PhotometricEnergy:
    """The landmark energy of n frames, and with it the grey levels of P skin points.

    expected: [n, P] grey levels that the points should have. seen: [n, P] how much each counts, 0 where it is hidden.
    noise: [P] standard deviation of a grey level. robust: Cauchy scale in standard deviations. pull: [U] a force on
    every frame that is taken off: what moves all frames alike is an error of the albedo, not motion.
    """

    landmarks: Energy
    skin: Skin
    view: View
    expected: F32
    seen: F32
    noise: F32
    robust: float
    pull: F64

    def __len__(self) -> int:
        return len(self.expected)

    @property
    def model(self) -> LandmarkModel:
        """The head at the landmarks."""
        return self.landmarks.model

    def select(self, frames: Rows) -> PhotometricEnergy:
        """The energy of some of the frames."""
        return replace(
            self,
            landmarks=self.landmarks.select(frames),
            view=self.view.select(frames),
            expected=self.expected[frames],
            seen=self.seen[frames],
        )

    def value(self, shape: F64, x: F64) -> F64:
        """[n] the energy at x [n, U] of the subject with landmarks `shape` [L, 3] at rest."""
        skin = self._robust(self.grey(x) - self.expected)[0]
        return self.landmarks.value(shape, x) + skin - x @ self.pull

    def linearize(self, shape: F64, x: F64) -> Quadratic:
        """Gauss-Newton model at x [n, U]; the light, and with it `expected`, stays as it is."""
        whole, skin = self.landmarks.linearize(shape, x), self.linearize_skin(x)
        return Quadratic(
            whole.value + skin.value - x @ self.pull,
            whole.gradient + skin.gradient - self.pull,
            whole.hessian + skin.hessian,
        )

    def linearize_skin(self, x: F64) -> Quadratic:
        """The part of the grey levels alone, nothing taken off."""
        turned, camera = self._points(x)
        grey, slope = self.view.read(self._pixels(camera))
        residual = grey - self.expected
        value, weight = self._robust(residual)
        push = self._push(camera, slope)
        swing = np.cross(turned, push) @ left_jacobian(x[:, -6:-3])
        along = push @ rotation_matrix(x[:, -6:-3])
        slopes = np.concatenate([along, swing, push], axis=-1, dtype=np.float32)
        rows = np.empty((len(self.skin), x.shape[1] + 1), np.float32)
        square = np.empty((len(x), x.shape[1] + 1, x.shape[1] + 1))
        for n in range(len(x)):
            used = rows[: _jacobian(slopes[n], self.skin.expression, weight[n], residual[n], rows)]
            square[n] = used.T @ used
        return Quadratic(value, square[:, :-1, -1], square[:, :-1, :-1])

    def grey(self, x: F64) -> F32:
        """[n, P] grey levels of the pictures where the points lie at x [n, U]."""
        return self.view.read(self._pixels(self._points(x)[1]))[0]

    def _points(self, x: F64) -> tuple[F64, F64]:
        """[n, P, 3] m: turned about the landmarks' centre, and in the camera frame."""
        moved = self.skin.expression @ x[:, :-POSE].T.astype(np.float32)
        face = self.skin.rest + moved.transpose(2, 0, 1)
        turned = face @ rotation_matrix(x[:, -6:-3]).transpose(0, 2, 1)
        return turned, turned + x[:, None, -3:]

    def _pixels(self, camera: F64) -> F64:
        return self.landmarks.focal * camera[..., :2] / camera[..., 2:] + self.landmarks.principal

    def _push(self, camera: F64, slope: F32) -> F64:
        """[n, P, 3] grey levels per m: the picture's slope [n, P, 2] through the projection."""
        flat = self.landmarks.focal / camera[..., 2:] * slope
        depth = -(flat * camera[..., :2]).sum(-1, keepdims=True) / camera[..., 2:]
        return np.concatenate([flat, depth], axis=-1)

    def _robust(self, residual: F32) -> tuple[F64, F32]:
        """Half the Cauchy loss of each frame [n], and each point's weight [n, P] per squared grey level."""
        c2 = (np.float32(self.robust) * self.noise) ** 2
        square = residual**2 / c2
        scale = np.float32(0.5 * self.robust**2)
        loss = scale * (self.seen * np.log1p(square)).sum(1, dtype=np.float64)
        return loss, self.seen / (self.noise**2 * (1 + square))


@njit(cache=True)
def _jacobian(slopes, expression, weight, residual, rows):  # type: ignore[no-untyped-def]
    """Rows [derivatives by the unknowns, residual] of the points that count, times the root of their weight.

    slopes: [P, 9], derivative by a shift in the head frame, by rotation, by translation. Returns how many rows.
    """
    count, shapes = 0, expression.shape[2]
    for p in range(len(slopes)):
        if weight[p] <= 0:
            continue
        root, row = np.sqrt(weight[p]), rows[count]
        a, b, c = root * slopes[p, 0], root * slopes[p, 1], root * slopes[p, 2]
        x, y, z = expression[p]
        for k in range(shapes):
            row[k] = a * x[k] + b * y[k] + c * z[k]
        for k in range(6):
            row[shapes + k] = root * slopes[p, 3 + k]
        row[shapes + 6] = root * residual[p]
        count += 1
    return count
