"""A person of the embedded head itself, as noisy landmarks: errors are lower bounds."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from benchmarks.ground_truth import GroundTruth
from tracker.energy import rotation_matrix
from tracker.head import HeadModel
from tracker.landmark_indices import BLENDSHAPE_NAMES, POINTS
from tracker.track import F32, F64, Landmarks

FPS, SIZE, FOCAL, DISTANCE_M = 25.0, (1280, 720), 1500.0, 0.65
NOISE, BIAS = 0.0035, 0.006  # of the distance between the outer eye corners: correlated in time, and static
EYES_M = 0.09
SPEECH = (  # shapes, largest weight, Hz
    (("jawOpen",), 0.35, 4.0),
    (("mouthFunnel",), 0.4, 3.0),
    (("mouthPucker",), 0.4, 2.5),
    (("mouthSmileLeft", "mouthSmileRight"), 0.3, 0.5),
    (("mouthLowerDownLeft", "mouthLowerDownRight"), 0.3, 4.5),
    (("mouthUpperUpLeft", "mouthUpperUpRight"), 0.2, 4.0),
    (("browInnerUp",), 0.5, 0.4),
    (("eyeBlinkLeft", "eyeBlinkRight"), 0.8, 0.3),
)


def noisy_landmarks(head: HeadModel, frames: int, seed: int) -> tuple[GroundTruth, Landmarks]:
    """A random person of the head model who talks and turns the head, and noisy landmarks of it at 720p."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / FPS
    identity = 0.6 * rng.normal(size=len(head.identity_basis)).astype(np.float32)
    expression = _speech(head, t, rng)
    matrix = rotation_matrix(
        np.radians([8.0, 18.0, 4.0]) * np.sin(np.outer(t, [0.9, 0.7, 0.5]) + rng.uniform(0, 6, 3))
    )
    shift = np.array([0.0, 0.0, DISTANCE_M]) + 0.01 * np.sin(np.outer(t, [0.8, 0.5, 0.6]))
    translation = shift - matrix @ head.template.mean(0)
    many = np.broadcast_to(identity, (frames, len(identity)))
    seen = head.landmark_positions(many, expression) @ matrix.transpose(0, 2, 1) + translation[:, None]
    pixels = FOCAL * seen[..., :2] / seen[..., 2:] + (np.array(SIZE) - 1) / 2
    jitter = gaussian_filter1d(rng.normal(size=pixels.shape), 1.0, axis=0)
    errors = NOISE * jitter / jitter.std() + BIAS * rng.normal(size=pixels.shape[1:])
    pixels += EYES_M * FOCAL / DISTANCE_M * errors
    points = np.zeros((frames, POINTS, 3), np.float32)
    points[:, head.landmark_embedding.landmarks] = np.dstack([pixels, seen[..., 2] * FOCAL / DISTANCE_M])
    face = np.sort(head.regions["face"])
    truth = GroundTruth(
        neutral=head.vertices(identity, np.zeros_like(expression[0]))[face].astype(np.float64),
        faces=np.searchsorted(face, head.faces[np.isin(head.faces, face).all(1)]).astype(np.int32),
        displacement=np.tensordot(expression, head.expression_basis[:, face], axes=1).astype(np.float64),
        rotation=matrix,
        translation=translation,
        focal=FOCAL,
        lip_gap_mm=np.asarray(head.lip_gap_mm(head.vertices(many, expression)), np.float64),
        covered=np.zeros(frames),
        vertices=face.astype(np.int32),
    )
    scores = np.zeros((frames, len(BLENDSHAPE_NAMES)), np.float32)
    return truth, Landmarks(t, points, np.ones(frames, np.float32), scores, BLENDSHAPE_NAMES, SIZE)


def _speech(head: HeadModel, t: F64, rng: np.random.Generator) -> F32:
    """[T, Ke] weights that move at the rates of speech."""
    names = list(head.expression_names)
    weights = np.zeros((len(t), len(names)), np.float32)
    for shapes, size, rate in SPEECH:
        wave = np.sin(2 * np.pi * (rate * t + rng.uniform()) + np.sin(1.7 * rate * t))
        for name in shapes:
            weights[:, names.index(name)] = np.clip(size * wave, 0, 1)
    return weights
