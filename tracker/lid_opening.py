"""What the landmarker reads on shut eyes: on some faces it keeps their lids millimetres apart.

It is right about open eyes, so that what it adds fades out towards the usual opening. Blinks tell it: their fastest
frames show shut lids.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import argrelmin

from tracker.energy import LID_PAIRS
from tracker.track import F64
from tracker.view import Index

BLINK = 0.4  # of the usual opening: what closes less is no blink, but a glance down
FEWEST = 3  # blinks, in order to tell what is read on shut lids
MOST = 0.003  # m: lids read wider than this in blinks do not shut in them


def lids_shut(observed: F64, px_per_m: F64, touch: F64, sound: Index) -> F64:
    """Landmarks [n, 478, 2] px with lids that shut when the subject blinks; as they are if that does not show.

    px_per_m: [n]. touch: [14] m, between the landmarks of LID_PAIRS where lids touch. sound: rows of bare faces.
    """
    upper, lower = np.transpose(LID_PAIRS)
    apart = observed[:, lower] - observed[:, upper]
    height = np.linalg.norm(apart, axis=-1) / px_per_m[:, None]
    seen = height[sound]
    opening, usual = seen.mean(1), np.median(seen, axis=0)
    (closing,) = argrelmin(opening)
    blinks = closing[opening[closing] < BLINK * usual.mean()]
    if len(blinks) < FEWEST:
        return observed
    shut = np.median(seen[blinks], axis=0)
    too_much = np.clip(shut - touch, 0, MOST)
    fade = np.clip((usual - height) / np.maximum(usual - shut, 1e-6), 0, 1)
    share = too_much * fade / np.maximum(height, 1e-6) / 2
    out = observed.copy()
    out[:, upper] += share[..., None] * apart
    out[:, lower] -= share[..., None] * apart
    return out
