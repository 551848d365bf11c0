"""How far the lips move from one frame to another: their own colours, found again along the lines across the mouth.

Colours tell where a lip ends, but err, and for several frames alike: by what lies behind it, by its shade. How far the
lip and the skin beside it have moved between two frames they tell with another error, and where both are known, widths
that agree with both err by a fifth less.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from tracker.lip_lines import SAMPLES, STEP_MM
from tracker.threads import THREADS, side_by_side
from tracker.track import F64, STEP_S
from tracker.view import LOG, U8

# Time between frames in which motion is looked for (the farther apart, the less errors add up), and frames at most.
LONGEST_S, MOST_APART = 0.35, 64
BESIDE = 25  # samples beside an edge, from the first step on: 10 mm of lip and skin
# Samples of a line that are looked at: 13 mm to both sides of its middle. Nose and chin move on their own.
FIRST, LAST = (int(np.abs(SAMPLES - end).argmin()) for end in (-13.0, 13.0))
REACH, FINER = 5, 2  # steps to both sides of what the edges tell, and trials in a step
NEIGHBOUR = 0.5  # weight of the two lines beside a line in its motion
STRETCH = 1.1  # of an edge's motion to that of what lies beside it
# Standard deviations of a width by its edges, as if each frame erred on its own (shut lips err by .1 mm, open ones by
# .4 to .6, some eight frames alike), and of its change from one frame to the next: so much, and a share of it more. On
# rendered films the change errs by half of that share, but real lips thicken and roll as they move. All for frames
# STEP_S apart: at other rates errors last as long.
EDGE_MM, EDGE_SHARE = 0.1, 0.25
MOVED_MM, MOVED_SHARE = 0.1, 0.2
DOUBT_MM = 1.0  # by which edges and motion disagree where the motion counts half

Motion = dict[int, F64]  # by frames apart: [n - apart, Q] mm by which the widths of n frames grow until then


def links(time: F64) -> list[int]:
    """How many frames lie between those that are compared, of frames at `time` [n] s, ascending: 1, 2, 4, ..."""
    farthest = np.clip(LONGEST_S / STEP_S / _step(time), 1, MOST_APART)
    return [2**n for n in range(int(np.log2(farthest)) + 1)]


def steadied(edges: F64, motions: Sequence[Motion], run: NDArray[np.int64], time: F64) -> F64:
    """[n, Q] mm, widths between edges [n, Q, 2] mm that agree with how the lips move, in the least squares.

    motions: found in ways that err apart from each other. run: [n], the same number for frames between which lips may
    be followed, -1 for frames in which they are not. time: [n] s, ascending.
    """
    widths = np.maximum(edges[..., 1] - edges[..., 0], 0.0)
    step = _step(time)
    weight = step * (EDGE_MM + EDGE_SHARE * widths) ** -2.0
    # The upper diagonals of the normal matrix, as solveh_banded has them, for each line.
    farthest = max(apart for motion in motions for apart in motion)
    normal = np.zeros((farthest + 1, *widths.shape))
    right = weight * widths
    normal[-1] = weight
    for motion in motions:
        for apart, change in motion.items():
            share = step / len(motion) / len(motions)
            told = widths[apart:] - widths[:-apart]
            fast = np.maximum(np.abs(told), np.abs(change))
            steps = (time[apart:] - time[:-apart])[:, None] / STEP_S
            trust = (
                share * linked(run, apart)[:, None] / (np.sqrt(steps) * MOVED_MM + MOVED_SHARE * fast) ** 2
            )
            trust /= 1 + ((change - told) / DOUBT_MM) ** 2
            normal[-1, :-apart] += trust
            normal[-1, apart:] += trust
            normal[-1 - apart, apart:] -= trust
            right[:-apart] -= trust * change
            right[apart:] += trust * change
    lines = range(widths.shape[1])
    return np.maximum(np.stack([solveh_banded(normal[:, :, q], right[:, q]) for q in lines], axis=1), 0.0)


def along_lines(edges: F64, colours: U8, run: NDArray[np.int64], time: F64) -> Motion:
    """How what lies beside the edges [n, Q, 2] mm moves along lines of colours [n, Q, S, 3] u8; see `steadied`."""
    found = {}
    for apart in links(time):
        found[apart] = np.zeros((max(len(edges) - apart, 0), edges.shape[1]))
        parts = np.array_split(np.flatnonzero(linked(run, apart)), THREADS)
        list(side_by_side(partial(_fill_changes, colours, edges, apart, found[apart]), parts))
        found[apart] *= STRETCH
    return found


def linked(run: NDArray[np.int64], apart: int) -> NDArray[np.bool_]:
    """[n - apart] frames that lips are followed from, of the runs [n] to so many frames later."""
    return (run[apart:] == run[:-apart]) & (run[apart:] >= 0)


def _step(time: F64) -> float:
    """Usual time between two frames, in STEP_S."""
    return float(np.median(np.diff(time))) / STEP_S if len(time) > 1 else 1.0


@njit(cache=True, fastmath=True, nogil=True)
def _fill_changes(colours, edges, apart, change, rows):  # type: ignore[no-untyped-def]
    """Fills change [.., Q] mm, of the widths from each of the frames `rows` to the one `apart` frames later.

    The mean of what is found forwards and backwards. colours: [n, Q, S, 3] u8. edges: [n, Q, 2] mm.
    """
    now, then = np.empty(colours.shape[1:], np.float32), np.empty(colours.shape[1:], np.float32)
    for row in rows:
        for at, tone in np.ndenumerate(colours[row]):
            now[at], then[at] = LOG[tone], LOG[colours[row + apart][at]]
        before, after = edges[row], edges[row + apart]
        for line in range(len(before)):
            for side in range(2):
                there = _shift(now, then, before, after, line, side)
                back = _shift(then, now, after, before, line, side)
                change[row, line] += (there - back) / 2 if side else (back - there) / 2


@njit(cache=True, fastmath=True, nogil=True)
def _shift(now, then, before, after, line, side):  # type: ignore[no-untyped-def]
    """mm by which what lies beside an edge is found farther down a line.

    now, then: [Q, S, 3] logarithms of two frames' colours; before, after: [Q, 2] mm, their edges.
    """
    told = after[line, side] - before[line, side]
    cost = np.zeros(2 * REACH * FINER + 1)
    best = 0
    for trial in range(len(cost)):
        shift = told + (trial / FINER - REACH) * STEP_MM
        for near in range(max(line - 1, 0), min(line + 2, len(now))):
            weight = 1.0 if near == line else NEIGHBOUR
            cost[trial] += weight * _difference(now[near], then[near], before[near, side], shift, side)
        if cost[trial] < cost[best]:
            best = trial
    between = 0.0
    if 0 < best < len(cost) - 1:
        # The lowest point of a parabola through the lowest three.
        bend = cost[best - 1] + cost[best + 1] - 2 * cost[best]
        if bend > 0:
            between = 0.5 * (cost[best - 1] - cost[best + 1]) / bend
    return told + ((best + between) / FINER - REACH) * STEP_MM


@njit(cache=True, fastmath=True, nogil=True)
def _difference(now, then, edge, shift, side):  # type: ignore[no-untyped-def]
    """Sum of squares by which a line's colours [S, 3] beside an edge differ from those `shift` mm farther down.

    The mean difference does not count: it is light.
    """
    total = 0.0
    for channel in range(3):
        mean, square = 0.0, 0.0
        for step in range(1, BESIDE + 1):
            place = (edge - SAMPLES[0]) / STEP_MM + (step if side else -step)
            gap = _between(now, place, channel) - _between(then, place + shift / STEP_MM, channel)
            mean += gap
            square += gap * gap
        total += square - mean * mean / BESIDE
    return total


@njit(cache=True, fastmath=True, nogil=True)
def _between(line, place, channel):  # type: ignore[no-untyped-def]
    """A line's colour [S, 3] between two samples; beyond those looked at, the last one's."""
    place = min(max(place, FIRST), LAST)
    low = min(int(place), LAST - 1)
    return line[low, channel] + (place - low) * (line[low + 1, channel] - line[low, channel])
