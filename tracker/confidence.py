"""How far each frame of a fit can be trusted, 0..1, and what speaks against it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracker.occlusion import Appearance
from tracker.track import F32, F64, Track

TOLERATED = 1.5  # residuals up to this many times the clip's median cost nothing
# The same of the deviation of the skin or of the mouth's: well-fitted laughs and turns reach 2.8.
TOLERATED_SKIN = 3.0
# What costs nothing, and what leaves half of the confidence.
STRANGE, STRANGE_HALF = 0.10, 0.15  # see Appearance: bare faces stay below .12 in 99.5 % of the frames
UNLIKE_LIPS, UNLIKE_LIPS_HALF = 0.2, 0.3  # of one lip: bare ones stay below .05 but in a frame of thousands
SHARP, SHARP_HALF = 0.70, 0.55  # of the clip's median
# Of the lips' landmarks beyond the picture's edge; the landmarker draws those within it closer together.
CUT_OFF, CUT_OFF_HALF = 0.05, 0.125
# Of the face's axis from the line of sight; landmarks are lost near 60.
FACING_DEG, FACING_HALF_DEG = 35.0, 50.0
# What a degree counts from above: a jaw that opens moves back as well as down, which looks like less from there.
FROM_ABOVE = 2.0
TURNED = 0.75  # what is left by a turn that is named whatever else is amiss: at 41 degrees


def confidence(
    error: F64, visible: F64, presence: NDArray[np.floating], good: NDArray[np.int64], total: int
) -> F32:
    """[T] 0..1 from the landmarks alone, 0 where nothing was measured.

    error: [n, L] distance of fitted and observed landmarks, in any unit proportional to the face.
    visible: [n, L], as the pose tells. presence: [n], the landmarker's. good: [n] the measured frames of `total`.
    A frame loses confidence by a residual above the clip's own median, by one that jumps from its
    neighbours', by a hidden side, and by presence.
    """
    residual = (error * visible).sum(1) / visible.sum(1)
    typical = max(float(np.median(residual)), 1e-9)
    before, after = np.roll(residual, 1), np.roll(residual, -1)
    before[0], after[-1] = residual[0], residual[-1]
    jump = np.maximum(residual - np.maximum(before, after), 0.0) / typical
    excess = np.maximum(residual / typical - TOLERATED, 0.0)
    seen = np.clip(visible.mean(1) / 0.6, 0.0, 1.0)
    out = np.zeros(total, np.float32)
    out[good] = presence * np.exp(-excess - jump) * seen
    return np.clip(out, 0.0, 1.0)


def bare(appearance: Appearance) -> F32:
    """[T] 0..1, how far nothing covers the face or cuts its mouth off: the evidence that a fit's landmarks are."""
    return (_uncovered(appearance) * _whole(appearance)).astype(np.float32)


def _uncovered(appearance: Appearance) -> F64:
    usual = _factor(appearance.strangeness, STRANGE, STRANGE_HALF)
    return usual * _factor(appearance.unlike_lips, UNLIKE_LIPS, UNLIKE_LIPS_HALF)


def _whole(appearance: Appearance) -> F64:
    return _factor(appearance.outside, CUT_OFF, CUT_OFF_HALF)


def judge(track: Track, appearance: Appearance, deviation: F32 | None = None) -> tuple[Track, list[str]]:
    """The track with its confidence lowered by what the pictures and the pose tell, and the main doubt of each frame.

    deviation: [T, 2], see `refine.Refined`; None where no skin was compared.
    Doubts: `poor_fit`, `occluded`, `cut_off`, `blurred`, `turned_away`; a frame's is the one that costs it the most,
    but for a face turned away, which looks strange and fits badly for that.
    """
    factors = {
        "occluded": _uncovered(appearance),
        "cut_off": _whole(appearance),
        "blurred": _factor(-appearance.sharpness, -SHARP, -SHARP_HALF),
        "turned_away": _factor(off_axis_deg(track), FACING_DEG, FACING_HALF_DEG),
        "poor_fit": track.confidence if deviation is None else track.confidence * _usual_skin(deviation),
    }
    each = np.stack([np.asarray(values, np.float32) for values in factors.values()])
    turned = factors["turned_away"] < TURNED
    doubts = [
        "turned_away" if aside else tuple(factors)[index] for aside, index in zip(turned, each.argmin(0))
    ]
    return replace(track, confidence=each.prod(0)), doubts


def _usual_skin(deviation: F32) -> F32:
    """[T] 0..1, less where the skin, or the mouth's alone, looks other than usual: covered, blurred."""
    excess = np.nan_to_num(deviation, nan=0.0).max(1) - TOLERATED_SKIN
    return np.exp(-np.maximum(excess, 0.0))


def _factor(value: NDArray[np.floating], free: float, half: float) -> F64:
    """1 up to `free`, 0.5 at `half`, falling on exponentially."""
    return np.exp2(-np.maximum(value.astype(np.float64) - free, 0.0) / (half - free))


def off_axis_deg(track: Track) -> F64:
    """[T] angle between the face's axis and the line from the head to the camera, degrees.

    The part of it by which the camera stands above counts FROM_ABOVE times.
    """
    x, y, z = _towards_camera(track).T
    above = np.maximum(y, 0.0) / np.maximum(np.hypot(x, y), 1e-9)
    return np.degrees(np.arccos(np.clip(z, -1.0, 1.0))) * np.sqrt(1.0 + (FROM_ABOVE**2 - 1.0) * above**2)


def from_above_deg(track: Track) -> F64:
    """[T] degrees by which the camera stands above the plane of the head's nose and ears; less than 0 below it."""
    return np.degrees(np.arcsin(np.clip(_towards_camera(track)[:, 1], -1.0, 1.0)))


def _towards_camera(track: Track) -> F64:
    """[T, 3] unit, head axes: from the head to the camera."""
    head = Rotation.from_rotvec(track.rotation) * Rotation.from_rotvec(track.neck)
    return head.inv().apply(-track.translation / np.linalg.norm(track.translation, axis=1, keepdims=True))
