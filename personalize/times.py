"""Times that a user writes, as frames of a motion: `0:1.5,8.2:` are spans, `3.2,5` single frames, `10%` a share."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from model.motion import Motion
from personalize.errors import UserError


def frames_at(text: str, motion: Motion, option: str) -> NDArray[np.bool_]:
    """Comma-separated TIME, FROM:TO, FROM: or :TO -> frames [N] of the motion.

    A time is in seconds of presentation time, on which the motion starts at its `start_s`, or a share of the motion's
    length with a % sign. A span holds the frames nearest to FROM up to but without the one nearest to TO. Raises
    UserError, naming the option, for what cannot be read, lies outside the motion or holds no frame.
    """
    count = len(motion.valid)
    frames = np.zeros(count, bool)
    # A film may begin before its first tracked face does: time 0 is the beginning of both.
    earliest = min(0, round(-motion.start_s * motion.fps))
    for item in text.split(",") if text else []:
        first, colon, last = (part.strip() for part in item.partition(":"))
        if colon:
            start = max(0, _frame(first, motion, option, earliest, count)) if first else 0
            stop = _frame(last, motion, option, earliest, count) if last else count
        else:
            start = _frame(first, motion, option, 0, count - 1)
            stop = start + 1
        if start >= stop:
            raise UserError(f"{option} {item}: holds no frame; give FROM:TO with FROM before TO")
        frames[start:stop] = True
    return frames


def _frame(text: str, motion: Motion, option: str, lowest: int, highest: int) -> int:
    """The frame nearest to a time, which may lie outside the motion as far as `lowest` and `highest` say."""
    try:
        number = float(text.removesuffix("%"))
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise UserError(
            f"{option}: {text!r} is not a time; write seconds or shares, e.g. 0:1.5,8.2: or :10%,90%:"
        )
    length_s = len(motion.valid) / motion.fps
    after_start = number / 100 * length_s if text.endswith("%") else number - motion.start_s
    frame = math.floor(after_start * motion.fps + 0.5)
    if not lowest <= frame <= highest:
        end_s = motion.start_s + length_s
        raise UserError(
            f"{option}: {text} is outside the motion, which is from {motion.start_s:.2f} to {end_s:.2f} s, its last"
            f" frame at {end_s - 1 / motion.fps:.2f} s"
        )
    return frame
