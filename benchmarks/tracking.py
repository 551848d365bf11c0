"""Speed and accuracy of the landmark fit: `python -m benchmarks.tracking [VIDEO ...]`.

Three tables: motion of the embedded head itself under noise (truth known, and inside the model), rendered
heads that the model does not contain (shared data, when it is there), and the videos named, where only
consistency can be told.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.ground_truth import GroundTruth, compare
from personalize.media import read_frames
from tracker.energy import rotation_matrix
from tracker.fit import fit_track
from tracker.head import HeadModel, load_head
from tracker.landmark_indices import BLENDSHAPE_NAMES, LEFT_EYE_OUTER, POINTS, RIGHT_EYE_OUTER
from tracker.landmarker import track_landmarks
from tracker.refine import refine_track
from tracker.track import F32, F64, Bundle, Camera, Landmarks, Track

FPS, SIZE, FOCAL, DISTANCE_M = 25.0, (1280, 720), 1500.0, 0.65
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
CUT = 40.0  # mean grey levels by which the picture changes at a cut
EMPTY = np.zeros((0, 3), np.float32)
NO_BUNDLE = Bundle(np.zeros(0, np.int32), EMPTY, EMPTY, EMPTY, np.zeros((0, 4), np.float32))


def camera(size: tuple[int, int], focal: float) -> Camera:
    """A camera without distortion whose focal length is given."""
    return Camera(focal, 0.0, ((size[0] - 1) / 2, (size[1] - 1) / 2), (), size, "given", "")


def fitted(
    landmarks: Landmarks, focal: float, head: HeadModel, segment: NDArray[np.int32]
) -> tuple[Track, float]:
    """The track and the time it took, ms a frame."""
    start = time.perf_counter()
    usable = landmarks.presence > 0
    track = fit_track(landmarks, camera(landmarks.size, focal), NO_BUNDLE, head, usable, segment)
    return track, 1e3 * (time.perf_counter() - start) / len(usable)


def refined(
    track: Track,
    landmarks: Landmarks,
    focal: float,
    head: HeadModel,
    segment: NDArray[np.int32],
    film: Path,
) -> tuple[Track, float]:
    """The track after the photometric stage, and the time that took, ms a frame."""
    start, lens = time.perf_counter(), camera(landmarks.size, focal)
    after = refine_track(track, landmarks, lens, head, segment, lambda: read_frames(film))
    return after.track, 1e3 * (time.perf_counter() - start) / len(landmarks.time)


def talking_head(head: HeadModel, frames: int, seed: int) -> tuple[GroundTruth, Landmarks]:
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
    eyes = 0.09 * FOCAL / DISTANCE_M
    jitter = gaussian_filter1d(rng.normal(size=pixels.shape), 1.0, axis=0)
    pixels += eyes * (0.0035 * jitter / jitter.std() + 0.006 * rng.normal(size=pixels.shape[1:]))
    points = np.zeros((frames, POINTS, 3), np.float32)
    points[:, head.landmark_embedding.landmarks] = np.dstack([pixels, seen[..., 2] * FOCAL / DISTANCE_M])
    face = np.sort(head.regions["face"])
    neutral = head.vertices(identity, np.zeros_like(expression[0]))[face]
    truth = GroundTruth(
        neutral=neutral.astype(np.float64),
        faces=np.searchsorted(face, head.faces[np.isin(head.faces, face).all(1)]).astype(np.int32),
        displacement=np.tensordot(expression, head.expression_basis[:, face], axes=1),
        rotation=matrix,
        translation=translation,
        focal=FOCAL,
        lip_gap_mm=np.asarray(head.lip_gap_mm(head.vertices(many, expression)), np.float64),
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


def in_model(head: HeadModel) -> None:
    """Truth inside the model: a lower bound of the error, since truth and fit share the head."""
    print("\nembedded head, 720p, noise .35 % and static bias .6 % of the outer-eye distance, true focal")
    for seed in range(3):
        truth, landmarks = talking_head(head, 500, seed)
        track, spent = fitted(landmarks, truth.focal, head, np.zeros(500, np.int32))
        show(f"person {seed}", compare(track, head, truth) | {"ms_per_frame": spent})


def rendered(head: HeadModel, folder: Path) -> None:
    """Rendered scan-based heads, which the model does not contain."""
    print("\nrendered heads outside the model (shared data), focal 1.2 times the long side and the true one")
    for path in sorted(folder.glob("*.npz")):
        truth = GroundTruth.load(path)
        film = path.with_suffix(".mp4")
        landmarks, segment = detected(film)
        for name, focal in (("1.2", 1.2 * max(landmarks.size)), ("true", truth.focal)):
            track, spent = fitted(landmarks, focal, head, segment)
            show(f"{path.stem} f={name}", compare(track, head, truth) | {"ms_per_frame": spent})
            track, spent = refined(track, landmarks, focal, head, segment, film)
            show(f"{path.stem} f={name} refined", compare(track, head, truth) | {"ms_per_frame": spent})


def real(head: HeadModel, videos: list[Path], seconds: float) -> None:
    """Real clips: consistency alone."""
    print(f"\nreal clips, first {seconds:.0f} s, focal 1.2 times the long side")
    for path in videos:
        landmarks, segment = detected(path, seconds)
        track, spent = fitted(landmarks, 1.2 * max(landmarks.size), head, segment)
        show(path.stem, consistency(track, landmarks) | {"ms_per_frame": spent})


def consistency(track: Track, landmarks: Landmarks) -> dict[str, float]:
    """Residual in % of the outer-eye distance, lip opening against the raw landmarks', gap when closed."""
    seen = track.valid
    points = landmarks.points[seen, :, :2]
    eyes = np.linalg.norm(points[:, LEFT_EYE_OUTER] - points[:, RIGHT_EYE_OUTER], axis=-1)
    raw = np.linalg.norm(points[:, 13] - points[:, 14], axis=-1) / eyes
    gap = track.lip_gap_mm[seen]
    return {
        "reprojection_pct": 100 * float((track.reprojection_px[seen] / eyes).mean()),
        "opening_r": float(np.corrcoef(raw, gap)[0, 1]),
        "gap_at_closure_mm": float(np.median(gap[raw <= np.quantile(raw, 0.1)])),
        "gap_p95_mm": float(np.quantile(gap, 0.95)),
        "confidence": float(track.confidence[seen].mean()),
    }


