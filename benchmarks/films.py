"""The bench's films: a stranger before a camera, lit, blurred, noisy and compressed, and the truth behind it.

A film is made once: it lies in the cache under a hash of scene, head, speech and the code that made it.
"""

from __future__ import annotations

import ast
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks import ground_truth, props, rendered_heads
from benchmarks.ground_truth import GroundTruth
from benchmarks.rendered_heads import FPS, Scene, scene_motion, stranger
from personalize import talkers, video_writer
from personalize.feature_cache import cache_folder
from personalize.files import sha256_file, sha256_json
from personalize.render import mouth
from personalize.talkers.motion import TalkerMotion
from personalize.talkers.skin import backdrop, skin_block, texture
from personalize.video_writer import VideoWriter
from tracker import head as head_model
from tracker import raster
from tracker.head import HeadModel
from tracker.raster import project, rasterize, shade, vertex_normals
from tracker.track import F32, F64

U8 = NDArray[np.uint8]
SUPERSAMPLING = 2
LENS_BLUR_PX = 0.6
SHININESS = 12.0
SHORT_PX = 0.5  # a movement during the exposure that blurs nothing
IN_MOUTH = 0.5  # share of the key light
LIP = np.array([176.0, 92.0, 88.0])
PALENESS = (0.5, 0.85)  # how far lips are from skin to the head's own red
LIP_GLOSS = 1.8  # of the skin's
LIP_SOFTNESS = 0.4
MADE_BY = (
    *(
        module.__file__
        for module in (ground_truth, head_model, mouth, props, raster, rendered_heads, video_writer)
    ),
    *sorted(str(path) for path in Path(talkers.__path__[0]).glob("*.py")),
    __file__,
)


def film(scene: Scene, head: HeadModel) -> tuple[Path, GroundTruth]:
    """The film of a scene (MP4) and its truth, made now or earlier."""
    folder = cache_folder().with_name("films")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{scene.name}_{film_key(scene, head)}.mp4"
    # The truth is written after the film: when it is there, both are whole.
    if path.with_suffix(".npz").is_file():
        return path, GroundTruth.read(path.with_suffix(".npz"))
    truth = shoot(scene, head, path)
    truth.write(path.with_suffix(".npz"))
    return path, truth


def film_key(scene: Scene, head: HeadModel) -> str:
    """Hash of all that a scene's film is made of."""
    # As syntax: comments and layout change no film.
    code = [ast.dump(ast.parse(Path(str(file)).read_text())) for file in MADE_BY]
    # The head's own hash is of its geometry alone.
    regions = {name: vertices.tolist() for name, vertices in head.regions.items()}
    joints = {name: [part.tolist() for part in vars(joint).values()] for name, joint in head.joints.items()}
    person = [head.sha256, head.expression_names, regions, joints, head.albedo.tolist()]
    return sha256_json([asdict(scene), person, sha256_file(rendered_heads.SPEECH), code])[:16]


def shoot(scene: Scene, head: HeadModel, path: Path) -> GroundTruth:
    """Render a scene to the video `path`."""
    person, moves = mouth.furnished(stranger(head, scene)), scene_motion(scene)
    weights = moves.expression_for(person.expression_names)
    studio = Studio(scene, person, moves)
    covered, gaps = np.zeros(len(weights)), np.zeros(len(weights))
    with VideoWriter(path, FPS, scene.size, crf=scene.crf) as writer:
        for frame, weight in enumerate(weights):
            vertices = person.vertices(np.zeros(1), weight, eyes=moves.eyes[frame])
            gaps[frame] = person.lip_gap_mm(vertices)
            picture, covered[frame] = studio.picture(frame, vertices)
            writer.write(picture)
    face = np.sort(head.regions["face"])
    return GroundTruth(
        neutral=person.template[face].astype(np.float64),
        faces=np.searchsorted(face, head.faces[np.isin(head.faces, face).all(1)]).astype(np.int32),
        displacement=np.tensordot(weights.astype(np.float64), person.expression_basis[:, face], axes=1),
        rotation=Rotation.from_rotvec(moves.rotation).as_matrix(),
        translation=moves.translation.astype(np.float64),
        focal=scene.focal * max(scene.size),
        lip_gap_mm=gaps,
        covered=covered,
        vertices=face.astype(np.int32),
        eyes=moves.eyes.astype(np.float64),
    )


