"""The split of a clip in time: train, validation and test, 2 : 1 : 1, each one stretch of the clip."""

from __future__ import annotations

from typing import Any

import numpy as np

from personalize.shots import F64, Bool, Frames, covered, usable_seconds

PARTS = (("train", 0.5), ("val", 0.75), ("test", 1.0))  # each up to this share of the usable time
GUARD_S = 0.2  # left out about a boundary inside a shot: neighbouring frames are nearly equal
SEARCH_SHARE = 0.04  # a boundary moves to a cut within this share of the usable time


def make_split(frames: Frames) -> dict[str, Any]:
    """`split.json`: spans [[start s, end s], ...] of `train`, `val`, `test`, and `usable_seconds`.

    The spans hold usable time only, in presentation time. A boundary lies at a cut when one is near.
    """
    spent = np.concatenate([[0.0], np.cumsum(covered(frames))[:-1]])  # usable time before each frame
    total = usable_seconds(frames)
    bounds = [0.0] + [_boundary(frames, spent, share * total, total) for _, share in PARTS[:-1]] + [np.inf]
    split: dict[str, Any] = {"usable_seconds": round(total, 3)}
    for (name, _), low, high in zip(PARTS, bounds, bounds[1:]):
        inside = frames.usable & (frames.time >= low) & (frames.time < high)
        inside &= ~_guarded(frames, low) & ~_guarded(frames, high)
        split[name] = _spans(frames, inside)
    return split


def _boundary(frames: Frames, spent: F64, target: float, total: float) -> float:
    """Time of the frame at which `target` s of usable time are spent, or of the first of a shot near it."""
    starts = np.flatnonzero(np.diff(frames.segment, prepend=frames.segment[0]))
    if len(starts):
        nearest = int(starts[np.abs(spent[starts] - target).argmin()])
        if abs(spent[nearest] - target) <= SEARCH_SHARE * total:
            return float(frames.time[nearest])
    return float(frames.time[min(int(np.searchsorted(spent, target)), len(spent) - 1)])


def _guarded(frames: Frames, bound: float) -> Bool:
    """Frames of the same shot too near to a boundary."""
    index = int(np.searchsorted(frames.time, bound))
    if index == 0 or index >= len(frames.time) or frames.segment[index] != frames.segment[index - 1]:
        return np.zeros(len(frames.time), bool)
    return np.abs(frames.time - bound) < GUARD_S / 2


def _spans(frames: Frames, inside: Bool) -> list[list[float]]:
    """[start, end] s of the stretches of `inside` [T] that no cut or long gap interrupts."""
    index = np.flatnonzero(inside)
    if not len(index):
        return []
    alone = covered(frames)
    step = np.diff(frames.time[index])
    ends = np.flatnonzero((step > alone[index[:-1]] + 1e-6) | (np.diff(frames.segment[index]) != 0))
    first = np.concatenate([[0], ends + 1])
    last = np.concatenate([ends, [len(index) - 1]])
    return [
        [round(float(frames.time[index[a]]), 4), round(float(frames.time[index[b]] + alone[index[b]]), 4)]
        for a, b in zip(first, last)
    ]
