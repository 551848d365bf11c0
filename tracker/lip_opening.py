"""How far the lips are apart in the pictures: the colours along lines across the mouth, told apart by the clip's own.

The landmarker reads an opening wider or narrower as the head turns and follows quick closures too slowly. But it tells
well enough which colours are lips and which are teeth, tongue or darkness: once these are learned, each line says
itself where the one ends and the other begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tracker.lip_lines import SAMPLES, STEP_MM
from tracker.threads import side_by_side
from tracker.track import F32, F64
from tracker.view import LOG, U8, Index

BINS = 20  # of each of three axes of colour
LEAST_RANGE = 0.1  # of log colour along an axis: below, it is noise
RARE = 0.01  # share of colours that have never been seen in a class
UPPER, INSIDE, LOWER = range(3)
LEARNED = 400  # frames, spread over the clip, that tell the colours
ROUNDS = 3  # in which they tell how high the mouth is
OPEN_MM = 2.5  # lips farther apart than this show what is inside
# From the landmarks' edges, where either may be seen. They lie outside more often than inside: wide openings are read
# wider still, by about a tenth.
LIP_MARGIN_MM, INSIDE_MARGIN_MM, INSIDE_SHARE = 0.5, 0.8, 0.2
LEAST_INSIDE = 100  # samples; with fewer the clip hardly shows an open mouth
MOST_LIKE_LIPS = 0.5  # of what is inside: above, the clip's colours tell nothing
DOUBT = 0.5  # log likelihood ratio up to which a colour tells nothing: a tongue is nearly that of lips
TRUSTED = 3.0  # the most that one sample counts, as log likelihood ratio
PRIOR_MM = 1.0  # standard deviation of width and middle about the marks'
# Of a grey level, about. Lens and motion mix light, not the logarithms of colours.
LIGHT = (np.arange(256, dtype=np.float32) / 255) ** 2
BESIDE_MM = (0.8, 2.0)  # from an edge: what is on either side of it
DARKNESS = 0.33  # of the lip's light: what has less is dark
LIT_REACH_MM = 1.2  # from the colours' edge


def lip_edges(colours: U8, marks: F64, sound: Index) -> tuple[F64 | None, float]:
    """[n, Q, 2] mm, the lips' inner edges, of colours [n, Q, S, 3] u8 along lines with the landmarks' marks [n, Q, 4].

    The landmarker sees a whole mouth too high or too low: what the edges found in the colours tell of that is taken out
    of the marks before they teach the colours again. sound: rows whose colours are the face's own. None where they do
    not tell lips from what is between them. Beside them the share of the latter that looks more like lips; NaN where
    the mouth hardly opens.
    """
    if not len(sound):
        return None, np.nan
    learned = sound[np.unique(np.linspace(0, len(sound) - 1, LEARNED).round().astype(int))]
    taught, down = colours[learned], 0.0
    if (_classes(marks[learned]) == INSIDE).sum() < LEAST_INSIDE:
        return None, np.nan
    known = LipColours.of(taught, marks[learned])
    for _ in range(ROUNDS):
        moved = _moved(marks[learned], down)
        down += _down(known.edges(taught, moved), moved)
        known = LipColours.of(taught, _moved(marks[learned], down))
    if known.like_lips > MOST_LIKE_LIPS:
        return None, known.like_lips
    moved = _moved(marks, down)
    parts = np.array_split(np.arange(len(colours)), max(1, len(colours) // LEARNED))
    edges = side_by_side(lambda rows: known.edges(colours[rows], moved[rows]), parts)
    return np.concatenate(list(edges)), known.like_lips


@dataclass(frozen=True)
class LipColours:
    """How likely colours are upper lip, lower lip or what is between them, in one clip.

    table: [3, BINS^3] log likelihoods of the bins of colour, which begin at low [3] and are 1 / scale [3] wide.
    like_lips: share of what is between them that looks more like lips.
    """

    low: F64
    scale: F64
    table: F32
    like_lips: float

    @classmethod
    def of(cls, colours: U8, marks: F64) -> LipColours:
        """What colours [n, Q, S, 3] are if the marks [n, Q, 4] are about right."""
        classes = _classes(marks)
        axes = _colour_axes(colours, marks)
        low, high = np.quantile(axes.reshape(-1, 3), (0.005, 0.995), axis=0)
        scale = BINS / np.maximum(high - low, LEAST_RANGE)
        bins = _bins(axes, low, scale)
        table = _likelihoods(bins, classes)
        inside = table[:, bins[classes == INSIDE]]
        like_lips = (inside[INSIDE] <= np.maximum(inside[UPPER], inside[LOWER])).mean()
        return cls(low, scale, np.clip(table - table.max(0) + DOUBT, -TRUSTED, 0), float(like_lips))

    def edges(self, colours: U8, marks: F64) -> F64:
        """[n, Q, 2] mm along the lines: where the upper lip ends and the lower one begins.

        The expectation over all places of both, under the colours and a weak prior about the marks; then the lower lip
        begins where the light says so, if what is above it is dark.
        """
        seen = self.table[:, _bins(_colour_axes(colours, marks), self.low, self.scale)]
        edges = np.empty((*marks.shape[:2], 2))
        _fill_edges(seen, LIGHT[colours].mean(-1), SAMPLES, marks, edges)
        return edges


def _moved(marks: F64, down: float) -> F64:
    """The marks [n, Q, 4] with both inner edges so many mm farther down."""
    return marks + np.array([0.0, down, down, 0.0])


def _down(edges: F64, marks: F64) -> float:
    """mm by which edges [n, Q, 2] of open lips lie farther down than the marks [n, Q, 4] have them."""
    opened = marks[..., 2] - marks[..., 1] > OPEN_MM
    return float(np.median((edges - marks[..., 1:3]).mean(-1)[opened])) if opened.any() else 0.0


def _colour_axes(colours: U8, marks: F64) -> F32:
    """[n, Q, S, 3] brightness, red and blue against green, as logarithms relative to the frame's lips."""
    log = LOG[colours]
    lips = np.isin(_classes(marks), (UPPER, LOWER))
    count = np.maximum(lips.sum((1, 2)), 1)[:, None]
    log -= (np.einsum("nqsc,nqs->nc", log, lips.astype(np.float32)) / count)[:, None, None]
    red, green, blue = np.moveaxis(log, -1, 0)
    return np.stack([log.mean(-1), red - green, blue - green], axis=-1)


