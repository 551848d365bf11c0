"""Pictures to check a track by: ways to draw the fitted face over the picture it was fitted to."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.albedo import Albedo, Rendering, rerender
from tracker.head import HeadModel
from tracker.raster import shade
from tracker.scene import U8, Scene

MODES = {
    "shaded": "the fitted surface in clay",
    "wireframe": "the fitted mesh's edges, with the lines where the lips and the lids meet, and the irises",
    "albedo": "the face re-rendered: the subject's colours in the light of each frame",
    "error": "how far the re-rendered face is from the picture, in grey levels",
    "landmarks": "detected points in green, each joined to its fitted one in red",
}
NEEDS_ALBEDO = ("albedo", "error")

MESH_OPACITY, EDGE_OPACITY = 0.5, 0.5
CLAY = (196, 178, 168)
EDGES, LIPS, LIDS, IRISES = (120, 220, 255), (255, 60, 60), (255, 225, 60), (120, 255, 120)
DETECTED, FITTED = (70, 235, 90), (255, 60, 60)
WHITE = (240, 240, 240)
SUBPIXEL = 4  # bits: a sixteenth of a pixel, so that a wrong half pixel would be seen
LARGEST_ERROR = 40  # grey levels, at the upper end of the colours
DIM = 0.45  # of the picture's own brightness, where there is no error to be told


def draw(scene: Scene, mode: str, head: HeadModel, rendering: Rendering | None) -> U8:
    """[H, W, 3] u8: the scene's picture with the fitted face over it in one of MODES.

    rendering: for those that NEEDS_ALBEDO.
    """
    if mode == "shaded":
        return _shaded(scene)
    if mode == "wireframe":
        return _wireframe(scene, head)
    if mode == "landmarks":
        return _landmarks(scene)
    assert rendering is not None
    return _albedo(scene, rendering) if mode == "albedo" else _error(scene, rendering)


def draw_modes(scene: Scene, modes: Sequence[str], head: HeadModel, albedo: Albedo | None) -> list[U8]:
    """One picture [H, W, 3] u8 for each of the modes."""
    rendering = rerender(scene, albedo) if albedo else None
    return [draw(scene, mode, head, rendering) for mode in modes]


def _shaded(scene: Scene) -> U8:
    drawn = scene.picture.copy()
    part = scene.part(drawn)
    clay = np.tile(np.asarray(CLAY, np.uint8), (len(scene.vertices), 1))
    # Where there is no face the background is the picture itself, so that the mixture leaves it as it is.
    shaded = shade(scene.raster, scene.faces, scene.vertices, clay, part)
    part[:] = cv2.addWeighted(shaded, MESH_OPACITY, part, 1 - MESH_OPACITY, 0)
    return drawn


def _wireframe(scene: Scene, head: HeadModel) -> U8:
    shown = np.zeros(len(scene.faces) + 1, bool)
    shown[scene.raster.triangle] = True  # -1, where there is no triangle, is the last
    edges = scene.picture.copy()
    _lines(edges, scene.pixels[scene.faces[shown[:-1]]], EDGES, closed=True)
    drawn: U8 = cv2.addWeighted(edges, EDGE_OPACITY, scene.picture, 1 - EDGE_OPACITY, 0)
    for part, colour in (("inner_lip", LIPS), ("left_eyelid", LIDS), ("right_eyelid", LIDS)):
        for side in ("upper", "lower"):
            if (name := f"{part}_{side}") in head.regions:
                _lines(drawn, scene.pixels[None, head.regions[name]], colour, closed=False)
    for side in ("left", "right"):
        if f"{side}_iris" in head.regions and f"{side}_eyelid_upper" in head.regions:
            _iris(drawn, scene, head, side)
    return drawn


def _iris(drawn: U8, scene: Scene, head: HeadModel, side: str) -> None:
    """Line an iris where it is seen between the lids, whose rims both run from one corner to the other."""
    upper, lower = (scene.pixels[head.regions[f"{side}_eyelid_{lid}"]] for lid in ("upper", "lower"))
    between = np.zeros(drawn.shape[:2], np.uint8)
    cv2.fillPoly(between, [_fine(np.concatenate([upper, lower[::-1]]))], 1, cv2.LINE_8, SUBPIXEL)
    lined = drawn.copy()
    ring = cv2.convexHull(scene.pixels[head.regions[f"{side}_iris"], :2])
    _lines(lined, ring.reshape(1, -1, 2), IRISES, closed=True)
    cv2.copyTo(lined, between, drawn)


def _albedo(scene: Scene, rendering: Rendering) -> U8:
    drawn = scene.picture.copy()
    cv2.copyTo(rendering.colour, rendering.known, scene.part(drawn))
    return drawn


def _error(scene: Scene, rendering: Rendering) -> U8:
    grey = cv2.cvtColor(scene.picture, cv2.COLOR_RGB2GRAY)
    drawn: U8 = cv2.cvtColor(cv2.convertScaleAbs(grey, alpha=DIM), cv2.COLOR_GRAY2RGB)
    error = cv2.cvtColor(cv2.absdiff(rendering.colour, rendering.blurred), cv2.COLOR_RGB2GRAY)
    heat = _heat(cv2.convertScaleAbs(error, alpha=255 / LARGEST_ERROR))
    cv2.copyTo(heat, rendering.known, scene.part(drawn))
    _legend(drawn)
    return drawn


def _landmarks(scene: Scene) -> U8:
    drawn = scene.picture.copy()
    pairs = np.stack([scene.fitted, scene.detected], axis=1)
    pairs = pairs[np.isfinite(pairs).all((1, 2))]
    extent = float(np.ptp(pairs[..., 0])) if len(pairs) else 0.0
    radius = max(1.0, extent / 320)
    _lines(drawn, pairs, FITTED, closed=False)
    for side, colour, share in ((0, FITTED, 1.0), (1, DETECTED, 0.8)):
        for x, y in _fine(pairs[:, side]).tolist():
            cv2.circle(drawn, (x, y), round(share * radius * 2**SUBPIXEL), colour, -1, cv2.LINE_AA, SUBPIXEL)
    return drawn


def _lines(picture: U8, points: NDArray[np.floating], colour: tuple[int, int, int], closed: bool) -> None:
    """Lines through points [N, n, 2 or more] px."""
    cv2.polylines(picture, list(_fine(points)), closed, colour, 1, cv2.LINE_AA, SUBPIXEL)


def _fine(points: NDArray[np.floating]) -> NDArray[np.int32]:
    return np.round(points[..., :2] * 2**SUBPIXEL).astype(np.int32)


def _heat(level: U8) -> U8:
    """[.., 3] u8 RGB of levels [h, w] u8."""
    colours: U8 = cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1]
    return colours


def _legend(picture: U8) -> None:
    """A bar of the colours with their grey levels in the lower right corner."""
    height, width = picture.shape[:2]
    unit = max(1, min(height, width) // 40)
    bar = _heat(np.tile(np.linspace(0, 255, 8 * unit).astype(np.uint8), (unit, 1)))
    left, top = width - 10 * unit, height - 3 * unit
    picture[top : top + unit, left : left + 8 * unit] = bar
    for share in (0.0, 0.5, 1.0):
        at = (round(left + (8 * share - 0.4) * unit), top + round(2.2 * unit))
        letter(picture, f"{share * LARGEST_ERROR:.0f}", at, unit)


def letter(
    picture: U8, text: str, origin: tuple[int, int], height: int, colour: tuple[int, int, int] = WHITE
) -> None:
    """Write a line of text on dark ground into a picture. origin: its lower left corner. height: of capitals, px."""
    size, weight = height / 21, max(1, round(height / 12))  # capitals of the font are 21 px high at size 1
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, weight)
    rim = max(2, height // 3)
    (x, y), black = origin, (0, 0, 0)
    cv2.rectangle(picture, (x - rim, y - height - rim), (x + width + rim, y + rim), black, -1)
    cv2.putText(picture, text, origin, cv2.FONT_HERSHEY_SIMPLEX, size, colour, weight, cv2.LINE_AA)
