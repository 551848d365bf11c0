"""A synthetic talker's motion: phones with times to ARKit weights, head pose and gaze."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from personalize.sound import SPEECH_RATE
from personalize.talkers import upper_face
from personalize.talkers.mouth import mouth_channels
from personalize.talkers.noise import RATE, at_times, clock, smooth_noise
from personalize.talkers.style import Style
from personalize.talkers.visemes import ARKIT_NAMES, CHANNELS, Phone

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

NECK = np.array([0.0, -0.11, -0.06])  # m, head frame: the point that head turns leave where it is
FACING = Rotation.from_euler(
    "x", np.pi
)  # head axes (y up, z out of the face) to camera axes (y down, z away)
SWAY_M = (0.008, 0.004, 0.012)


@dataclass(frozen=True)
class TalkerMotion:
    """A talker's face and head over time; frame n is at n / fps s.

    names: the 52 ARKit names. expression: [N, 52] f32, 0..1, mouthClose never above jawOpen.
    rotation: [N, 3] f32 axis-angle rad and translation: [N, 3] f32 m take the head frame (x to the subject's
    left, y up, z out of the face) to the camera frame (OpenCV), as in tracker.Track.
    eyes: [N, 2, 3] f32 axis-angle rad in the head frame, left then right.
    """

    fps: float
    names: tuple[str, ...]
    expression: F32
    rotation: F32
    translation: F32
    eyes: F32

    def expression_for(self, names: Sequence[str]) -> F32:
        """[N, len(names)] weights in another order; names that are not ARKit's stay 0."""
        column = {name: self.expression[:, index] for index, name in enumerate(self.names)}
        zero = np.zeros(len(self.expression), np.float32)
        return np.stack([column.get(name, zero) for name in names], axis=1)


def talker_motion(
    phones: Sequence[Phone],
    duration: float,
    fps: float,
    seed: int,
    style: Style | None = None,
    audio: F32 | None = None,
    distance: float = 0.55,
) -> TalkerMotion:
    """Motion of `duration` s for phones with times. The same seed and style give the same motion at any fps.

    audio: [S] at 16 kHz, opens the mouth wider where it is loud. distance: m from camera to head.
    """
    style = style or Style()
    random = np.random.default_rng((seed, 0))
    times = clock(duration)
    loud = np.full_like(times, 0.6) if audio is None else loudness(audio, times)
    channels = mouth_channels(phones, times, style, loud, random)
    accent = upper_face.accents(phones, times, loud, random)
    angles = upper_face.head_angles(times, accent, style, random)
    look = upper_face.gaze(times, random)
    weights = _mouth_weights(dict(zip(CHANNELS, channels.T)), style, random)
    weights |= upper_face.brows(times, accent, style, random)
    weights |= _eye_weights(times, look, weights, style, random)
    empty = np.zeros_like(times)
    expression = np.clip(np.stack([weights.get(name, empty) for name in ARKIT_NAMES], axis=1), 0, 1)
    sway = smooth_noise(random, len(times), 2.5, 3) * SWAY_M

    frames = np.arange(round(duration * fps)) / fps
    angles, sway, look = at_times(angles, frames), at_times(sway, frames), at_times(look, frames)
    turn = Rotation.from_euler("YXZ", angles * (1, -1, 1))
    rotation = FACING * turn
    translation = sway + np.array([0.0, 0.0, distance]) + FACING.apply(NECK) - rotation.apply(NECK)
    return TalkerMotion(
        fps=fps,
        names=tuple(ARKIT_NAMES),
        expression=at_times(expression, frames).astype(np.float32),
        rotation=rotation.as_rotvec().astype(np.float32),
        translation=translation.astype(np.float32),
        eyes=_eye_rotation(angles, look).astype(np.float32),
    )


def loudness(audio: F32, times: F64) -> F64:
    """[S] 0..1 at `times` [S] s: level of sound at 16 kHz between its quiet and its loud parts, smoothed."""
    block = round(SPEECH_RATE / RATE)
    padded = np.zeros(len(times) * block)
    padded[: min(len(audio), len(padded))] = audio[: len(padded)]
    level = 10 * np.log10(np.mean(padded.reshape(-1, block) ** 2, axis=1) + 1e-9)
    low, high = np.quantile(level, (0.15, 0.97))
    return gaussian_filter1d(np.clip((level - low) / max(high - low, 1.0), 0, 1), 0.06 * RATE)


