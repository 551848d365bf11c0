"""Where irises are in the pictures: what is dark between the lids and what is light, told apart by the clip's own eyes.

The landmarker sees irises move, but not far enough: up and down by half of what they do on rendered people. It tells
well enough which greys are an iris's; once these are learned, each picture says where the disc of them lies.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from tracker.landmark_indices import IRIS_CENTRES, LEFT_EYE, LEFT_EYE_OUTER, RIGHT_EYE, RIGHT_EYE_OUTER
from tracker.threads import side_by_side
from tracker.track import F32, F64
from tracker.view import LOG, U8, Index, sampled

# Lids from the outer corner to the inner one, of both eyes as IRIS_CENTRES has them.
LOWER_LIDS = [eye[:9] for eye in (LEFT_EYE, RIGHT_EYE)]
UPPER_LIDS = [(eye[0], *eye[9:], eye[8]) for eye in (LEFT_EYE, RIGHT_EYE)]
# What is looked at about an iris as the landmarker sees it: every half of a millimetre.
STEP_MM = 0.5
ACROSS, DOWN = np.arange(-11.0, 11.1, STEP_MM), np.arange(-9.0, 9.1, STEP_MM)
FAR_X, FAR_Y = np.meshgrid(ACROSS, DOWN)
# Lashes and their shadow look like an iris, so what is near the upper lid tells nothing.
BELOW_UPPER_MM, ABOVE_LOWER_MM = 2.0, 0.3
LEAST_SEEN = 32  # samples between the lids: a narrower eye teaches nothing
LEARNED = 400  # frames, spread over the clip, that tell the greys
RADIUS_MM = 5.8  # of an iris: 5.9 (sd .2), but heads are not as large as they are taken to be
MARGIN_MM = 1.2  # of that radius; farther inside lies iris for sure, farther outside none
BINS, RANGE, RARE = 40, 2.5, 0.01  # of the logarithm of a grey level about the eye's median; share never seen
TRUSTED = 2.0  # the most that one sample counts, as log likelihood ratio
PER_MM2 = 0.6  # of that ratio: neighbours err together
REACH_MM, PRIOR_MM = 3.0, 1.0  # of an iris from where the landmarker sees it: at most, and standard deviation
# Standard deviation between what is found of both eyes, which turn together; how often one of them is led astray.
APART_MM, ASTRAY = 0.8, 0.001
SHIFTS = np.arange(-REACH_MM, REACH_MM + STEP_MM / 2, STEP_MM)


@dataclass(frozen=True)
class EyeWindows:
    """What is looked at of both eyes in n frames, along the line between their outer corners and down from it.

    iris: [n, 2, 2] px, where the landmarker sees them, left then right. axes: [n, 2, 2] px per mm across and down, in
    the picture's plane. seen: [n, 2, H, W], what lies between the lids.
    """

    iris: F64
    axes: F64
    seen: NDArray[np.bool_]

    @classmethod
    def of(cls, observed: F64, px_per_m: F64) -> EyeWindows:
        """By landmarks [n, 478, 2] px of faces of the scale px_per_m [n]."""
        across = observed[:, LEFT_EYE_OUTER] - observed[:, RIGHT_EYE_OUTER]
        across *= 1e-3 * px_per_m[:, None] / np.linalg.norm(across, axis=1, keepdims=True)
        axes = np.stack([across, np.stack([-across[:, 1], across[:, 0]], axis=1)], axis=1)
        iris = observed[:, IRIS_CENTRES]
        per_px = axes / (axes**2).sum(-1, keepdims=True)
        upper, lower = (
            np.einsum("nepx,nax->nepa", observed[:, np.array(lids)] - iris[:, :, None], per_px)
            for lids in (UPPER_LIDS, LOWER_LIDS)
        )
        return cls(iris, axes, _between(upper, lower))

    def read(self, rgb: U8, row: int) -> U8:
        """[2, H, W] grey levels of the picture [H', W', 3] of frame `row`."""
        grid = np.stack([FAR_X, FAR_Y], axis=-1) @ self.axes[row]
        apart = STEP_MM * float(np.linalg.norm(self.axes[row, 0]))
        pictures = [sampled(rgb, middle + grid, apart) for middle in self.iris[row]]
        return np.stack([cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures])

    def moved(self, observed: F64, shifts: F64) -> F64:
        """The landmarks [n, 478, 2] px with the middles of the irises moved by [n, 2, 2] mm across and down."""
        out = observed.copy()
        out[:, IRIS_CENTRES] += np.einsum("nea,nax->nex", shifts, self.axes)
        return out


def iris_shifts(greys: U8, seen: NDArray[np.bool_], sound: Index) -> F64:
    """[n, 2, 2] mm across and down by which irises lie beside where the landmarker sees them, without the usual.

    greys, seen: [n, 2, H, W], see `EyeWindows`. sound: rows whose colours are the face's own. Where both lie apart
    throughout may be the lashes', or light's: landmarks tell it. The less is seen of an eye, the nearer to zero.
    """
    usable = sound[(seen[sound].sum((2, 3)) >= LEAST_SEEN).all(1)]
    if not len(usable):
        return np.zeros((len(greys), 2, 2))
    learned = usable[np.unique(np.linspace(0, len(usable) - 1, LEARNED).round().astype(int))]
    bins, taught = _bins(greys[learned], seen[learned]), seen[learned]
    known = _likelihood_ratios(bins, taught)
    usual = np.median(_places(_told(known, bins, taught), np.zeros((2, 2))), axis=0)

    def shifts(rows: Index) -> F64:
        told = _told(known, _bins(greys[rows], seen[rows]), seen[rows])
        return _places(told, usual) - usual

    parts = np.array_split(np.arange(len(greys)), max(1, len(greys) // LEARNED))
    return np.concatenate(list(side_by_side(shifts, parts)))


def _between(upper: F64, lower: F64) -> NDArray[np.bool_]:
    """[n, 2, H, W] samples between upper and lower lids [n, 2, L, 2] mm from the irises, without their rims."""
    out = np.zeros((*upper.shape[:2], len(DOWN), len(ACROSS)), bool)
    for at in np.ndindex(*upper.shape[:2]):
        first = _lid(upper[at], np.inf) + BELOW_UPPER_MM
        last = _lid(lower[at], -np.inf) - ABOVE_LOWER_MM
        out[at] = (first < FAR_Y) & (last > FAR_Y)
    return out


def _lid(points: F64, beyond: float) -> F64:
    """[W] mm down, a lid's rim [L, 2] at all places across; `beyond` where it ends."""
    x, y = points[points[:, 0].argsort()].T
    return np.asarray(np.interp(ACROSS, x, y, beyond, beyond), np.float64)


