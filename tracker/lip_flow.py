"""How far the lips part from one frame to another by dense optical flow between pictures of the mouth.

Unlike what is found again along the lines (tracker/lip_motion.py) it hardly errs where little moves, and follows quick
closures too slowly: the two err apart from each other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.lip_lines import SAMPLES, LipLines
from tracker.lip_motion import STRETCH, Motion
from tracker.track import F32, F64
from tracker.view import U8, sampled

F16 = NDArray[np.float16]

# What is looked at, mm from the middle of the lines: the mouth at a scale of its own, whatever the picture's.
PX_MM = 0.625
ACROSS, DOWN = np.arange(-30.0, 30.0, PX_MM), np.arange(-22.0, 22.0, PX_MM)
FINEST = 0  # halvings of that, with which the search ends
KEPT = SAMPLES[::3]  # of the samples along a line: flow is smooth
BESIDE = np.array([1, 2, 3])  # of these from an edge on, on the lip


class LipFlow:
    """Optical flow along the lines across the mouth, between frames that are looked at one after the other.

    By DIS (Kroeger et al., Fast Optical Flow using Dense Inverse Search, 2016), OpenCV's.
    """

    def __init__(self, lines: LipLines, apart: Iterable[int]) -> None:
        """apart: how many looks lie between those that are compared."""
        self._lines = lines
        # By looks apart: [Q, K] mm that what is seen along the lines goes down, told by the earlier and by the later.
        self._there: dict[int, list[F16]] = {links: [] for links in apart}
        self._back: dict[int, list[F16]] = {links: [] for links in self._there}
        self._last = deque[tuple[U8, F32]](maxlen=max(self._there))
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._flow.setFinestScale(FINEST)

    def look(self, rgb: U8, row: int) -> None:
        """Compare the picture [H, W, 3] of the lines' row with those before."""
        mouth, places = self._mouth(rgb, row)
        for apart, there in self._there.items():
            if apart <= len(self._last):
                before, placed = self._last[-apart]
                there.append(self._down(before, mouth, placed))
                self._back[apart].append(self._down(mouth, before, places))
        self._last.append((mouth, places))

    def motion(self, edges: F64) -> Motion:
        """By the looks [n], whose edges lie at [n, Q, 2] mm along the lines; see `tracker.lip_motion.steadied`."""
        return {
            apart: STRETCH / 2 * (_parted(there, edges[:-apart]) - _parted(self._back[apart], edges[apart:]))
            for apart, there in self._there.items()
            if there
        }

    def _mouth(self, rgb: U8, row: int) -> tuple[U8, F32]:
        """Grey levels [H, W] about the mouth, with the lines upright, and where in them these run [Q, K, 2] px."""
        down = self._lines.step[row]
        axes = np.array([[down[1], -down[0]], down])  # px of the picture for each mm across and down
        middle = self._lines.middle[row].mean(0)
        grid = np.stack(np.meshgrid(ACROSS, DOWN), axis=-1) @ axes + middle
        mouth = sampled(rgb, grid, PX_MM * float(np.linalg.norm(down)))
        at = (self._lines.middle[row] - middle) @ axes.T / (down @ down)
        along = np.stack(np.broadcast_arrays(at[:, :1] - ACROSS[0], at[:, 1:] - DOWN[0] + KEPT), axis=-1)
        return cv2.cvtColor(mouth, cv2.COLOR_RGB2GRAY), (along / PX_MM).astype(np.float32)

    def _down(self, now: U8, then: U8, places: F32) -> F16:
        flow = self._flow.calc(now, then, None)[..., 1]
        x, y = np.moveaxis(places, 2, 0)
        found = cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return (PX_MM * found).astype(np.float16)


def _parted(down: list[F16], edges: F64) -> F64:
    """[m, Q] mm that lips part by what goes down along the lines [m][Q, K] beside edges [m, Q, 2]."""
    nearest = (edges - KEPT[0]) / (KEPT[1] - KEPT[0])
    beside = nearest[..., None].round().astype(int) + np.array([[-1], [1]]) * BESIDE
    rows = np.clip(beside, 0, len(KEPT) - 1).reshape(*edges.shape[:2], -1)
    moved = np.take_along_axis(np.stack(down), rows, axis=2).reshape(beside.shape).astype(np.float64)
    upper, lower = np.moveaxis(np.median(moved, axis=3), 2, 0)
    return lower - upper
