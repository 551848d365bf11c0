"""Pictures of high dynamic range, which phones film, as the pictures of usual range that everything here expects.

Read as they are stored, they are dull: lips hardly differ from the skin around them. What is stored is taken to the
light of a screen (ITU-R BT.2100), and that to what makes a usual screen give as much of it, white for white (BT.2408).
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
F64 = NDArray[np.float64]

PQ, HLG = 16, 18  # FFmpeg's numbers of transfer functions
PQ_WHITE, HLG_WHITE = 0.58, 0.75  # of the range stored, of a white sheet (BT.2408, table 1)
SCREEN = 2.4  # power of a usual screen (BT.1886)
# Power of the brightness of a scene, whose light HLG stores, on a screen of 1000 cd/m^2 (BT.2100, table 5).
SCENE = 1.2
LUMINANCE = np.array([[0.2627, 0.6780, 0.0593]], np.float32)  # of linear red, green and blue of BT.2020
# Those to red, green and blue of BT.709 (ITU-R BT.2407).
TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
KNEE = 0.8  # of a usual picture's range: what is brighter is pressed together below 1
MOST = 50.0  # times white: PQ ends there
LEVELS = 1 << 16
ROWS = 64  # of a picture, taken at once: what lies between is small enough for the processor's cache


def usual_range(rgb: U16, transfer: int) -> U8:
    """A picture [H, W, 3] u16, BT.2020 by the transfer function PQ or HLG, as one of usual range, BT.709."""
    out = np.empty(rgb.shape, np.uint8)
    for top in range(0, len(rgb), ROWS):
        out[top : top + ROWS] = _shown(rgb[top : top + ROWS], transfer)
    return out


def _shown(rgb: U16, transfer: int) -> U8:
    light, written = _tables(transfer)
    shown = cv2.LUT(np.ascontiguousarray(rgb), light)
    if transfer == HLG:
        raised = cv2.pow(cv2.transform(shown, LUMINANCE), SCENE - 1)
        shown = cv2.multiply(shown, cv2.merge([raised] * 3))
    # A table by the light itself would have too few levels for the dark.
    root = cv2.sqrt(cv2.max(cv2.transform(shown, TO_BT709), 0.0))
    level = cv2.multiply(root, (LEVELS - 1) / float(np.sqrt(MOST)), dtype=cv2.CV_16U)
    return np.asarray(cv2.LUT(level, written), np.uint8)


@cache
def _tables(transfer: int) -> tuple[NDArray[np.float32], U8]:
    """[LEVELS] light of each stored level, 1 for white; and [LEVELS] u8 what is written of light, by its root."""
    level = np.linspace(0.0, 1.0, LEVELS)
    light_of, white = (_pq, PQ_WHITE) if transfer == PQ else (_hlg, HLG_WHITE)
    light = light_of(level) / light_of(np.array(white))
    signal = (level**2 * MOST) ** (1 / SCREEN)
    bright = KNEE + (1 - KNEE) * (1 - np.exp((KNEE - signal) / (1 - KNEE)))
    pressed = np.where(signal < KNEE, signal, bright)
    return light.astype(np.float32), np.round(255 * pressed).astype(np.uint8)


def _pq(level: F64) -> F64:
    """Light of the screen, cd/m^2 (BT.2100, table 4, EOTF)."""
    root = level ** (1 / 78.84375)
    return np.asarray(
        1e4 * (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (1 / 0.1593017578125)
    )


def _hlg(level: F64) -> F64:
    """Light of the scene, 0..1 (BT.2100, table 5, inverse OETF)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.asarray(np.where(level <= 0.5, level**2 / 3, (np.exp((level - c) / a) + b) / 12))
