"""People whom the tracker's head cannot imitate exactly, and how they move: the subjects of the bench's films.

A stranger is the embedded head with its neutral bent by a smooth field from which everything that the identity basis
and a similarity could do is taken away, and with every expression seen through a warp that varies over the face. The
warp is one for all expressions, so lips that touch still touch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from personalize.talkers.film import ASSETS, demo_identity
from personalize.talkers.motion import NECK, TalkerMotion, talker_motion
from personalize.talkers.style import Style
from personalize.talkers.visemes import Phone, load_phones
from tracker.head import HeadModel
from tracker.track import F64

FPS = 25.0
SPEECH = ASSETS / "demo_speech.json"
WAVES, BEND_LENGTH_M, WARP_LENGTH_M = 24, 0.05, 0.04
FACE_DEPTH_M = 0.085  # of the face before the head's origin
# When the head turns, when it turns back, and how long each takes, s: fast, and slowly aside to the left and right.
FAST_TURN = (2.5, 2.74, 0.2)
ASIDE_TURNS = ((1.0, 2.6, 1.0), (4.4, 6.0, 1.0))
_SMILE = ("mouthSmileLeft", "mouthSmileRight", "cheekSquintLeft", "cheekSquintRight")
_SURPRISE = ("browInnerUp", "browOuterUpLeft", "browOuterUpRight")
_FROWN = ("browDownLeft", "browDownRight", "noseSneerLeft", "noseSneerRight")
# Shapes, by how much, and when: begun, gone again, and how long each takes, s.
MOODS = (
    (_SMILE, 0.6, (0.6, 1.6, 0.35)),
    (_SURPRISE, 0.7, (1.9, 2.6, 0.35)),
    (_FROWN, 0.6, (3.0, 3.8, 0.35)),
    (("mouthLeft",), 0.5, (2.9, 3.6, 0.3)),
    (_SMILE[:2], 0.4, (4.3, 5.4, 0.35)),
)
CUT_S = 2.0  # that are missing at a cut
LIP_ROLL = 0.4  # of the demo's: lower lips on real film hardly roll in, not at /f v/ either
Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Scene:
    """One film: who, how they move, and what the camera makes of it."""

    name: str
    seed: int
    seconds: float = 6.0
    bend_mm: float = 1.2
    """Rms over the face of the neutral's departure from the head model."""
    warp: float = 0.22
    """Rms of the expressions' warp, as a share of a vertex's movement."""
    size: tuple[int, int] = (640, 640)
    focal: float = 1.3
    """Of the picture's long side."""
    face_px_per_m: float = 2300.0
    head: float = 0.8
    """Range of head movement; 1 turns by up to 17 degrees to either side."""
    fast_turn_deg: float = 0.0
    aside_deg: float = 0.0
    """How far the head turns slowly to either side."""
    camera_deg: tuple[float, float] = (0.0, 0.0)
    """How far to the subject's left, and how far above, the camera stands all the time."""
    shot_s: float = np.inf
    """After so long there is a cut: CUT_S of what happens are not filmed."""
    speaks: bool = True
    """False: nothing moves."""
    speech_start_s: float = 0.0
    moods: bool = False
    """Smiles, is surprised, frowns and pulls the mouth awry meanwhile."""
    skin: Colour = (1.0, 1.0, 1.0)
    """Factors of the painted albedo."""
    hair: Colour = (0.16, 0.11, 0.08)
    stubble: float = 0.0
    key_light: tuple[float, float] = (-35.0, 35.0)
    """Azimuth (to the right of the camera) and elevation, degrees."""
    key_sweep_deg: float = 0.0
    """How far the light's azimuth moves to either side."""
    ambient: float = 0.4
    gloss: float = 0.08
    fringe: bool = False
    """Hair to the brows, and over the edges of both cheeks."""
    beard: bool = False
    """Bristles on cheeks, chin and upper lip, over whose edge they hang."""
    glasses: bool = False
    hand: bool = False
    shutter: float = 0.35
    """Share of the frame's time that the picture is exposed for."""
    noise: float = 3.0
    """Standard deviation, grey levels."""
    crf: int = 24