def _pair(name: str, curve: F64, lean: F64) -> dict[str, F64]:
    return {f"{name}Left": curve * (1 + lean), f"{name}Right": curve * (1 - lean)}


def _sides(names: tuple[str, str], curve: F64) -> dict[str, F64]:
    return {names[0]: np.maximum(curve, 0), names[1]: np.maximum(-curve, 0)}


def _mouth_weights(channels: dict[str, F64], style: Style, random: np.random.Generator) -> dict[str, F64]:
    """Speech channels [S] each to weights [S] of the lower face by ARKit name."""
    shut = channels["seal"]
    apart = 1 - shut
    jaw = channels["jawOpen"]
    size = len(jaw)
    slow = smooth_noise(random, size, 1.8, 8)
    lean = style.asymmetry * (random.standard_normal(8) + 0.5 * smooth_noise(random, size, 2.0, 8)).T
    smile = channels["mouthSmile"] + style.smile * (1 + 0.6 * np.tanh(slow[:, 0]))
    upper = channels["mouthUpperUp"] * apart
    return {
        "jawOpen": jaw,
        "mouthClose": jaw * shut,
        "mouthFunnel": channels["mouthFunnel"] * apart,
        "mouthPucker": channels["mouthPucker"],
        "mouthRollLower": channels["mouthRollLower"] * apart,
        "mouthShrugUpper": channels["mouthShrugUpper"] * apart + 0.03 * np.maximum(slow[:, 1], 0),
        "mouthShrugLower": 0.05 * np.maximum(slow[:, 2], 0),
        "jawForward": channels["jawForward"],
        **_sides(("jawLeft", "jawRight"), 0.04 * slow[:, 3]),
        **_sides(("mouthLeft", "mouthRight"), 0.05 * slow[:, 4]),
        **_pair("mouthStretch", channels["mouthStretch"], lean[0]),
        **_pair("mouthSmile", smile, lean[1]),
        **_pair("mouthLowerDown", channels["mouthLowerDown"] * apart, lean[2]),
        **_pair("mouthUpperUp", upper, lean[3]),
        **_pair("mouthPress", channels["mouthPress"], lean[4]),
        **_pair("mouthDimple", 0.05 * np.maximum(slow[:, 5], 0) + 0.15 * channels["mouthStretch"], lean[5]),
        **_pair("mouthFrown", 0.05 * np.maximum(slow[:, 6], 0), lean[6]),
        **_pair("noseSneer", 0.2 * upper + 0.03 * np.maximum(slow[:, 7], 0), lean[7]),
        **_pair("cheekSquint", 0.4 * smile, lean[1]),
    }


def _eye_weights(
    times: F64, look: F64, weights: dict[str, F64], style: Style, random: np.random.Generator
) -> dict[str, F64]:
    """Blinks, squints and the lids that follow the gaze, [S] each by ARKit name."""
    blink = upper_face.blinks(times, style, random)
    squint = 0.10 * np.maximum(smooth_noise(random, len(times), 2.0)[:, 0], 0)
    lids = {}
    for side in ("Left", "Right"):
        lids[f"eyeBlink{side}"] = blink
        lids[f"eyeWide{side}"] = weights[f"eyeWide{side}"] * (1 - blink)
        lids[f"eyeSquint{side}"] = squint + 0.3 * weights[f"cheekSquint{side}"]
        lids[f"eyeLookDown{side}"] = np.maximum(-look[:, 1] / 0.5, 0)
        lids[f"eyeLookUp{side}"] = np.maximum(look[:, 1] / 0.5, 0)
    return lids


def _eye_rotation(angles: F64, look: F64) -> F64:
    """[N, 2, 3] axis-angle of both eyes in the head frame: most of a head turn is countered, the gaze added."""
    yaw, pitch = look[:, 0] - 0.8 * angles[:, 0], look[:, 1] - 0.8 * angles[:, 1]
    turn = Rotation.from_euler("YX", np.stack([yaw, -pitch], axis=1)).as_rotvec()
    return np.repeat(turn[:, None], 2, axis=1)
