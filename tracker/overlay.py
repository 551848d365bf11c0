"""Pictures to check the track by: the frame with the fitted mesh, detected and fitted landmarks, and confidence."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from numpy.typing import NDArray
from torch import from_numpy

from tracker.head import HeadModel
from tracker.raster import project, rasterize, shade
from tracker.track import Landmarks, Track

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

MESH_OPACITY = 0.5
CLAY = (196, 178, 168)
DETECTED, FITTED = (70, 235, 90), (255, 70, 60)
GOOD, DOUBTFUL, BAD = (70, 200, 90), (245, 180, 40), (230, 60, 50)
TALLEST, SMALLEST = 1080, 720


@dataclass(frozen=True)
class Placed:
    """The fitted head of one frame in the camera frame: vertices [D, 3] m, embedded landmarks [L, 3] m."""

    vertices: F32
    landmarks: F32


def place(track: Track, frame: int, head: HeadModel) -> Placed:
    """Vertices and embedded landmarks of one frame in the camera frame, m."""
    posed = {"jaw": track.jaw[frame], "neck": track.neck[frame], "eyes": track.eyes[frame]}
    rotation = axis_angle_to_rotation_matrix(from_numpy(track.rotation[frame : frame + 1]))[0].numpy()
    vertices = head.vertices(track.identity, track.expression[frame], **posed)
    embedding = head.landmark_embedding
    corners = vertices[head.faces[embedding.triangles]]
    landmarks = np.einsum("lc,lcx->lx", embedding.barycentric, corners)
    translation = track.translation[frame]
    return Placed(vertices @ rotation.T + translation, landmarks @ rotation.T + translation)


def panel_size(size: tuple[int, int]) -> tuple[int, int]:
    """Size of one of the two pictures side by side: the video's own, held between 720 and 1080 px in height."""
    width, height = size
    scale = np.clip(height, SMALLEST, TALLEST) / height
    return round(width * scale / 2) * 2, round(height * scale / 2) * 2


def draw_overlay(rgb: U8, track: Track, frame: int, landmarks: Landmarks, head: HeadModel, reason: str) -> U8:
    """[H, 2W, 3] u8: the frame as it is, and with mesh, landmarks and confidence over it.

    reason: why the frame was left out (`ok` when it was not). Points: green detected, red fitted.
    """
    width, height = panel_size((rgb.shape[1], rgb.shape[0]))
    scale = height / rgb.shape[0]
    picture = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    drawn = picture.copy()
    if track.valid[frame]:
        placed = place(track, frame, head)
        # Pixel centres are at integers: scaling moves them by half a pixel on both sides.
        principal = (track.principal + 0.5) * scale - 0.5
        _draw_mesh(drawn, placed.vertices, track.focal * scale, principal, head)
        detected = (landmarks.points[frame, :, :2] + 0.5) * scale - 0.5
        fitted = project(placed.landmarks, track.focal * scale, principal)
        radius = max(1, round(float(np.ptp(detected[:, 0])) / 300))
        # The detected ones are rings around the fitted: where they agree, both are seen.
        _draw_points(drawn, detected[head.landmark_embedding.landmarks], DETECTED, radius + 1)
        _draw_points(drawn, fitted, FITTED, radius)
    _draw_confidence(drawn, float(track.confidence[frame]), reason)
    return np.concatenate([picture, drawn], axis=1)


def _draw_mesh(picture: U8, vertices: F32, focal: float, principal: F32, head: HeadModel) -> None:
    """Shade the face region into the picture. The skull has no hair and no evidence: it would only mislead."""
    shown = np.zeros(len(head.template), bool)
    shown[head.regions["face"]] = True
    faces = head.faces[shown[head.faces].all(1)]
    pixels = np.concatenate([project(vertices, focal, principal), vertices[:, 2:]], axis=1)
    low = np.maximum(np.floor(pixels[shown, :2].min(0)).astype(int), 0)
    high = np.minimum(np.ceil(pixels[shown, :2].max(0)).astype(int) + 1, picture.shape[1::-1])
    if (high <= low).any():
        return
    window = picture[low[1] : high[1], low[0] : high[0]]
    pixels[:, :2] -= low
    raster = rasterize(pixels, faces, (window.shape[1], window.shape[0]))
    clay = np.tile(np.asarray(CLAY, np.uint8), (len(vertices), 1))
    # Where there is no face the background is the picture itself, so that the mixture leaves it as it is.
    shaded = shade(raster, faces, vertices, clay, window)
    window[:] = cv2.addWeighted(shaded, MESH_OPACITY, window, 1 - MESH_OPACITY, 0)


def _draw_points(picture: U8, points: F32, colour: tuple[int, int, int], radius: int) -> None:
    # Sixteenths of a pixel, so that a wrong half pixel would be seen.
    for x, y in np.round(points[np.isfinite(points).all(1)] * 16).astype(int).tolist():
        cv2.circle(picture, (x, y), radius * 16, colour, -1, cv2.LINE_AA, 4)


def _draw_confidence(picture: U8, confidence: float, reason: str) -> None:
    height, width = picture.shape[:2]
    colour = BAD if reason != "ok" else GOOD if confidence >= 0.5 else DOUBTFUL
    bar = round(width * confidence)
    thick = max(4, height // 120)
    picture[-thick:] = (40, 40, 40)
    picture[-thick:, :bar] = colour
    text = f"confidence {confidence:.2f}" if reason == "ok" else f"left out: {reason}"
    size = height / 900
    for shade_of, weight in (((0, 0, 0), 4), (colour, 2)):
        cv2.putText(
            picture,
            text,
            (12, height - thick - 12),
            cv2.FONT_HERSHEY_SIMPLEX,
            size,
            shade_of,
            weight,
            cv2.LINE_AA,
        )


def contact_sheet(pictures: list[U8], columns: int = 4, tile_width: int = 480) -> U8:
    """Pictures of one size -> one sheet, row by row."""
    height, width = pictures[0].shape[:2]
    tile = (tile_width, round(tile_width * height / width))
    tiles = [cv2.resize(picture, tile, interpolation=cv2.INTER_AREA) for picture in pictures]
    tiles += [np.full_like(tiles[0], 30)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[start : start + columns], axis=1) for start in range(0, len(tiles), columns)]
    return np.concatenate(rows, axis=0)