SCENES = (
    Scene("inside", 11, bend_mm=0.0, warp=0.0, focal=1.2, head=1.0, speech_start_s=20.0),
    Scene("still", 12, 3.0, focal=1.5, speaks=False, noise=4.0, crf=15, key_light=(20.0, 40.0)),
    Scene("calm", 13, focal=1.5, head=0.35, key_light=(55.0, 20.0), ambient=0.25, stubble=0.35),
    Scene(
        *("turning", 14),
        focal=0.95,
        face_px_per_m=1900.0,
        head=1.55,
        speech_start_s=6.0,
        skin=(0.72, 0.66, 0.62),
        key_light=(-10.0, 45.0),
        key_sweep_deg=50.0,
    ),
    Scene(
        *("glasses", 15),
        size=(1280, 720),
        focal=1.25,
        speech_start_s=12.0,
        skin=(1.06, 1.05, 1.04),
        hair=(0.55, 0.47, 0.35),
        glasses=True,
        gloss=0.15,
        noise=4.0,
    ),
    Scene(
        *("hand", 16),
        focal=1.15,
        head=0.6,
        speech_start_s=25.0,
        skin=(0.62, 0.54, 0.50),
        hair=(0.06, 0.05, 0.05),
        hand=True,
        ambient=0.55,
    ),
    Scene("fast_turn", 17, focal=2.4, head=0.5, fast_turn_deg=38.0, speech_start_s=31.0, shutter=0.5),
    Scene(
        "long", 18, 24.0, focal=1.4, head=0.9, shot_s=10.0, skin=(0.86, 0.80, 0.76), key_light=(30.0, 30.0)
    ),
    Scene(
        *("hair", 20),
        focal=1.35,
        head=1.0,
        speech_start_s=16.0,
        skin=(1.02, 0.99, 0.96),
        hair=(0.36, 0.25, 0.17),
        fringe=True,
        key_light=(25.0, 35.0),
    ),
    Scene(
        *("beard", 23),
        focal=1.4,
        head=0.7,
        speech_start_s=10.0,
        skin=(0.93, 0.88, 0.84),
        hair=(0.22, 0.15, 0.10),
        stubble=0.3,
        beard=True,
        key_light=(15.0, 40.0),
    ),
    # Into profile and back, to either side, as somebody does who films a head for a model of it.
    Scene(
        *("profile", 22, 8.0),
        focal=1.3,
        head=0.5,
        aside_deg=70.0,
        speech_start_s=27.0,
        skin=(0.90, 0.84, 0.80),
        key_light=(-30.0, 30.0),
    ),
    Scene(
        *("moods", 25),
        focal=1.25,
        head=0.8,
        speech_start_s=18.0,
        moods=True,
        skin=(0.82, 0.75, 0.70),
        key_light=(20.0, 30.0),
    ),
    # By the camera of a laptop on a table, from beside the camera, and by a phone that is held high.
    Scene(
        *("laptop", 26),
        size=(1280, 720),
        focal=0.8,
        head=0.7,
        camera_deg=(4.0, -20.0),
        speech_start_s=14.0,
        skin=(0.98, 0.94, 0.90),
        key_light=(10.0, 45.0),
    ),
    Scene(
        *("interview", 27),
        focal=1.8,
        head=0.7,
        camera_deg=(30.0, 3.0),
        speech_start_s=22.0,
        skin=(0.88, 0.81, 0.76),
        key_light=(45.0, 30.0),
    ),
    Scene(
        *("high", 28),
        size=(720, 1280),
        focal=0.85,
        head=0.7,
        camera_deg=(-6.0, 18.0),
        speech_start_s=33.0,
        skin=(0.80, 0.72, 0.66),
        key_light=(-25.0, 40.0),
    ),
    # A phone at arm's length: the face is 560 px wide.
    Scene(
        *("selfie", 19),
        size=(1080, 1920),
        focal=0.9,
        face_px_per_m=4000.0,
        speech_start_s=37.0,
        skin=(0.95, 0.90, 0.86),
        key_light=(-20.0, 30.0),
    ),
    # A face of some thousand pixels, at a quarter of a metre.
    Scene(
        *("closeup", 21),
        size=(1440, 1920),
        focal=1.1,
        face_px_per_m=7700.0,
        head=0.5,
        speech_start_s=9.0,
        skin=(0.78, 0.72, 0.68),
        key_light=(40.0, 30.0),
    ),
)


def smooth_field(points: F64, length: float, random: np.random.Generator) -> F64:
    """[D] of about unit variance at points [D, 3] m, changing over about `length` m."""
    direction = random.normal(size=(3, WAVES))
    direction *= 2 * np.pi / (length * np.linalg.norm(direction, axis=0))
    phase, height = random.uniform(0, 2 * np.pi, WAVES), random.normal(size=WAVES)
    return np.sin(points @ direction + phase) @ height * np.sqrt(2 / WAVES)


def beyond_identity(head: HeadModel, field: F64) -> F64:
    """What of a field [D, 3] neither the identity basis nor a similarity can do, in the least squares sense."""
    centred = head.template - head.template.mean(0, dtype=np.float64)
    axes = np.eye(3)
    similar = [
        *(np.broadcast_to(axis, centred.shape) for axis in axes),
        *np.cross(axes[:, None], centred),
        centred,
    ]
    known = np.concatenate([head.identity_basis.astype(np.float64), similar]).reshape(-1, field.size)
    known /= np.linalg.norm(known, axis=1, keepdims=True)
    coefficients = np.linalg.lstsq(known.T, field.ravel(), rcond=None)[0]
    return field - (coefficients @ known).reshape(field.shape)


