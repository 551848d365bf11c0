"""Builds tracker/assets/landmark_bias.npz: what the landmarker errs by as a face turns and moves.

    python -m tools.build_landmark_bias

People drawn by lot, none of whom is in a bench, are pictured as the bench's films are, turned and moved at random, and
read. What each landmark lies off its place on the head, less what it lies off on the same person on average, is told
by the face's turn and by the foremost modes of its shape, as the landmarks themselves show both: ridge regression.
Other people, left out, measure what is left. Mirror images count as people too, so that both sides err alike.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.films import Studio
from benchmarks.rendered_heads import scene_motion, stranger
from benchmarks.strangers import drawn
from personalize.render import mouth
from tools.build_embedding import read
from tracker.energy import FACING, IRISES
from tracker.head import HeadModel, load_head
from tracker.landmark_bias import ASSET, LandmarkBias
from tracker.landmark_indices import MIRRORED, POINTS, UPPER_FACE
from tracker.landmarker import FaceLandmarker
from tracker.raster import project
from tracker.track import F32, F64

PEOPLE, HELD_OUT = range(5001, 5161), range(5201, 5221)
VIEWS = 8  # of each
MODES = 40
RIDGE = 0.1  # of each feature's own square sum: what is read is noise in part
SIZE = 640
ROLL_DEG, YAW_DEG, NOD_DEG = 5.0, 25.0, 16.0  # to either side
SHIFT_M = 0.01  # sd
# Share of the views in which a shape counts, and up to how much then; one side of it differs by UNLIKE.
SHAPES: dict[str, tuple[float, float]] = {
    "jawOpen": (0.7, 0.5),
    **{
        name: (0.25, 0.4)
        for name in (
            *("mouthFunnel", "mouthPucker", "mouthClose", "mouthRollUpper"),
            *("mouthRollLower", "mouthShrugUpper", "mouthShrugLower"),
        )
    },
    **{
        name: (0.3, 0.4)
        for name in (
            *("mouthSmile", "mouthStretch", "mouthUpperUp", "mouthLowerDown", "mouthPress"),
            *("mouthFrown", "mouthDimple", "noseSneer", "cheekSquint"),
        )
    },
    "browInnerUp": (0.3, 0.6),
    "browOuterUp": (0.3, 0.6),
    "browDown": (0.2, 0.6),
    "eyeBlink": (0.15, 1.0),
}
UNLIKE = 0.3  # how far the sides of a face may differ, as a share


@dataclass(frozen=True)
class View:
    """One picture read. points: [478, 3] px. off: [478, 2] m, right and down as the face is held; NaN for those that
    have no place on the head."""

    person: int
    points: F32
    off: F64

    def mirrored(self) -> View:
        """Another person's, who is this one's mirror image."""
        return View(-self.person, self.points[MIRRORED] * [-1, 1, 1], self.off[MIRRORED] * [-1, 1])


def random_weights(names: tuple[str, ...], random: np.random.Generator) -> F64:
    """[K] weights of named shapes; a shape's sides move together, more or less."""
    weights = np.zeros(len(names))
    for shape, (share, most) in SHAPES.items():
        weight = random.uniform(0, most) * float(random.random() < share)
        for index, name in enumerate(names):
            if name == shape:
                weights[index] = weight
            elif name in (f"{shape}Left", f"{shape}Right"):
                weights[index] = min(weight * random.uniform(1 - UNLIKE, 1 + UNLIKE), 1.0)
    close, jaw = names.index("mouthClose"), names.index("jawOpen")
    weights[close] = min(weights[close], weights[jaw])
    return weights


def look(number: int) -> list[View]:
    """The views of one stranger."""
    head, landmarker = _own()
    scene = drawn(number)
    size, focal = (SIZE, SIZE), scene.focal * max(scene.size) / SIZE
    scene = replace(scene, size=size, focal=focal, shutter=0.0, fringe=False, glasses=False, hand=False)
    random = np.random.default_rng((number, 40))
    person = mouth.furnished(stranger(head, scene))
    moves = scene_motion(scene)
    angles = random.uniform(-1, 1, (VIEWS, 3)) * (ROLL_DEG, YAW_DEG, NOD_DEG)
    rotation = FACING @ Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
    nose = person.template[person.regions["face"]].mean(0)
    before = Rotation.from_rotvec(moves.rotation).apply(nose) + moves.translation
    translation = before.mean(0) + random.normal(size=(VIEWS, 3)) * SHIFT_M - rotation @ nose
    weights = np.array([random_weights(person.expression_names, random) for _ in range(VIEWS)])
    eyes = moves.eyes[random.integers(len(moves.eyes), size=VIEWS)]
    turned = Rotation.from_matrix(rotation).as_rotvec()
    studio = Studio(scene, person, replace(moves, rotation=turned, translation=translation, eyes=eyes))
    views = []
    for view in range(VIEWS):
        vertices = person.vertices(np.zeros(1), weights[view], eyes=eyes[view])
        picture, _ = studio.picture(view, vertices)
        points = read(landmarker, picture)
        if points is not None:
            off = off_place(head, vertices @ rotation[view].T + translation[view], points, scene.focal * SIZE)
            down = -rotation[view, :2, 1] / np.linalg.norm(rotation[view, :2, 1])
            views.append(View(number, points, off @ np.array([[down[1], down[0]], [-down[0], down[1]]])))
    return views


