"""Derivatives by a frame's unknowns of what is measured at points of the head, compiled.

A measure m of a point in the camera frame changes by its slope dm/d(point) [3] times the point's movement, which
expression, rotation and translation give in turn: dm = slope (R dE + dr x turned + dt).
"""

from __future__ import annotations

import numpy as np
from numba import njit

BLOCK = 256  # points whose movements and rows stay in the cache together


@njit(cache=True, nogil=True)
def fill_rows(turned, slope, rotation, swing, moves, rows):  # type: ignore[no-untyped-def]
    """Fills rows [n, P, R, K+6] with the derivatives of R measures of each of P points by the unknowns.

    turned: [n, P, 3] m, about the head's centre. slope: [n, P, R, 3]. rotation: [n, 3, 3]. swing: [n, 3, 3],
    `left_jacobian`. moves: [P, 3, K] m, the points' movements by the weights. All f32.
    """
    for n in range(len(turned)):
        for p in range(len(moves)):
            for r in range(slope.shape[2]):
                _fill(
                    turned[n, p],
                    slope[n, p, r],
                    np.float32(1),
                    rotation[n],
                    swing[n],
                    moves,
                    p,
                    rows[n, p, r],
                )


@njit(cache=True, nogil=True)
def add_squares(turned, slope, rotation, swing, moves, weight, residual, square):  # type: ignore[no-untyped-def]
    """Adds rows^T rows to square [n, K+7, K+7], where rows [P, K+7] are derivatives and residual, weighted.

    As in `fill_rows`, but with one measure a point: slope [n, P, 3]. residual: [n, P]. weight: [n, P], of its square;
    points without any have no row.
    """
    frames, points = weight.shape
    rows = np.empty((BLOCK, square.shape[1]), np.float32)
    for start in range(0, points, BLOCK):
        for n in range(frames):
            count = 0
            for p in range(start, min(start + BLOCK, points)):
                if weight[n, p] > 0:
                    root = np.sqrt(weight[n, p])
                    _fill(turned[n, p], slope[n, p], root, rotation[n], swing[n], moves, p, rows[count])
                    rows[count, -1] = root * residual[n, p]
                    count += 1
            used = rows[:count]
            square[n] += np.dot(used.T, used)


@njit(cache=True, nogil=True)
def _fill(turned, slope, factor, rotation, swing, moves, p, row):  # type: ignore[no-untyped-def]
    """The derivatives at point p, times `factor`."""
    shapes = moves.shape[2]
    x, y, z = factor * slope[0], factor * slope[1], factor * slope[2]
    u, v, w = turned[1] * z - turned[2] * y, turned[2] * x - turned[0] * z, turned[0] * y - turned[1] * x
    a = x * rotation[0, 0] + y * rotation[1, 0] + z * rotation[2, 0]
    b = x * rotation[0, 1] + y * rotation[1, 1] + z * rotation[2, 1]
    c = x * rotation[0, 2] + y * rotation[1, 2] + z * rotation[2, 2]
    for k in range(shapes):
        row[k] = a * moves[p, 0, k] + b * moves[p, 1, k] + c * moves[p, 2, k]
    for k in range(3):
        row[shapes + k] = u * swing[0, k] + v * swing[1, k] + w * swing[2, k]
    row[shapes + 3], row[shapes + 4], row[shapes + 5] = x, y, z
