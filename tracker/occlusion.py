"""What covers or blurs the face: how each frame's skin, lips and cheeks look against the rest of the clip.

The landmarker stays sure of a mouth behind a hand or a box, and the fit follows it there. The colours under the
landmarks do not: wherever the face turns and whatever it says, they stay near a pattern of its own, which a
hand's, a cup's or a microphone's are not. The pattern is learned from the clip itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.landmark_indices import IRIS_CENTRES, LEFT_EYE_OUTER, LIPS, OVAL, POINTS, RIGHT_EYE_OUTER
from tracker.landmarker import crop, roi_from_points
from tracker.track import F32, F64, Landmarks

U8 = NDArray[np.uint8]
Frame = tuple[float, U8]

SIDE = 128  # px of the face's crop, about 36 of them between the outer corners of the eyes
SMOOTHING_PX = 2.0  # of the crop: colours of patches, not of pores and noise
DARK = 8.0  # grey levels added before the logarithm: below, contrast is noise
CONTRAST = 0.02  # of log colour: a region whose pattern is weaker than this cannot be told from another
LEARNED = 400  # frames, spread over the clip, that the patterns are learned from
PATTERNS = 3  # components besides the mean: a turned head, other light, an open mouth
FRAMES_PER_PATTERN = 20  # fewer would make each frame its own pattern
TRUSTED = 0.6  # share of the frames that are taken to show the bare face
EYE_REACH = 0.27  # of the distance between the eyes: lids and gaze change within it and cover nothing


@dataclass(frozen=True)
class Appearance:
    """strangeness: [T] 0..2, 1 - correlation of the region that looks least like the face's own; 0 where no face is.
    sharpness: [T] mean Laplacian of the face relative to its brightness, over the clip's median, 1 where no face is."""

    strangeness: F32
    sharpness: F32


class FaceWatch:
    """Looks at the face of each picture that passes, so that no pass over the video is needed for it."""

    def __init__(self, landmarks: Landmarks) -> None:
        total = len(landmarks.time)
        self._points = landmarks.points
        self._colour = np.zeros((total, POINTS, 3), np.uint8)
        self._detail = np.full(total, np.nan, np.float32)
        self._place = np.full((total, POINTS, 2), np.nan, np.float32)

    def through(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The same frames (time s, rgb [H, W, 3] u8), from the clip's first on, each looked at as it passes."""
        for index, (time, rgb) in enumerate(frames):
            if index < len(self._points) and np.isfinite(self._points[index]).all():
                self._see(index, rgb)
            yield time, rgb

    def _see(self, index: int, rgb: U8) -> None:
        roi = roi_from_points(self._points[index])
        face = cv2.resize(crop(rgb, roi), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        to_picture = roi.to_picture()
        unit = np.linalg.solve(to_picture[:, :2], (self._points[index, :, :2] - to_picture[:, 2]).T).T
        at = (unit * SIDE - 0.5).astype(np.float32)
        smooth = cv2.GaussianBlur(face, (0, 0), SMOOTHING_PX)
        x, y = at[:, None, 0], at[:, None, 1]
        self._colour[index] = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        grey = cv2.cvtColor(face, cv2.COLOR_RGB2GRAY)
        inside = slice(SIDE // 4, -SIDE // 8), slice(SIDE // 4, -SIDE // 4)
        edges = np.abs(cv2.Laplacian(grey, cv2.CV_32F)[inside])
        self._detail[index] = edges.mean() / (grey[inside].mean() + DARK)
        self._place[index] = unit

    def appearance(self) -> Appearance:
        """Of the frames seen so far; meant for when all have passed."""
        strangeness, sharpness = (
            np.zeros(len(self._detail), np.float32),
            np.ones(len(self._detail), np.float32),
        )
        seen = np.flatnonzero(np.isfinite(self._detail))
        if len(seen):
            for region in regions(np.median(self._place[seen], axis=0)):
                found = _strangeness(self._colour[np.ix_(seen, region)])
                strangeness[seen] = np.maximum(strangeness[seen], found)
            sharpness[seen] = self._detail[seen] / max(float(np.median(self._detail[seen])), 1e-6)
        return Appearance(strangeness, sharpness)


def regions(place: NDArray[np.floating]) -> list[NDArray[np.intp]]:
    """Landmarks of the mouth with the chin, and of both sides of the upper face, without the eyes and the rim.

    place: [478, 2], a typical face, upright, in any unit.
    """
    eyes = float(np.linalg.norm(place[RIGHT_EYE_OUTER] - place[LEFT_EYE_OUTER]))
    to_iris = [np.linalg.norm(place - place[iris], axis=1) for iris in IRIS_CENTRES]
    skin = np.minimum(*to_iris) > EYE_REACH * eyes
    skin[list(OVAL)] = False
    x, y = ((place - place[list(LIPS)].mean(0)) / eyes).T
    mouth = (np.abs(x) < 0.5) & (y > -0.25) & (y < 0.4)
    return [np.flatnonzero(skin & part) for part in (mouth, ~mouth & (x < -0.05), ~mouth & (x > 0.05))]


def _strangeness(colour: U8) -> F64:
    """[n] 1 - correlation of a region's colours [n, R, 3] with the nearest pattern of the face's own."""
    logs = np.log(colour.astype(np.float64) + DARK)
    values = (logs - logs.mean(1, keepdims=True)).reshape(len(logs), -1)
    learned = np.unique(np.linspace(0, len(values) - 1, LEARNED).round().astype(int))
    taken, patterns = learned, np.zeros((0, values.shape[1]))
    mean = np.median(values[learned], axis=0)
    for _ in range(4):
        strange = _unlike(values[learned], mean, patterns)
        taken = learned[np.argsort(strange, kind="stable")[: max(1, round(TRUSTED * len(learned)))]]
        mean = values[taken].mean(0)
        patterns = np.linalg.svd(values[taken] - mean, full_matrices=False)[2]
        patterns = patterns[: min(PATTERNS, len(taken) // FRAMES_PER_PATTERN)]
    return _unlike(values, mean, patterns)


def _unlike(values: F64, mean: F64, patterns: F64) -> F64:
    away = values - mean
    nearest = mean + (away @ patterns.T) @ patterns
    floor = CONTRAST**2 * values.shape[1]
    together = (values * nearest).sum(1) + floor
    return 1 - together / np.sqrt(((values**2).sum(1) + floor) * ((nearest**2).sum(1) + floor))