class Studio:
    """Light, paint, props, background, lens and sensor of one scene."""

    def __init__(self, scene: Scene, person: HeadModel, moves: TalkerMotion) -> None:
        self._scene, self._person, self._moves = scene, person, moves
        self._turns = Rotation.from_rotvec(moves.rotation)
        self._large = (scene.size[0] * SUPERSAMPLING, scene.size[1] * SUPERSAMPLING)
        self._focal = scene.focal * max(self._large)
        self._backdrop = backdrop(self._large, scene.seed)
        self._block = skin_block(scene.seed)
        self._props = [props.beard(person, scene.hair)] if scene.beard else []
        grown = len(self._props)
        if scene.glasses:
            self._props.append(props.glasses(person))
        if scene.fringe:
            self._props.append(props.hair(person, scene.hair))
        if scene.hand:
            self._props.append(props.hand(person, scene.skin))
        parts, first = [person.faces], len(person.template)
        for prop in self._props:
            parts.append(prop.faces + first)
            first += len(prop.vertices)
        self._faces = np.concatenate(parts).astype(np.int32)
        self._own = sum(len(part) for part in parts[: 1 + grown])
        self._inside = mouth.within(person)
        self._albedo = np.concatenate([_painted(person, scene), *(prop.albedo for prop in self._props)])
        self._places = np.concatenate([person.template, *(p.vertices for p in self._props)]).astype(
            np.float32
        )
        self._gloss = np.ones((len(self._places), 1))
        self._gloss[person.regions["lips"]] = LIP_GLOSS
        self._soft = np.zeros((len(self._places), 1))
        self._soft[person.regions["lips"]] = LIP_SOFTNESS
        self._detail = mouth.MouthDetail.of(person, len(self._places), scene.seed)
        noses = self._turns.apply(person.template[person.regions["face"]].mean(0)) + moves.translation
        self._path = project(noses, scene.focal * max(scene.size), (0, 0))
        self._shot = np.arange(len(noses)) // (scene.shot_s * FPS)

    def picture(self, frame: int, vertices: F32) -> tuple[U8, float]:
        """What the camera records of vertices [D, 3] m in the head frame, and the share of the lips covered.

        Lips outside the picture count as covered where none are in it.
        """
        moved = vertices - self._person.template
        whole = np.concatenate([vertices, *(prop.at(frame / FPS, moved) for prop in self._props)])
        posed = (self._turns[frame].apply(whole) + self._moves.translation[frame]).astype(np.float32)
        centre = [(side - 1) / 2 for side in self._large]
        pixels = np.concatenate([project(posed, self._focal, centre), posed[:, 2:]], axis=1)
        # Only the rectangle around the head is worked on.
        left, top = np.clip(np.floor(pixels[:, :2].min(axis=0)), 0, self._large).astype(int)
        right, bottom = np.clip(np.ceil(pixels[:, :2].max(axis=0)) + 1, 0, self._large).astype(int)
        pixels[:, :2] -= (left, top)
        picture = self._backdrop.copy()
        around = picture[top:bottom, left:right]
        seen = rasterize(pixels, self._faces, (right - left, bottom - top))
        colour = self._lit(posed, frame)
        around[:] = shade(seen, self._faces, posed, colour, around, ambient=1.0)
        texture(around, seen, self._faces, self._places, self._block)
        lips = pixels[self._person.regions["lips"], :2]
        scale = self._focal / float(posed[self._person.regions["lips"], 2].mean())
        self._detail.lay(around, seen, self._faces, lips, scale)
        lips = lips.round().astype(int)
        inside = ((lips >= 0) & (lips < seen.triangle.shape[::-1])).all(1)
        hidden = seen.triangle[lips[inside, 1], lips[inside, 0]] >= self._own
        return self._exposed(picture, frame), float(hidden.mean()) if inside.any() else 1.0

    def _lit(self, posed: F32, frame: int) -> U8:
        """[V, 3] u8: light that leaves each vertex; colours are square roots of light, as in tracker.raster."""
        scene, time = self._scene, frame / FPS
        azimuth = np.radians(
            scene.key_light[0] + scene.key_sweep_deg * np.sin(2 * np.pi * time / scene.seconds)
        )
        up = np.radians(scene.key_light[1])
        light = np.array([np.sin(azimuth) * np.cos(up), -np.sin(up), -np.cos(azimuth) * np.cos(up)])
        normals = vertex_normals(posed, self._faces)
        view = -posed / np.linalg.norm(posed, axis=1, keepdims=True)
        between = view + light
        between /= np.linalg.norm(between, axis=1, keepdims=True)
        # Light gets some way through lips.
        facing = np.maximum((normals @ light)[:, None] + self._soft, 0) / (1 + self._soft)
        facing[self._inside] = IN_MOUTH  # no shadows are cast, but lips and cheeks would
        shine = scene.gloss * self._gloss * np.maximum((normals * between).sum(1), 0)[:, None] ** SHININESS
        reflected = (self._albedo / 255) ** 2 * (scene.ambient + (1 - scene.ambient) * 1.3 * facing)
        return (255 * np.sqrt(np.clip(reflected + shine * facing, 0, 1))).astype(np.uint8)

    def _exposed(self, picture: U8, frame: int) -> U8:
        """Shrunk to size, blurred by movement and lens, with noise."""
        scene = self._scene
        small = cv2.resize(picture, scene.size, interpolation=cv2.INTER_AREA)
        shot = np.flatnonzero(self._shot == self._shot[frame])  # nothing moves across a cut
        before, after = max(frame - 1, shot[0]), min(frame + 1, shot[-1])
        moved = scene.shutter * (self._path[after] - self._path[before]) / max(after - before, 1)
        if np.linalg.norm(moved) > SHORT_PX:
            small = cv2.filter2D(small, -1, _streak(moved))
        soft = cv2.GaussianBlur(small, (0, 0), LENS_BLUR_PX).astype(np.float32)
        random = np.random.default_rng((scene.seed, 21, frame))
        soft += scene.noise * random.standard_normal(soft.shape, dtype=np.float32)
        return np.clip(soft + 0.5, 0, 255).astype(np.uint8)


