"""Lines across the mouth, one through each pair of inner-lip landmarks, and the colours of a picture along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tracker.energy import LIP_PAIRS, rotation_matrix
from tracker.track import F64
from tracker.view import LOG, U8, sampled

# Outer edges of the upper and the lower lip above and below each pair of the inner ones.
OUTER_PAIRS = (
    *((185, 146), (40, 91), (39, 181), (37, 84), (0, 17)),
    *((267, 314), (269, 405), (270, 321), (409, 375)),
)
STEP_MM, REACH_MM = 0.4, 17.0  # of the samples along a line, to both sides of the inner lips' middle
SAMPLES = np.arange(-REACH_MM, REACH_MM + STEP_MM / 2, STEP_MM)
FINE_REACH_MM = 12.0
FLAT = 1e-5  # of squared LOG: two faces behind fog that leaves a third of the contrast have .001


@dataclass(frozen=True)
class LipLines:
    """Lines across the mouth of n frames, one through each of the Q pairs of inner-lip landmarks, down the face.

    middle: [n, Q, 2] px, between the pair. step: [n, 2] px per mm at the face's distance, in the picture's plane: a
    face that nods shows fewer of its own. marks: [n, Q, 4] such mm along the line: outer upper, inner upper, inner
    lower and outer lower edge by the landmarks.
    """

    middle: F64
    step: F64
    marks: F64

    @classmethod
    def across(cls, observed: F64, px_per_m: F64, x: F64) -> LipLines:
        """Through landmarks [n, 478, 2] px of faces of the scale px_per_m [n], in the poses of x [n, U]."""
        up = rotation_matrix(x[:, -6:-3])[:, :2, 1]
        step = -1e-3 * px_per_m[:, None] * up / np.linalg.norm(up, axis=1, keepdims=True)
        (upper, lower), (above, below) = np.transpose(LIP_PAIRS), np.transpose(OUTER_PAIRS)
        middle = (observed[:, upper] + observed[:, lower]) / 2
        edges = (
            np.stack([observed[:, row] for row in (above, upper, lower, below)], axis=2) - middle[:, :, None]
        )
        marks = np.einsum("nqex,nx->nqe", edges, step) / (step**2).sum(1)[:, None, None]
        return cls(middle, step, marks)

    def read(self, rgb: U8, row: int) -> U8:
        """[Q, S, 3] u8: the colours of a picture [H, W, 3] along the lines of frame `row`."""
        places = self.middle[row][:, None] + SAMPLES[:, None] * self.step[row]
        return sampled(rgb, places, STEP_MM * float(np.linalg.norm(self.step[row])))

    def widths(self, observed: F64) -> F64:
        """[n, Q] mm, how far apart landmarks [n, 478, 2] px have the inner lips."""
        upper, lower = np.transpose(LIP_PAIRS)
        apart = observed[:, lower] - observed[:, upper]
        return np.einsum("nqx,nx->nq", apart, self.step) / (self.step**2).sum(1, keepdims=True)

    def opened(self, observed: F64, widths: F64) -> F64:
        """The landmarks [n, 478, 2] px with the inner lips moved `widths` [n, Q] mm apart."""
        out = observed.copy()
        move = ((widths - self.widths(observed)) / 2)[..., None] * self.step[:, None]
        upper, lower = np.transpose(LIP_PAIRS)
        out[:, upper] -= move
        out[:, lower] += move
        return out


def fineness(colours: U8) -> float:
    """How fine the light about the mouth is, along lines [n, Q, S, 3]: .25 of sharp edges, .06 of smooth slopes.

    By how much more two samples differ .8 mm apart than .4, against 3.2 mm apart and 1.6 (structure functions); what is
    noise cancels. Of the middle lines, where they cross the lips. NaN where nothing is to be seen.
    """
    light = LOG[colours[:, 2:-2, np.abs(SAMPLES) <= FINE_REACH_MM]].mean(-1)
    apart = {k: float(((light[..., k:] - light[..., :-k]) ** 2).mean()) for k in (1, 2, 4, 8)}
    coarse = apart[8] - apart[4]
    return (apart[2] - apart[1]) / coarse if coarse > FLAT else np.nan