@cache
def _own() -> tuple[HeadModel, FaceLandmarker]:
    return load_head(), FaceLandmarker()


def off_place(head: HeadModel, vertices: F64, points: F32, focal: float) -> F64:
    """[478, 2] m, at the depth of the face: how far points lie off their places on vertices [D, 3] m, as pictured."""
    embedding = head.landmark_embedding
    places = np.einsum("lc,lcx->lx", embedding.barycentric, vertices[head.faces[embedding.triangles]])
    centre = ((SIZE - 1) / 2, (SIZE - 1) / 2)
    off = np.full((POINTS, 2), np.nan)
    apart = points[embedding.landmarks, :2] - project(places, focal, centre)
    off[embedding.landmarks] = apart * places[:, 2].mean() / focal
    return off


def about_person(values: F64, person: F64) -> F64:
    """Values [n, ..] less their person's mean; person: [n]."""
    out = values.copy()
    for one in np.unique(person):
        out[person == one] -= values[person == one].mean(0)
    return out


def learn(head: HeadModel, views: list[View]) -> LandmarkBias:
    """The map that tells the views' errors best."""
    embedding = head.landmark_embedding
    landmarks = np.setdiff1d(embedding.landmarks, IRISES).astype(np.int32)
    mean = head.landmark_positions(np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_basis)))
    mean = mean[np.searchsorted(embedding.landmarks, landmarks)]
    none = np.zeros((2, 0), np.float32)
    bias = LandmarkBias(
        landmarks, np.isin(landmarks, UPPER_FACE), mean, np.zeros((0, *mean.shape)), none, none
    )
    views = views + [view.mirrored() for view in views]
    person, points = (np.array([getattr(view, name) for view in views]) for name in ("person", "points"))
    turns, shapes, *_ = bias.seen(points)
    turns, flat = about_person(turns, person), about_person(shapes.reshape(len(views), -1), person)
    of_turn = np.linalg.lstsq(turns, flat, rcond=None)[0]
    _, size, modes = np.linalg.svd(flat - turns @ of_turn, full_matrices=False)
    modes = modes[:MODES] * np.sqrt(len(views)) / size[:MODES, None]
    bias = replace(
        bias,
        modes=modes.reshape(-1, *mean.shape).astype(np.float32),
        of_turn=(of_turn @ modes.T).astype(np.float32),
    )
    features = about_person(bias.features(points)[0], person)
    off = about_person(np.array([view.off for view in views]).reshape(len(views), -1), person)
    square = features.T @ features
    rate = np.linalg.solve(square + RIDGE * np.diag(np.diag(square)), features.T @ np.nan_to_num(off))
    return replace(bias, rate=rate.reshape(-1, POINTS, 2).astype(np.float32))


def left_over(bias: LandmarkBias, views: list[View]) -> tuple[F64, F64]:
    """[2] mm across and along the face, rms about each person's mean: errors as read, and with the bias taken out."""
    before: list[F64] = []
    after: list[F64] = []
    for person in sorted({view.person for view in views}):
        mine = [view for view in views if view.person == person]
        points, off = (np.array([getattr(view, name) for view in mine]) for name in ("points", "off"))
        _, _, scale, axes = bias.seen(points)
        moved = (bias.taken_out(points, np.ones(len(points), bool)) - points)[..., :2] @ axes.transpose(
            0, 2, 1
        )
        known = np.isfinite(off).all(axis=(0, 2))
        for errors, found in ((before, off), (after, off + moved / scale[:, None, None])):
            errors.append((found - found.mean(0))[:, known].reshape(-1, 2))
    rms = [1e3 * np.sqrt((np.concatenate(errors) ** 2).mean(0)) for errors in (before, after)]
    return rms[0], rms[1]


def look_at(numbers: Iterable[int]) -> list[View]:
    """The views of several strangers."""
    with ProcessPoolExecutor() as pool:
        return [view for views in pool.map(look, numbers, chunksize=4) for view in views]


def main() -> None:
    """Look, learn, measure, write."""
    bias = learn(load_head(), look_at(PEOPLE))
    for name, (across, along) in zip(("as read", "bias taken out"), left_over(bias, look_at(HELD_OUT))):
        print(f"people left out, {name}: {across:.2f} mm across the face, {along:.2f} mm along it (rms)")
    np.savez_compressed(ASSET, **vars(bias))
    print(f"{ASSET}: {ASSET.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