def _streak(moved: F64) -> F32:
    """A kernel [k, k] that spreads a point over `moved` [2] px, centred."""
    half = int(np.ceil(np.linalg.norm(moved) / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for step in np.linspace(-0.5, 0.5, 8 * half):
        x, y = half + step * moved
        i, j = int(np.floor(y)), int(np.floor(x))
        u, v = x - j, y - i
        kernel[i : i + 2, j : j + 2] += np.outer([1 - v, v], [1 - u, u])
    return kernel / kernel.sum()


def _painted(person: HeadModel, scene: Scene) -> F64:
    """[D, 3] the person's albedo: skin, hair, stubble."""
    albedo = person.albedo.astype(np.float64)
    skin_parts = np.ones(len(albedo), bool)
    skin_parts[np.concatenate([person.regions["eyes"], mouth.within(person)])] = False
    albedo[skin_parts] *= scene.skin
    _paint_lips(albedo, person, scene)
    mouth.paint(albedo, person)
    albedo[person.regions["scalp"]] = 255 * np.array(scene.hair)
    beard = np.setdiff1d(person.regions["face"], person.regions["lips"])
    nose = person.template[person.regions["lips"], 1].max() + 0.006
    grown = 1 / (1 + np.exp((person.template[beard, 1] - nose) / 0.003))
    albedo[beard] *= 1 - scene.stubble * grown[:, None]
    return np.clip(albedo, 0, 255)


def _paint_lips(albedo: F64, person: HeadModel, scene: Scene) -> None:
    """Thinner and paler than the head's own, in place."""
    random = np.random.default_rng((scene.seed, 22))
    lips = np.setdiff1d(person.regions["lips"], person.behind_lips())
    tone = np.median(albedo[np.setdiff1d(person.regions["face"], person.regions["lips"])], axis=0)
    red = tone + random.uniform(*PALENESS) * (LIP * scene.skin - tone)
    albedo[lips] = tone + mouth.vermilion(person, lips)[:, None] * (red - tone)