def _classes(marks: F64) -> NDArray[np.int8]:
    """[n, Q, S] what each sample shows if the landmarks are about right, -1 where they leave that open."""
    above, upper, lower, below = np.moveaxis(marks[..., None], 2, 0)
    at = SAMPLES
    margin = np.maximum(INSIDE_MARGIN_MM, INSIDE_SHARE * (lower - upper))
    out = np.full((*marks.shape[:2], len(at)), -1, np.int8)
    out[(at > above) & (at < upper - LIP_MARGIN_MM)] = UPPER
    out[(at > lower + LIP_MARGIN_MM) & (at < below)] = LOWER
    out[(at > upper + margin) & (at < lower - margin) & (lower - upper > OPEN_MM)] = INSIDE
    return out


def _bins(axes: F32, low: F64, scale: F64) -> NDArray[np.int32]:
    """Number of the bin of each colour [.., 3]."""
    bins = np.clip((axes - low) * scale, 0, BINS - 1).astype(np.int32)
    return (bins[..., 0] * BINS + bins[..., 1]) * BINS + bins[..., 2]


def _likelihoods(bins: NDArray[np.int32], classes: NDArray[np.int8]) -> F32:
    """[3, BINS^3] log likelihood of a colour in each class, of samples in these bins and classes."""
    table = np.empty((3, BINS**3), np.float32)
    for name in (UPPER, INSIDE, LOWER):
        count = np.bincount(bins[classes == name], minlength=BINS**3).reshape(BINS, BINS, BINS)
        smooth = gaussian_filter(count.astype(np.float64), 1.0, mode="nearest").ravel()
        table[name] = np.log(smooth / max(smooth.sum(), 1e-9) + RARE / BINS**3)
    return table


@njit(cache=True, nogil=True)
def _fill_edges(likelihood, light, samples, marks, edges):  # type: ignore[no-untyped-def]
    """Fills edges [n, Q, 2] mm from log likelihoods [3, n, Q, S] and light [n, Q, S] at samples [S] mm.

    marks: [n, Q, 4] mm.
    """
    before = np.zeros((3, len(samples) + 1))  # of all samples before an edge, class by class
    for n in range(marks.shape[0]):
        for q in range(marks.shape[1]):
            above, upper, lower, below = marks[n, q]
            for s in range(len(samples)):
                known = above <= samples[s] <= below
                for c in range(3):
                    before[c, s + 1] = before[c, s] + (likelihood[c, n, q, s] if known else 0.0)
            first, last = _expected_edges(before, samples[0] - STEP_MM / 2, upper, lower)
            if last - first > OPEN_MM:
                last = _lit_edge(light[n, q], samples, last)
            edges[n, q] = first, last


@njit(cache=True, nogil=True)
def _expected_edges(before, start, upper, lower):  # type: ignore[no-untyped-def]
    """Mean places of the upper and the lower edge over all pairs, upper first; edge k lies at start + k steps."""
    edges = before.shape[1]
    best, total, above, below = -np.inf, 0.0, 0.0, 0.0
    for first in range(edges):
        for last in range(first, edges):
            width = (last - first) * STEP_MM
            middle = start + (first + last) / 2 * STEP_MM
            away = (width - lower + upper) ** 2 + (middle - (upper + lower) / 2) ** 2
            value = (
                before[0, first]
                - before[1, first]
                + before[1, last]
                - before[2, last]
                - away / (2 * PRIOR_MM**2)
            )
            if value > best:
                less = np.exp(best - value)
                total, above, below, best = total * less, above * less, below * less, value
            share = np.exp(value - best)
            total, above, below = total + share, above + share * first, below + share * last
    return start + STEP_MM * above / total, start + STEP_MM * below / total


@njit(cache=True, nogil=True)
def _lit_edge(light, samples, edge):  # type: ignore[no-untyped-def]
    """Where the light [S] rises half way from darkness to the lower lip; the edge itself if nothing is dark there.

    Half a pixel of lip in the dark is lip by its logarithm, so that colours end a dark mouth too early. Below the upper
    lip there are teeth.
    """
    near, far = BESIDE_MM
    dark, lip, darks, lips = 0.0, 0.0, 0, 0
    for s in range(len(samples)):
        if near <= samples[s] - edge <= far:
            lip, lips = lip + light[s], lips + 1
        elif near <= edge - samples[s] <= far:
            dark, darks = dark + light[s], darks + 1
    if not (lips and darks) or dark / darks > DARKNESS * lip / lips:
        return edge
    half = (dark / darks + lip / lips) / 2
    found = edge + LIT_REACH_MM
    for s in range(len(samples) - 1):
        if light[s] <= half < light[s + 1]:
            at = samples[s] + STEP_MM * (half - light[s]) / (light[s + 1] - light[s])
            if abs(at - edge) < abs(found - edge):
                found = at
    return found if abs(found - edge) < LIT_REACH_MM else edge