def detected(path: Path, seconds: float = 60.0) -> tuple[Landmarks, NDArray[np.int32]]:
    """Landmarks of the first seconds of a video, and the number of each frame's shot."""
    frames: list[tuple[float, NDArray[np.uint8]]] = []
    cuts: set[int] = set()
    shot = [0]
    for now, rgb in read_frames(path, max_side=1280):
        if now > seconds:
            break
        if frames and np.abs(rgb[::8, ::8].astype(int) - frames[-1][1][::8, ::8]).mean() > CUT:
            cuts.add(len(frames))
        frames.append((now, rgb))
        shot.append(len(cuts))
    return track_landmarks(frames, len(frames), cuts), np.array(shot[1:], np.int32)


def show(name: str, figures: dict[str, float]) -> None:
    """One line of a table."""
    print(f"{name:28s}", *(f"{key} {value:.3f}" for key, value in figures.items()), flush=True)


def main() -> None:
    """Print the tables."""
    head = load_head()
    in_model(head)
    shared = Path(os.environ.get("PERSONALIZE_SHARED", Path(__file__).parents[2] / "shared"))
    if (shared / "data" / "gt").is_dir():
        rendered(head, shared / "data" / "gt")
    real(head, [Path(name) for name in sys.argv[1:]], seconds=20.0)


if __name__ == "__main__":
    main()