def stranger(head: HeadModel, scene: Scene) -> HeadModel:
    """The person of a scene as a head model of its own, whose one identity mode does nothing."""
    random = np.random.default_rng((scene.seed, 20))
    places = head.template.astype(np.float64)
    # Away from the head's middle, and not along the normals, which turn round where the lips touch.
    outward = places / np.linalg.norm(places, axis=1, keepdims=True)
    bent = beyond_identity(head, smooth_field(places, BEND_LENGTH_M, random)[:, None] * outward)
    bent *= 1e-3 * scene.bend_mm / np.sqrt((bent[head.regions["face"]] ** 2).sum(1).mean())
    entries = [smooth_field(places, WARP_LENGTH_M, random) for _ in range(9)]
    warp = np.eye(3) + scene.warp / np.sqrt(3) * np.stack(entries, axis=-1).reshape(-1, 3, 3)
    identity = demo_identity(head, scene.seed)
    neutral = head.vertices(identity, np.zeros(len(head.expression_names))) + bent
    joints = {
        name: replace(
            joint,
            position=joint.position + identity @ joint.identity_basis + bent[joint.vertices].mean(0),
            identity_basis=np.zeros((1, 3), np.float32),
        )
        for name, joint in head.joints.items()
    }
    moves = np.einsum("dij,kdj->kdi", warp, head.expression_basis)
    return replace(
        head,
        template=neutral.astype(np.float32),
        expression_basis=moves.astype(np.float32),
        identity_basis=np.zeros((1, *neutral.shape), np.float32),
        joints=joints,
    )


def scene_motion(scene: Scene) -> TalkerMotion:
    """How the person of a scene moves: the demo's speech from the scene's start on, blinks, gaze, head."""
    style = replace(Style.random(scene.seed), head=scene.head)
    distance = scene.focal * max(scene.size) / scene.face_px_per_m + FACE_DEPTH_M
    filmed = scene.seconds + CUT_S * (scene.seconds // scene.shot_s)
    motion = talker_motion(_phones(scene.speech_start_s), filmed, FPS, scene.seed, style, None, distance)
    motion = _cut(motion, scene.shot_s)
    rolled = motion.expression.copy()
    rolled[:, motion.names.index("mouthRollLower")] *= LIP_ROLL
    if scene.moods:
        for names, weight, when in MOODS:
            for name in names:
                shape = rolled[:, motion.names.index(name)]
                shape += weight * (1 - shape) * _there_and_back(len(rolled), when)
    motion = replace(motion, expression=rolled)
    if not scene.speaks:
        motion = replace(
            motion,
            expression=np.zeros_like(motion.expression),
            rotation=np.broadcast_to(motion.rotation[0], motion.rotation.shape),
            translation=np.broadcast_to(motion.translation[0], motion.translation.shape),
            eyes=np.broadcast_to(motion.eyes[0], motion.eyes.shape),
        )
    left, right = (_there_and_back(len(motion.expression), turn) for turn in ASIDE_TURNS)
    fast = _there_and_back(len(motion.expression), FAST_TURN)
    yaw = np.radians(scene.fast_turn_deg * fast + scene.aside_deg * (left - right))
    motion = _turned(motion, Rotation.from_euler("y", yaw[:, None]), NECK)
    # Seen from elsewhere, the face stays in the picture's middle.
    aside, above = scene.camera_deg
    seen_from = Rotation.from_euler("yx", [-aside, above], degrees=True)
    return _turned(motion, seen_from, np.array([0.0, 0.0, FACE_DEPTH_M]))


def _phones(start: float) -> list[Phone]:
    phones = load_phones(SPEECH)
    return [Phone(p.name, p.start - start, p.end - start) for p in phones if p.end > start]


def _cut(motion: TalkerMotion, shot_s: float) -> TalkerMotion:
    """The motion without the last CUT_S of each shot_s + CUT_S."""
    kept = np.arange(len(motion.expression)) / FPS % (shot_s + CUT_S) < shot_s
    names = ("expression", "rotation", "translation", "eyes")
    return replace(motion, **{name: getattr(motion, name)[kept] for name in names})


def _there_and_back(frames: int, turn: tuple[float, float, float]) -> F64:
    """[T] 0, up to 1 at one time, and back at another: when, when back, and how long each takes, s."""
    time, (there_s, back_s, rise_s) = np.arange(frames) / FPS, turn
    there, back = (np.clip((time - moment) / rise_s, 0, 1) for moment in (there_s, back_s))
    return 0.5 * (np.cos(np.pi * back) - np.cos(np.pi * there))


def _turned(motion: TalkerMotion, turn: Rotation, about: F64) -> TalkerMotion:
    """The head turned further, about a point [3] m of its own frame."""
    first = Rotation.from_rotvec(motion.rotation)
    then = first * turn
    moved = motion.translation + first.apply(about) - then.apply(about)
    return replace(motion, rotation=then.as_rotvec().astype(np.float32), translation=moved.astype(np.float32))
