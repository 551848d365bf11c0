"""Things in front of a face: glasses and a hand, made of tubes in the head frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracker.head import HeadModel
from tracker.track import F64

SIDES = 10
ACROSS = np.array([0.0, 0.7, 0.7])  # no tube here runs along it
HAND_S = (2.6, 0.28, 0.5)  # when the hand starts, how long it comes and goes, how long it stays
HAND_AWAY_M = (0.1, -0.35, 0.02)
FRAME_COLOUR = (28.0, 24.0, 26.0)  # of the glasses, sRGB


@dataclass(frozen=True)
class Prop:
    """A mesh in the head frame: vertices [V, 3] m, faces [F, 3]. moves: comes to the face and goes again."""

    vertices: F64
    faces: NDArray[np.int32]
    moves: bool

    def at(self, time: float) -> F64:
        """[V, 3] m at a time, s."""
        if not self.moves:
            return self.vertices
        start, ramp, hold = HAND_S
        near = np.clip(min(time - start, start + 2 * ramp + hold - time) / ramp, 0, 1)
        return self.vertices + np.array(HAND_AWAY_M) * (0.5 + 0.5 * np.cos(np.pi * near))


def tube(points: F64, radius: ArrayLike) -> tuple[F64, NDArray[np.int32]]:
    """Vertices and outward faces of a tube along points [N, 3] with radius [N] m; radius 0 closes an end."""
    along = np.gradient(points, axis=0)
    one = np.cross(along, ACROSS)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    other = np.cross(along, one)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    ring = np.cos(angle)[:, None] * one[:, None] + np.sin(angle)[:, None] * other[:, None]
    vertices = points[:, None] + np.broadcast_to(radius, len(points))[:, None, None] * ring
    row, side = (index.ravel() for index in np.indices((len(points) - 1, SIDES)))
    a, b = row * SIDES + side, row * SIDES + (side + 1) % SIDES
    faces = np.concatenate([np.stack([a, b, a + SIDES], 1), np.stack([b, b + SIDES, a + SIDES], 1)])
    return vertices.reshape(-1, 3), faces.astype(np.int32)


def _joined(tubes: list[tuple[F64, NDArray[np.int32]]], moves: bool) -> Prop:
    first = np.cumsum([0, *(len(vertices) for vertices, _ in tubes)])
    faces = [faces + start for (_, faces), start in zip(tubes, first)]
    vertices = np.concatenate([vertices for vertices, _ in tubes])
    return Prop(vertices, np.concatenate(faces).astype(np.int32), moves)


def glasses(head: HeadModel) -> Prop:
    """Dark frames around the eyes of a head (its template), 15 mm before the eyeballs, and their temples."""
    rims, hinges = [], []
    angle = np.linspace(0, 2 * np.pi, 41)
    round_ = np.stack([0.027 * np.cos(angle), 0.020 * np.sin(angle), np.zeros_like(angle)], axis=1)
    for side, eye in ((1, "left_eye"), (-1, "right_eye")):
        place = head.template[head.regions[eye]].astype(np.float64)
        centre = np.array([place[:, 0].mean(), place[:, 1].mean() - 0.004, place[:, 2].max() + 0.015])
        rims.append(tube(centre + round_, 0.0016))
        hinges.append(centre + np.array([side * 0.027, 0.006, 0.0]))
    temples = [tube(np.linspace(h, [1.15 * h[0], h[1], 0.0], 12), 0.0016) for h in hinges]
    bridge = np.linspace(hinges[1] + [0.054, 0, 0], hinges[0] - [0.054, 0, 0], 6)
    return _joined([*rims, *temples, tube(bridge, 0.0016)], moves=False)


def hand(head: HeadModel) -> Prop:
    """Four fingers over the mouth of a head (its template), a palm below."""
    mouth = head.template[head.regions["lips"]].mean(0) + np.array([0.0, 0.0, 0.030])
    place = np.linspace(0, 1, 24)
    rounded = np.sqrt(1 - np.abs(2 * place - 1) ** 6)
    tubes = []
    for number, reach in enumerate((0.030, 0.038, 0.034, 0.020)):
        x = 0.019 * (number - 1.5)
        for low, high, radius in ((-0.06, reach, 0.0095), (-0.15, -0.04, 0.013)):
            points = np.stack(
                [x + 0.25 * (low + place * (high - low)), low + place * (high - low), 0 * place], 1
            )
            tubes.append(tube(mouth + points, radius * rounded))
    return _joined(tubes, moves=True)
