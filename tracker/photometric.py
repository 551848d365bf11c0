"""The photometric energy of one face: grey levels of the skin against those expected, and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tracker.appearance import Skin
from tracker.energy import POSE, Energy, LandmarkModel, Quadratic, left_jacobian, rotation_matrix
from tracker.jacobian import add_squares
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
        skin = self.loss(self.grey(x) - self.expected)[0]
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
        turned, camera = self.points(x)
        grey, push = self.read(camera)
        residual = grey - self.expected
        value, weight = self.loss(residual)
        rotation, swing = rotation_matrix(x[:, -6:-3]), left_jacobian(x[:, -6:-3])
        square = np.zeros((len(x), x.shape[1] + 1, x.shape[1] + 1), np.float32)
        add_squares(
            *(turned, push, rotation.astype(np.float32), swing.astype(np.float32)),
            *(self.skin.expression, weight, residual, square),
        )
        whole = square.astype(np.float64)
        return Quadratic(value, whole[:, :-1, -1], whole[:, :-1, :-1])

    def grey(self, x: F64) -> F32:
        """[n, P] grey levels of the pictures where the points lie at x [n, U]."""
        return self.read(self.points(x)[1])[0]

    def points(self, x: F64) -> tuple[F32, F32]:
        """[n, P, 3] m: turned about the landmarks' centre, and in the camera frame."""
        expression = self.skin.expression
        moved = x[:, :-POSE].astype(np.float32) @ expression.reshape(-1, expression.shape[2]).T
        face = self.skin.rest + moved.reshape(len(x), -1, 3)
        turned = face @ rotation_matrix(x[:, -6:-3]).transpose(0, 2, 1).astype(np.float32)
        return turned, turned + x[:, None, -3:].astype(np.float32)

    def read(self, camera: F32) -> tuple[F32, F32]:
        """Grey levels [n, P] at points [n, P, 3] m of the camera frame, and their slopes [n, P, 3] per m."""
        return self.view.read(camera, self.landmarks.focal, self.landmarks.principal)

    def loss(self, residual: F32) -> tuple[F64, F32]:
        """Half the Cauchy loss of each frame [n], and each point's weight [n, P] per squared grey level."""
        c2 = (np.float32(self.robust) * self.noise) ** 2
        square = residual**2 / c2
        scale = np.float32(0.5 * self.robust**2)
        loss = scale * (self.seen * np.log1p(square)).sum(1, dtype=np.float64)
        return loss, self.seen / (self.noise**2 * (1 + square))
