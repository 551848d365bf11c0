"""Small patches found again in later pictures, by their fine texture.

Inverse compositional Lucas-Kanade (Baker and Matthews, "Lucas-Kanade 20 years on", 2004) for the shift alone; the
caller says how a patch is bent meanwhile. Shading, gloss and contours, which slide over a face that turns, are coarse
and strong, pores and freckles fine and weak: the pictures compared hold the fine part only, at equal strength all over.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
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

_GRID = np.stack(np.meshgrid(*2 * [np.arange(-HALF, HALF + 1.0)]), axis=-1).reshape(-1, 2).astype(np.float32)
_WEIGHT = np.exp(-(_GRID**2).sum(1) / (2 * (0.6 * HALF) ** 2))
_WEIGHT /= _WEIGHT.sum()


@dataclass(frozen=True)
class Templates:
    """n patches of K pixels as they were first seen: values [n, K], mean 0, variance 1, and gradients [n, K, 2]."""

    values: F32
    gradients: F32

    def select(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> Templates:
        """Some of them."""
        return Templates(self.values[rows], self.gradients[rows])

    def joined(self, more: Templates) -> Templates:
        """These, then others."""
        return Templates(
            np.concatenate([self.values, more.values]), np.concatenate([self.gradients, more.gradients])
        )

    def information(self) -> F32:
        """[n, 2, 2] of the shift."""
        return (self.gradients * _WEIGHT[:, None]).transpose(0, 2, 1) @ self.gradients

    def corners(self) -> NDArray[np.bool_]:
        """[n] whether a patch is told apart in every direction."""
        low, high = np.linalg.eigvalsh(self.information()).T
        return low > EDGE * high


NO_TEMPLATES = Templates(np.zeros((0, len(_GRID)), np.float32), np.zeros((0, len(_GRID), 2), np.float32))


def fine_texture(gray: NDArray[np.uint8]) -> F32:
    """[H, W] the texture between FINE_PX and COARSE_PX, its strength levelled."""
    picture = gray.astype(np.float32)
    band = cv2.GaussianBlur(picture, (0, 0), FINE_PX) - cv2.GaussianBlur(picture, (0, 0), COARSE_PX)
    strength = np.sqrt(cv2.GaussianBlur(band * band, (0, 0), STRENGTH_PX))
    return band / (strength + NOISE)


def cut_templates(texture: F32, xy: F64) -> Templates:
    """The patches about xy [n, 2] px."""
    count = len(xy), len(_GRID)
    templates = Templates(np.empty(count, np.float32), np.empty((*count, 2), np.float32))
    _cut(texture, xy.astype(np.float32), templates.values, templates.gradients)
    return templates


def register(texture: F32, guess: F64, bend: F64, templates: Templates) -> tuple[F64, NDArray[np.bool_]]:
    """Where the patches are now [n, 2] px, and whether each was found [n].

    guess: [n, 2] px. bend: [n, 2, 2], how each patch is turned and stretched since it was cut.
    """
    slopes = (templates.gradients * _WEIGHT[:, None]).transpose(0, 2, 1)
    gain = np.linalg.inv(templates.information() + 1e-6 * np.eye(2)) @ slopes
    places, correlation = guess.astype(np.float32), np.zeros(len(guess), np.float32)
    gains, bends = (np.ascontiguousarray(value, np.float32) for value in (gain, bend))
    _search(texture, templates.values, gains, bends, places, correlation)
    return places.astype(np.float64), correlation > MIN_CORRELATION


@njit(cache=True)
def _cut(texture, xy, values, gradients):  # type: ignore[no-untyped-def]
    """Fills values and gradients of `Templates`."""
    half = np.float32(0.5)
    ahead, behind = np.empty(len(_GRID), np.float32), np.empty(len(_GRID), np.float32)
    for n in range(len(xy)):
        _sample(texture, _GRID, xy[n], values[n])
        strength = _level(values[n])
        for axis in range(2):
            step = half * np.eye(2, dtype=np.float32)[axis]
            _sample(texture, _GRID, xy[n] + step, ahead)
            _sample(texture, _GRID, xy[n] - step, behind)
            gradients[n, :, axis] = (ahead - behind) / strength


@njit(cache=True)
def _search(texture, values, gain, bend, places, correlation):  # type: ignore[no-untyped-def]
    """Moves places [n, 2] to where the patches look like their templates; those that do not settle keep correlation 0.

    gain: [n, 2, K], the shift by the difference of a template from its patch.
    """
    seen = np.empty(values.shape[1], np.float32)
    for n in range(len(places)):
        around, start = _GRID @ np.ascontiguousarray(bend[n].T), places[n].copy()
        for _ in range(ITERATIONS):
            _sample(texture, around, places[n], seen)
            _level(seen)
            across, down = np.float32(0), np.float32(0)
            for k in range(len(seen)):
                gap = values[n, k] - seen[k]
                across += gain[n, 0, k] * gap
                down += gain[n, 1, k] * gap
            length = np.hypot(across, down)
            short = np.float32(min(1.0, LONGEST_STEP / max(length, 1e-9)))
            places[n] += bend[n] @ (np.array([across, down]) * short)
            near = np.hypot(places[n, 0] - start[0], places[n, 1] - start[1]) < MAX_SHIFT
            if length < SETTLED or not near:
                break
        if near and length < 5 * SETTLED:
            _sample(texture, around, places[n], seen)
            _level(seen)
            correlation[n] = (seen * values[n] * _WEIGHT).sum()


@njit(cache=True)
def _sample(texture, around, place, patch):  # type: ignore[no-untyped-def]
    """Fills patch [K], bilinear at around [K, 2] + place [2] px, the border repeated."""
    height, width = texture.shape
    first, right, bottom = np.float32(0), np.float32(width - 1), np.float32(height - 1)
    for k in range(len(patch)):
        x = min(max(around[k, 0] + place[0], first), right)
        y = min(max(around[k, 1] + place[1], first), bottom)
        i, j = min(int(x), width - 2), min(int(y), height - 2)
        u, v = x - np.float32(i), y - np.float32(j)
        top = texture[j, i] + (texture[j, i + 1] - texture[j, i]) * u
        low = texture[j + 1, i] + (texture[j + 1, i + 1] - texture[j + 1, i]) * u
        patch[k] = top + (low - top) * v


@njit(cache=True)
def _level(patch):  # type: ignore[no-untyped-def]
    """Brings a patch [K] to mean 0 and variance 1; returns its standard deviation."""
    mean, square = np.float32(0), np.float32(0)
    for k in range(len(patch)):
        mean += patch[k] * _WEIGHT[k]
    for k in range(len(patch)):
        patch[k] -= mean
        square += patch[k] * patch[k] * _WEIGHT[k]
    strength = np.sqrt(square) + np.float32(1e-4)
    for k in range(len(patch)):
        patch[k] /= strength
    return strength
