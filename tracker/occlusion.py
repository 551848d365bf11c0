"""What covers or blurs the face: how each frame's skin, lips and cheeks look against the rest of the clip.

The landmarker stays sure of a mouth behind a hand or a box, and the fit follows it there. The colours under the
landmarks do not: wherever the face turns and whatever it says, they stay near a pattern of its own, which a
hand's, a cup's or a microphone's are not. The pattern is learned from the clip itself; what is there all the time is
told by lips that are not red.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.landmark_indices import (
    IRIS_CENTRES,
    LEFT_EYE_OUTER,
    LIPS,
    LOWER_RED,
    NOSE_BRIDGE,
    OVAL,
    POINTS,
    RIGHT_EYE_OUTER,
    UPPER_FACE,
    UPPER_RED,
)
from tracker.landmarker import crop, roi_from_points
from tracker.track import F32, F64

U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

SIDE = 128  # px of the face's crop, about 36 of them between the outer corners of the eyes
SMOOTHING_PX = 2.0  # of the crop: colours of patches, not of pores and noise
DARK = 8.0  # grey levels added before the logarithm: below, contrast is noise
CONTRAST = 0.02  # of log colour: a region whose pattern is weaker than this cannot be told from another
LEARNED = 400  # frames, spread over the clip, that the patterns are learned from
PATTERNS = 4  # components besides the mean: a turned head, other light, an open mouth
FRAMES_PER_PATTERN = 20  # fewer would make each frame its own pattern
# Share of the frames that are taken to show the bare face; in the end those too that look no stranger to these than
# ALIKE: other turns and lights. Not again and again, or the pattern would follow a hand from its first finger on.
TRUSTED, TRUSTING, ALIKE = 0.5, 4, 0.12  # TRUSTING: rounds
# Of the frames: landmarks that are in fewer of the pictures are left out. Of a region: with less of it in the picture
# its border's colours count, as strange as they are.
OFTEN = 0.5
LEAST_POINTS = 20  # of a region: in a clip of profiles the far side has fewer
MIDDLE = 0.05  # of the distance between the eyes, to either side
EYE_REACH = 0.27  # of the distance between the eyes: lids and gaze change within it and cover nothing
# Of the skin's redness, the logarithm of red over green: lips have half of it at least, mostly more than all, a
# microphone or a mask none, or less. Where skin has less than TOLD (no colours, coloured light), nothing is told.
AS_RED, TOLD = 0.4, 0.08
LIPLESS = 0.1  # of one lip without that colour: such frames teach no pattern, as long as there are others


@dataclass(frozen=True)
class Appearance:
    """How each frame's face looks; 0, of the sharpness 1, where no face is or the frame is not usable.

    strangeness: [T] 0..2, 1 - correlation of the region that looks least like the face's own.
    sharpness: [T] mean Laplacian of the face relative to its brightness, over the clip's median.
    outside: [T] share of the lips' landmarks that lie beyond the picture's edge.
    unlike_lips: [T] share of the upper or of the lower lip, the larger one, that has not the colour of lips.
    """

    strangeness: F32
    sharpness: F32
    outside: F32
    unlike_lips: F32


class FaceWatch:
    """Looks at the face of each picture while its landmarks are read; no pass over the video of its own."""

    def __init__(self) -> None:
        self._colour: list[U8] = []
        self._place: list[NDArray[np.float16]] = []
        self._inside: list[Bool] = []
        self._detail: list[float] = []

    def see(self, rgb: U8, points: F32) -> None:
        """The next picture [H, W, 3] and its landmarks [478, 3] px, NaN where there is no face."""
        if not np.isfinite(points).all():
            self._colour.append(np.zeros((POINTS, 3), np.uint8))
            self._place.append(np.full((POINTS, 2), np.nan, np.float16))
            self._inside.append(np.zeros(POINTS, bool))
            self._detail.append(np.nan)
            return
        roi = roi_from_points(points)
        face = cv2.resize(crop(rgb, roi), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        to_picture = roi.to_picture()
        unit = np.linalg.solve(to_picture[:, :2], (points[:, :2] - to_picture[:, 2]).T).T
        x, y = (unit * SIDE - 0.5).astype(np.float32).T[..., None]
        smooth = cv2.GaussianBlur(face, (0, 0), SMOOTHING_PX)
        self._colour.append(
            cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0].astype(np.uint8)
        )
        self._place.append(unit.astype(np.float16))
        size = np.array(rgb.shape[1::-1])
        shown: Bool = np.all((points[:, :2] >= 0) & (points[:, :2] <= size - 1), axis=1)
        self._inside.append(shown)
        self._detail.append(_detail(cv2.cvtColor(face, cv2.COLOR_RGB2GRAY)))

    def appearance(self, usable: NDArray[np.bool_]) -> Appearance:
        """Of all pictures seen. usable: [T] bool, those that show the person; the others tell nothing."""
        total, detail = len(self._detail), np.array(self._detail, np.float32)
        strangeness, outside, unlike_lips = np.zeros((3, total), np.float32)
        sharpness = np.ones(total, np.float32)
        seen = np.flatnonzero(np.isfinite(detail) & usable)
        if len(seen):
            colour, place = np.stack(self._colour)[seen], np.stack(self._place)[seen]
            inside = np.stack(self._inside)[seen]
            outside[seen] = 1 - inside[:, list(LIPS)].mean(1)
            typical = np.median(place, axis=0).astype(np.float64)
            right = typical[:, 0] < typical[NOSE_BRIDGE, 0]
            unlike_lips[seen] = np.concatenate(
                [_unlike_lips(colour[p], inside[p], right) for p in _parts(len(seen))]
            )
            with_lips = np.flatnonzero(unlike_lips[seen] <= LIPLESS)
            teaching = with_lips if len(with_lips) else np.arange(len(seen))
            # Without all of the mouth a face may look as strange as it does.
            inside |= ~inside[:, list(LIPS)].all(1, keepdims=True)
            for region in regions(typical, inside.mean(0) > OFTEN):
                width = np.ptp(place[:, region, 0].astype(np.float32), axis=1)
                # A side that turns away is seen at a slant, and at its rim the background.
                slant = np.minimum(width / np.median(width), 1.0) ** 2
                strange = _strangeness(colour[:, region], inside[:, region], teaching)
                strangeness[seen] = np.maximum(strangeness[seen], slant * strange)
            sharpness[seen] = detail[seen] / max(float(np.median(detail[seen])), 1e-6)
        return Appearance(strangeness, sharpness, outside, unlike_lips)


def _detail(face: U8) -> float:
    """Mean Laplacian of a grey crop [SIDE, SIDE] over its brightness, within the face."""
    inside = slice(SIDE // 4, -SIDE // 8), slice(SIDE // 4, -SIDE // 4)
    edges = np.abs(cv2.Laplacian(face, cv2.CV_32F)[inside])
    return float(edges.mean() / (face[inside].mean() + DARK))


def regions(place: NDArray[np.floating], known: Bool) -> list[NDArray[np.intp]]:
    """Landmarks of each side of the mouth with the chin, and of the upper face, without the eyes and the rim.

    The mouth's sides share its middle. With half of it covered the mouth as a whole looks much alike. place: [478, 2],
    a typical face, upright, in any unit. known: [478], landmarks that are in the picture.
    """
    eyes = float(np.linalg.norm(place[RIGHT_EYE_OUTER] - place[LEFT_EYE_OUTER]))
    to_iris = [np.linalg.norm(place - place[iris], axis=1) for iris in IRIS_CENTRES]
    skin = np.minimum(*to_iris) > EYE_REACH * eyes
    skin[list(OVAL)] = False
    skin &= known
    x, y = ((place - place[list(LIPS)].mean(0)) / eyes).T
    mouth = (np.abs(x) < 0.5) & (y > -0.25) & (y < 0.4)
    sides = (mouth & (x < MIDDLE), mouth & (x > -MIDDLE), ~mouth & (x < -MIDDLE), ~mouth & (x > MIDDLE))
    parts = [np.flatnonzero(skin & part) for part in sides]
    return [part for part in parts if len(part) >= LEAST_POINTS]


def _unlike_lips(colour: U8, inside: Bool, right: Bool) -> F64:
    """[n] share of the upper or of the lower lip, the larger one, that is less red than lips are.

    What covers a mouth all the time is the clip's own pattern, but has not the colour of anybody's lips. Each side of
    the face (`right`: [478]) is compared with its own skin, since light may come in two colours. inside: [n, 478];
    landmarks outside of the picture tell nothing.
    """
    logs = _logs(colour)
    redness = logs[..., 0] - logs[..., 1]
    upper = np.isin(np.arange(POINTS), UPPER_FACE)
    skin = np.where(
        right, *(np.median(redness[:, upper & side], axis=1, keepdims=True) for side in (right, ~right))
    )
    lost = (redness < AS_RED * skin) & (skin > TOLD) & inside
    return np.maximum(*(lost[:, list(lip)].mean(1) for lip in (UPPER_RED, LOWER_RED)))


def _strangeness(colour: U8, inside: Bool, teaching: NDArray[np.intp]) -> F64:
    """[n] 1 - correlation of a region's colours [n, R, 3] with the nearest pattern of the face's own.

    teaching: the frames, one at least, of which most show that. inside: [n, R]; landmarks outside of the picture,
    whose colours are its border's, do not count where they are less than half of the region.
    """
    inside = inside | (inside.mean(1, keepdims=True) < OFTEN)
    learned = teaching[np.unique(np.linspace(0, len(teaching) - 1, LEARNED).round().astype(int))]
    shown = inside[learned, :, None]
    usual = (_logs(colour[learned]) * shown).sum(0) / np.maximum(shown.sum(0), 1)
    values = _contrasts(colour[learned], inside[learned], usual)
    told = np.repeat(inside, 3, axis=1)  # values that come from the picture
    patterns, mean = np.zeros((0, values.shape[1])), np.median(values, axis=0)
    for step in range(TRUSTING + 1):
        strange = _unlike(values, told[learned], mean, patterns)
        count = max(1, round(TRUSTED * len(learned)))
        if step == TRUSTING:
            count = max(count, int((strange <= ALIKE).sum()))
        taken = np.argsort(strange, kind="stable")[:count]
        mean = values[taken].mean(0)
        patterns = np.linalg.svd(values[taken] - mean, full_matrices=False)[2]
        patterns = patterns[: min(PATTERNS, len(taken) // FRAMES_PER_PATTERN)]
    return np.concatenate(
        [
            _unlike(_contrasts(colour[p], inside[p], usual), told[p], mean, patterns)
            for p in _parts(len(colour))
        ]
    )


def _parts(total: int) -> Iterator[slice]:
    """Some frames at a time: all of an hour's in floating point would fill gigabytes."""
    return (slice(start, start + LEARNED) for start in range(0, total, LEARNED))


def _logs(colour: U8) -> F64:
    return np.log(colour.astype(np.float64) + DARK)


def _contrasts(colour: U8, inside: Bool, usual: F64) -> F64:
    """[n, 3 R] log colours of a region [n, R, 3] about their mean.

    Those not inside [n, R] are the `usual` ones [R, 3], as much brighter as the others are.
    """
    logs, shown = _logs(colour), inside[..., None]
    brighter = ((logs - usual) * shown).sum(1, keepdims=True) / shown.sum(1, keepdims=True)
    logs = np.where(shown, logs, usual + brighter)
    return (logs - logs.mean(1, keepdims=True)).reshape(len(logs), -1)


def _unlike(values: F64, told: Bool, mean: F64, patterns: F64) -> F64:
    """[n] 1 - correlation of those values [n, V] that are told [n, V] with the nearest pattern."""
    away = values - mean
    nearest = mean + (away @ patterns.T) @ patterns
    floor = CONTRAST**2 * told.sum(1)
    values, nearest = values * told, nearest * told
    together = (values * nearest).sum(1) + floor
    return 1 - together / np.sqrt(((values**2).sum(1) + floor) * ((nearest**2).sum(1) + floor))
