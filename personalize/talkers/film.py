"""A talker on film, with the truth that made it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from model.files import write_npz
from personalize.render import mouth
from personalize.sound import SPEECH_RATE, read_audio
from personalize.talkers.motion import TalkerMotion, talker_motion
from personalize.talkers.skin import backdrop, skin_block, texture
from personalize.talkers.style import Style
from personalize.talkers.visemes import load_phones
from personalize.video_writer import VideoWriter
from tracker.head import HeadModel
from tracker.raster import project, rasterize, shade

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

ASSETS = Path(__file__).parent.parent / "assets"
SUPERSAMPLING = 2
BLUR_PX = 0.6  # of the lens
NOISE = 2.0  # of the sensor, standard deviation in grey levels
NOISE_PLATES = 16  # different noise pictures, shifted at random for each frame
CRF = 17
LIGHT = (-0.45, -0.5, -0.75)
AMBIENT = 0.4

DEMO_SIZE = (512, 512)
DEMO_FPS = 25.0
DEMO_FOCAL_PX = 720.0
DEMO_DISTANCE_M = 0.48
IDENTITY_SD = 0.7  # of the head's own: a face that nobody would look twice at


@dataclass(frozen=True)
class Truth:
    """What a rendered talker really did, in tracker.Track's conventions; N frames at `time` [N] s.

    neutral: [D, 3] m. faces: [F, 3]. identity: [Ki]. expression: [N, Ke] weights in the order of `names`.
    rotation: [N, 3] axis-angle rad. translation: [N, 3] m. eyes: [N, 2, 3] rad. focal: px. principal: [2] px.
    size: (width, height). lip_gap_mm: [N]. head: name@sha256.
    """

    time: NDArray[np.float64]
    neutral: F32
    faces: NDArray[np.int32]
    identity: F32
    expression: F32
    names: NDArray[np.str_]
    rotation: F32
    translation: F32
    eyes: F32
    focal: np.float64
    principal: F32
    size: NDArray[np.int32]
    lip_gap_mm: F32
    head: np.str_

    def save(self, path: Path) -> None:
        """Write as npz, one key a field; whole or not at all."""
        write_npz(path, **asdict(self))

    @classmethod
    def load(cls, path: Path) -> Truth:
        """Read what `save` wrote. Raises OSError, ValueError or KeyError on another file."""
        with np.load(path, allow_pickle=False) as file:
            return cls(**{field.name: file[field.name][()] for field in fields(cls)})


def render_talker(
    path: Path,
    motion: TalkerMotion,
    identity: F32,
    head: HeadModel,
    size: tuple[int, int],
    focal: float,
    seed: int,
    audio: F32 | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Truth:
    """Render to the video `path` (H.264, AAC) and write the truth beside it as `<stem>.truth.npz`.

    identity: [Ki] standard deviations. size: (width, height) px. focal: px. audio: [S] at 16 kHz.
    seed: of skin, background and noise. progress: (done, total) frames.
    """
    principal = np.array([(side - 1) / 2 for side in size], np.float32)
    weights = motion.expression_for(head.expression_names)
    rest = np.zeros(len(head.expression_names), np.float32)
    # What is filmed; its face is the head's.
    person = mouth.furnished(head)
    studio = _Studio(replace(person, template=person.vertices(identity, rest)), size, focal, seed)
    turns = Rotation.from_rotvec(motion.rotation)
    gaps = np.empty(len(weights), np.float32)
    with VideoWriter(path, motion.fps, size, audio=audio, crf=CRF) as writer:
        for frame, weight in enumerate(weights):
            vertices = person.vertices(identity, weight, eyes=motion.eyes[frame])
            gaps[frame] = head.lip_gap_mm(vertices)
            posed = turns[frame].apply(vertices) + motion.translation[frame]
            writer.write(studio.shoot(posed.astype(np.float32)))
            if progress is not None:
                progress(frame + 1, len(weights))
    truth = Truth(
        time=np.arange(len(weights)) / motion.fps,
        neutral=head.vertices(identity, rest),
        faces=head.faces,
        identity=np.asarray(identity, np.float32),
        expression=weights,
        names=np.array(head.expression_names),
        rotation=motion.rotation,
        translation=motion.translation,
        eyes=motion.eyes,
        focal=np.float64(focal),
        principal=principal,
        size=np.array(size, np.int32),
        lip_gap_mm=gaps,
        head=np.str_(f"{head.name}@{head.sha256}"),
    )
    truth.save(path.with_name(f"{path.stem}.truth.npz"))
    return truth


def demo_identity(head: HeadModel, seed: int) -> F32:
    """[Ki] a plausible person, standard deviations."""
    random = np.random.default_rng((seed, 6))
    drawn = np.clip(random.standard_normal(len(head.identity_basis)), -2, 2)
    return (IDENTITY_SD * drawn).astype(np.float32)


def render_demo(
    path: Path, head: HeadModel, seed: int, progress: Callable[[int, int], None] | None = None
) -> Truth:
    """Film 40 s of a made-up person who says the bundled, public-domain speech; the truth goes beside it."""
    audio, _ = read_audio(ASSETS / "demo_speech.flac")
    phones = load_phones(ASSETS / "demo_speech.json")
    style = Style.random(seed)
    duration = len(audio) / SPEECH_RATE
    motion = talker_motion(phones, duration, DEMO_FPS, seed, style, audio, DEMO_DISTANCE_M)
    identity = demo_identity(head, seed)
    return render_talker(path, motion, identity, head, DEMO_SIZE, DEMO_FOCAL_PX, seed, audio, progress)


class _Studio:
    """Skin, light, background, lens and sensor of one film."""

    def __init__(self, person: HeadModel, size: tuple[int, int], focal: float, seed: int) -> None:
        self._random = np.random.default_rng((seed, 5))
        self._faces, self._places, self._lips = person.faces, person.template, person.regions["lips"]
        self._albedo = mouth.painted(person)
        self._detail = mouth.MouthDetail.of(person, len(person.template), seed)
        self._block = skin_block(seed)
        self._size = size
        self._large = (size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING)
        self._focal = focal * SUPERSAMPLING
        self._principal = [(side - 1) / 2 for side in self._large]
        self._backdrop = backdrop(self._large, seed)
        shape = (NOISE_PLATES, size[1], size[0], 3)
        self._plates = (NOISE * self._random.standard_normal(shape)).astype(np.float32)

    def shoot(self, vertices: F32) -> U8:
        """A picture [H, W, 3] u8 of posed vertices [D, 3] m in the camera frame."""
        pixels = np.concatenate([project(vertices, self._focal, self._principal), vertices[:, 2:]], axis=1)
        # Only the rectangle around the head is worked on.
        left, top = np.clip(np.floor(pixels[:, :2].min(axis=0)), 0, self._large).astype(int)
        right, bottom = np.clip(np.ceil(pixels[:, :2].max(axis=0)) + 1, 0, self._large).astype(int)
        pixels[:, :2] -= (left, top)
        picture = self._backdrop.copy()
        around = picture[top:bottom, left:right]
        raster = rasterize(pixels, self._faces, (right - left, bottom - top))
        around[:] = shade(raster, self._faces, vertices, self._albedo, around, LIGHT, AMBIENT)
        texture(around, raster, self._faces, self._places, self._block)
        pixels_per_m = self._focal / float(vertices[self._lips, 2].mean())
        self._detail.lay(around, raster, self._faces, pixels[self._lips, :2], pixels_per_m)
        picture = cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA)
        blurred = cv2.GaussianBlur(picture, (0, 0), BLUR_PX).astype(np.float32)
        shift = self._random.integers(0, self._size[0])
        blurred += np.roll(self._plates[self._random.integers(NOISE_PLATES)], shift, axis=1)
        return np.clip(blurred + 0.5, 0, 255).astype(np.uint8)