def _bins(greys: U8, seen: NDArray[np.bool_]) -> U8:
    """[m, 2, H, W] number of the bin of each grey level's logarithm about the median of what is seen of the eye."""
    log = LOG[greys]
    usual = np.ma.median(np.ma.array(log, mask=~seen), axis=(2, 3), keepdims=True).filled(0.0)
    return np.clip((log - usual + RANGE) * (BINS / (2 * RANGE)), 0, BINS - 1).astype(np.uint8)


def _likelihood_ratios(bins: U8, seen: NDArray[np.bool_]) -> F32:
    """[2, BINS] how much likelier a grey is in an iris than beside it, as logarithms, for each eye.

    As the landmarker has them, which is about right.
    """
    away = np.hypot(FAR_X, FAR_Y)
    tables = np.empty((2, 2, BINS))
    for side, surely in enumerate((away < RADIUS_MM - MARGIN_MM, away > RADIUS_MM + MARGIN_MM)):
        for eye in range(2):
            count = np.bincount(bins[:, eye][seen[:, eye] & surely], minlength=BINS)
            smooth = gaussian_filter1d(count.astype(np.float64), 1.0)
            tables[side, eye] = np.log(smooth / max(smooth.sum(), 1e-9) + RARE / BINS)
    return np.clip(tables[0] - tables[1], -TRUSTED, TRUSTED).astype(np.float32)


def _told(ratios: F32, bins: U8, seen: NDArray[np.bool_]) -> F32:
    """[m, 2, H, W] what each sample says of lying in an iris, as log likelihood ratio; 0 where no eye is seen."""
    return np.stack([ratios[eye][bins[:, eye]] for eye in range(2)], axis=1) * seen


def _places(told: F32, usual: F64) -> F64:
    """[m, 2, 2] mm across and down: the expectation over all places of a disc's middle, of both eyes together.

    Under what the samples say [m, 2, H, W], and a prior about where irises usually lie, [2, 2] mm.
    """
    reach = np.arange(-np.ceil(RADIUS_MM / STEP_MM), np.ceil(RADIUS_MM / STEP_MM) + 1) * STEP_MM
    disc = np.clip((RADIUS_MM - np.hypot(*np.meshgrid(reach, reach))) / STEP_MM + 0.5, 0, 1).astype(
        np.float32
    )
    x, y = np.meshgrid(SHIFTS, SHIFTS)
    prior = [np.exp(-((x - mean[0]) ** 2 + (y - mean[1]) ** 2) / (2 * PRIOR_MM**2)) for mean in usual]
    middle = np.ix_(np.abs(DOWN) <= REACH_MM, np.abs(ACROSS) <= REACH_MM)
    out = np.empty((len(told), 2, 2))
    for row, eyes in enumerate(told):
        value = [cv2.filter2D(eye, cv2.CV_64F, disc, borderType=cv2.BORDER_CONSTANT)[middle] for eye in eyes]
        likely = [np.exp(PER_MM2 * STEP_MM**2 * (own - own.max())) for own in value]
        # Where the other eye is found, this one is expected.
        near = [cv2.GaussianBlur(own, (0, 0), APART_MM / STEP_MM) for own in likely]
        for eye in range(2):
            share = likely[eye] * (near[1 - eye] + ASTRAY) * prior[eye]
            out[row, eye] = (share * x).sum() / share.sum(), (share * y).sum() / share.sum()
    return out
