"""Small patches found again in later pictures, by their fine texture.

Inverse compositional Lucas-Kanade (Baker and Matthews, "Lucas-Kanade 20 years on", 2004) for the shift alone; the
caller says how a patch is bent meanwhile. Shading, gloss and contours, which slide over a face that turns, are coarse
and strong, pores and freckles fine and weak: the pictures compared hold the fine part only, at equal strength all over.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.track import F32, F64

HALF = 9  # px, of the side of a patch
FINE_PX, COARSE_PX = 0.8, 3.0  # blurs between which the texture lies
STRENGTH_PX = 6.0  # blur over which it is levelled
NOISE = 1.0  # grey levels: weaker texture is not raised to the strength of the rest
ITERATIONS = 10
LONGEST_STEP, SETTLED = 1.0, 0.02  # px
EDGE = 0.2  # ratio of the gradients' eigenvalues: below it a patch slides along its edge
MIN_CORRELATION = 0.7
MAX_SHIFT = 3.0  # px, from where a patch is expected

_GRID = np.stack(np.meshgrid(*2 * [np.arange(-HALF, HALF + 1.0)]), axis=-1).reshape(-1, 2)
_WEIGHT = np.exp(-(_GRID**2).sum(1) / (2 * (0.6 * HALF) ** 2))
_WEIGHT /= _WEIGHT.sum()


@dataclass(frozen=True)
class Templates:
    """n patches of K pixels as they were first seen: values [n, K], mean 0, variance 1, and gradients [n, K, 2]."""

    values: F64
    gradients: F64

    def select(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> Templates:
        """Some of them."""
        return Templates(self.values[rows], self.gradients[rows])

    def joined(self, more: Templates) -> Templates:
        """These, then others."""
        return Templates(
            np.concatenate([self.values, more.values]), np.concatenate([self.gradients, more.gradients])
        )

    def information(self) -> F64:
        """[n, 2, 2] of the shift."""
        return (self.gradients * _WEIGHT[:, None]).transpose(0, 2, 1) @ self.gradients

    def corners(self) -> NDArray[np.bool_]:
        """[n] whether a patch is told apart in every direction."""
        low, high = np.linalg.eigvalsh(self.information()).T
        return low > EDGE * high


NO_TEMPLATES = Templates(np.zeros((0, len(_GRID))), np.zeros((0, len(_GRID), 2)))


def fine_texture(gray: NDArray[np.uint8]) -> F32:
    """[H, W] the texture between FINE_PX and COARSE_PX, its strength levelled."""
    picture = gray.astype(np.float32)
    band = cv2.GaussianBlur(picture, (0, 0), FINE_PX) - cv2.GaussianBlur(picture, (0, 0), COARSE_PX)
    strength = np.sqrt(cv2.GaussianBlur(band * band, (0, 0), STRENGTH_PX))
    return band / (strength + NOISE)


def cut_templates(texture: F32, xy: F64) -> Templates:
    """The patches about xy [n, 2] px."""
    values, strength = _levelled(_sampled(texture, xy[:, None] + _GRID))
    steps = [
        _sampled(texture, xy[:, None] + _GRID + half) - _sampled(texture, xy[:, None] + _GRID - half)
        for half in 0.5 * np.eye(2)
    ]
    return Templates(values, np.stack(steps, axis=-1) / strength[..., None])


def register(texture: F32, guess: F64, bend: F64, templates: Templates) -> tuple[F64, NDArray[np.bool_]]:
    """Where the patches are now [n, 2] px, and whether each was found [n].

    guess: [n, 2] px. bend: [n, 2, 2], how each patch is turned and stretched since it was cut.
    """
    places = guess.copy()
    around = _GRID @ bend.transpose(0, 2, 1)
    slopes = templates.gradients * _WEIGHT[:, None]
    inverse = np.linalg.inv(templates.information() + 1e-6 * np.eye(2))
    length = np.full(len(guess), np.inf)
    for _ in range(ITERATIONS):
        error = _levelled(_sampled(texture, places[:, None] + around))[0] - templates.values
        step = -np.einsum("nij,nj->ni", inverse, (error[:, None] @ slopes)[:, 0])
        length = np.linalg.norm(step, axis=1)
        step *= np.minimum(1, LONGEST_STEP / np.maximum(length, 1e-9))[:, None]
        places += np.einsum("nij,nj->ni", bend, step)
        if (length < SETTLED).all():
            break
    seen = _levelled(_sampled(texture, places[:, None] + around))[0]
    correlation = (seen * templates.values) @ _WEIGHT
    near = np.linalg.norm(places - guess, axis=1) < MAX_SHIFT
    return places, (correlation > MIN_CORRELATION) & near & (length < 5 * SETTLED)


def _levelled(patches: F64) -> tuple[F64, F64]:
    """Patches [n, K] at mean 0 and variance 1, and their standard deviations [n, 1]."""
    centred = patches - (patches @ _WEIGHT)[:, None]
    strength = np.sqrt((centred**2) @ _WEIGHT)[:, None] + 1e-4
    return centred / strength, strength


def _sampled(texture: F32, xy: F64) -> F64:
    """Bilinear, the border repeated."""
    at = xy.astype(np.float32)
    return cv2.remap(
        texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float64)
