"""`personalize demo`: a made-up person on film, the whole pipeline on that film, and the true errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from trimesh.registration import procrustes

from model.motion import DAMAGED
from personalize.errors import UserError
from personalize.files import write_json
from personalize.pipeline import personalize_video
from personalize.reporter import Reporter
from personalize.run import read_track
from personalize.settings import Settings
from personalize.talkers.film import Truth, render_demo
from tracker.head import HeadModel, load_head
from tracker.track import Track

ERROR_MEANINGS = {
    "lip_motion_mm": "lip vertices against the neutral, mean over frames",
    "lip_motion_centred_mm": "the same about the mean over time: the movement itself",
    "face_motion_mm": "face vertices against the neutral, mean over frames",
    "face_surface_mm": "neutral face after one similarity (size cannot be seen in a video)",
    "lip_opening_rmse_mm": "opening of the lips",
    "lip_opening_r": "its correlation with the truth",
    "rotation_deg": "head rotation after removing the constant",
    "focal_percent": "focal length",
    "tracked_percent": "share of frames tracked",
}


def run_demo(out: Path, iterations: int, seed: int) -> dict[str, float]:
    """Render, personalize, compare; writes `demo_SEED.mp4` and its truth, the run folder and `errors.json` into `out`.

    Returns the true errors by the names of ERROR_MEANINGS. The film is made once per folder and seed.
    """
    report, head = Reporter(), load_head()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: cannot be written ({error.strerror}); choose another with --out") from None
    video, truth_file = out / f"demo_{seed}.mp4", out / f"demo_{seed}.truth.npz"
    # The truth is written after the film: when it is there, both are whole.
    if not (video.is_file() and _is_truth(truth_file)):
        report.say("rendering 40 s of a made-up person who says a sonnet")
        with report.stage("rendering"):
            render_demo(video, head, seed, report.progress)
    if iterations < Settings.iterations:
        report.say(f"fine-tuning for {iterations} iterations; the full job is {Settings.iterations}")
    result = personalize_video(
        video, out / f"demo_{seed}.personalize", Settings(iterations=iterations, seed=seed), report=report
    )
    for name, path in result.items():
        report.say(f"{name:<11} {path}")
    errors = true_errors(read_track(result["run"] / "refine/track.npz"), Truth.load(truth_file), head)
    write_json(out / "errors.json", errors)
    return errors


def _is_truth(path: Path) -> bool:
    try:
        Truth.load(path)
    except (KeyError, *DAMAGED):
        return False
    return True


def true_errors(track: Track, truth: Truth, head: HeadModel) -> dict[str, float]:
    """The track against what was rendered, over the frames that were tracked; see ERROR_MEANINGS."""
    valid = track.valid & (np.arange(len(track.time)) < len(truth.time))
    rows = np.flatnonzero(valid)
    errors = {}
    for name, region in (("lip", head.regions["lips"]), ("face", head.regions["face"])):
        basis = head.expression_basis[:, region]
        motion = np.tensordot(track.expression[rows], basis, axes=1)
        true_motion = np.tensordot(truth.expression[rows], basis, axes=1)
        errors[f"{name}_motion_mm"] = mean_distance_mm(motion, true_motion)
        if name == "lip":
            errors["lip_motion_centred_mm"] = mean_distance_mm(
                motion - motion.mean(0), true_motion - true_motion.mean(0)
            )
    neutral = head.vertices(track.identity, np.zeros_like(track.expression[0]))
    face = head.regions["face"]
    _, aligned, _ = procrustes(neutral[face], truth.neutral[face], reflection=False)
    errors["face_surface_mm"] = mean_distance_mm(np.asarray(aligned), truth.neutral[face])
    gap, true_gap = track.lip_gap_mm[rows], truth.lip_gap_mm[rows]
    errors["lip_opening_rmse_mm"] = float(np.sqrt(np.mean((gap - true_gap) ** 2)))
    errors["lip_opening_r"] = float(np.corrcoef(gap, true_gap)[0, 1])
    errors["rotation_deg"] = rotation_error_deg(track.rotation[rows], truth.rotation[rows])
    errors["focal_percent"] = 100 * (track.focal / float(truth.focal) - 1)
    errors["tracked_percent"] = 100 * float(track.valid.mean())
    return {name: errors[name] for name in ERROR_MEANINGS}


def mean_distance_mm(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Mean Euclidean distance of points [..., 3] m, in mm."""
    return float(np.linalg.norm(a - b, axis=-1).mean() * 1000)


def rotation_error_deg(rotation: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Mean angle between axis-angle rotations [N, 3] once their mean difference is taken out."""
    difference = Rotation.from_rotvec(rotation).inv() * Rotation.from_rotvec(truth)
    return float(np.rad2deg((difference.mean().inv() * difference).magnitude()).mean())
