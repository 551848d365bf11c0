"""Things in front of a face: glasses, hair, a beard and a hand, made of tubes in the head frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from tracker.head import HeadModel
from tracker.track import F64

SIDES = 10
ACROSS = np.array([0.0, 0.7, 0.7])  # no tube here runs along it
HAND_S = (2.6, 0.28, 0.5)  # when the hand starts, how long it comes and goes, how long it stays
HAND_AWAY_M = (0.1, -0.35, 0.02)
FRAME_COLOUR = (28.0, 24.0, 26.0)  # of the glasses, sRGB
HAND_COLOUR = (205.0, 165.0, 148.0)
FRINGE, LOCKS = 260, 130  # strands over the forehead, and down each cheek
STRAND_M = 0.0006
BRISTLES = 2400  # of a beard
MOUSTACHE_M, BEARD_M = (0.006, 0.010), (0.007, 0.013)  # how long they are
MOUSTACHE_HALF_M, ABOVE_LIPS_M = 0.03, 0.011  # where it grows
CHEEK_LINE = 1.5  # by how much it rises beside that
STRAND_SHADES = 0.25  # standard deviation of a strand's brightness, as a share


@dataclass(frozen=True)
class Prop:
    """A mesh in the head frame: vertices [V, 3] m, faces [F, 3], albedo [V, 3] sRGB.

    moves: comes to the face and goes again. grown: [V] vertices of the head along with which its own move; None if it
    stays where it is.
    """

    vertices: F64
    faces: NDArray[np.int32]
    albedo: F64
    moves: bool = False
    grown: NDArray[np.int64] | None = None

    def at(self, time: float, moved: NDArray[np.floating]) -> F64:
        """[V, 3] m at a time, s, of a head whose vertices have moved [D, 3] m."""
        if self.grown is not None:
            return self.vertices + moved[self.grown]
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


def _joined(tubes: list[tuple[F64, NDArray[np.int32]]], colours: ArrayLike, moves: bool = False) -> Prop:
    """colours: [3] of all, or [N, 3] of each of the N tubes."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in tubes)])
    faces = [faces + start for (_, faces), start in zip(tubes, first)]
    albedo = np.repeat(np.broadcast_to(colours, (len(tubes), 3)), np.diff(first), axis=0)
    vertices = np.concatenate([vertices for vertices, _ in tubes])
    return Prop(vertices, np.concatenate(faces).astype(np.int32), albedo.astype(np.float64), moves)


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
    return _joined([*rims, *temples, tube(bridge, 0.0016)], FRAME_COLOUR)


def hair(head: HeadModel, colour: ArrayLike) -> Prop:
    """Strands over the forehead of a head (its template) to the brows, and over the edges of both cheeks.

    colour: [3], 0 to 1, sRGB.
    """
    random = np.random.default_rng(7)
    skin = head.template[np.concatenate([head.regions["face"], head.regions["scalp"]])].astype(np.float64)
    skin = skin[skin[:, 2] > 0]
    around = KDTree(skin[:, :2])
    eyes, lips = (head.template[head.regions[name]].mean(0) for name in ("eyes", "lips"))
    wide = np.abs(head.template[head.regions["face"], 0]).max()
    along = np.linspace(0, 1, 20)

    def strand(x: F64, low: float) -> tuple[F64, NDArray[np.int32]]:
        top = eyes[1] + 0.09 * np.sqrt(1 - min(np.abs(x[0]) / (1.25 * wide), 1) ** 2)
        y = top + along * (low - top)
        _, near = around.query(np.stack([x, y], 1), k=12)
        z = skin[near, 2].max(1) + 0.003 + 0.003 * random.uniform()
        smooth = np.convolve(np.pad(z, 3, mode="edge"), np.full(7, 1 / 7), "valid")
        wave = 0.002 * np.sin(6 * along + random.uniform(0, 6))
        return tube(np.stack([x + wave, y, smooth], 1), STRAND_M * np.append(np.ones(len(along) - 1), 0))

    strands = []
    for _ in range(FRINGE):
        lean = random.normal(0.006, 0.004) * along**1.5
        strands.append(
            strand(random.uniform(-0.9, 0.9) * wide + lean, eyes[1] + random.uniform(0.010, 0.026))
        )
    for side in np.repeat([-1, 1], LOCKS):
        x = side * (random.uniform(0.8, 1.0) * wide + 0.006 * np.sin(np.pi * along))
        strands.append(strand(x, lips[1] - random.uniform(0.02, 0.06)))
    shades = 1 + STRAND_SHADES * random.normal(size=(len(strands), 1))
    return _joined(strands, np.clip(255 * np.asarray(colour) * shades, 0, 255))


def beard(head: HeadModel, colour: ArrayLike) -> Prop:
    """Bristles of a head (its template) on upper lip, cheeks and chin, over the edge of the upper lip. colour: as hair.

    They go along with the skin.
    """
    random = np.random.default_rng(8)
    lips, around = head.regions["lips"], np.setdiff1d(head.regions["face"], head.regions["lips"])
    grows = np.isin(np.arange(len(head.template)), around)
    skin = trimesh.Trimesh(head.template, head.faces[grows[head.faces].all(1)], process=False)
    roots, triangle = trimesh.sample.sample_surface(skin, 12 * BRISTLES, seed=8)
    top = head.template[lips, 1].max()
    aside = np.abs(roots[:, 0]) - MOUSTACHE_HALF_M
    line = top + np.where(aside < 0, ABOVE_LIPS_M, np.maximum(0, CHEEK_LINE * (aside - 0.01)))
    chosen = np.flatnonzero((roots[:, 1] < line) & (skin.face_normals[triangle, 2] > 0.1))[:BRISTLES]
    tubes = []
    for root, normal in zip(roots[chosen], skin.face_normals[triangle[chosen]]):
        upper = root[1] > top - 0.004 and abs(root[0]) < MOUSTACHE_HALF_M
        way = 0.5 * normal + [0.3 * np.sign(root[0]), -1, 0] + random.normal(0, 0.15, 3)
        length = random.uniform(*(MOUSTACHE_M if upper else BEARD_M))
        points = root + np.linspace(0, length, 5)[:, None] * way / np.linalg.norm(way)
        tubes.append(tube(points, STRAND_M / 2 * np.array([1, 1, 1, 1, 0])))
    shades = 1 + STRAND_SHADES * random.normal(size=(len(tubes), 1))
    prop = _joined(tubes, np.clip(255 * np.asarray(colour) * shades, 0, 255))
    near = KDTree(head.template[around]).query(roots[chosen])[1]
    return replace(prop, grown=np.repeat(around[near], [len(vertices) for vertices, _ in tubes]))


def hand(head: HeadModel, skin: ArrayLike) -> Prop:
    """Four fingers over the mouth of a head (its template), a palm below. skin: [3] factors of their colour."""
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
    return _joined(tubes, np.array(HAND_COLOUR) * skin, moves=True)
