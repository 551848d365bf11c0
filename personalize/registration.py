"""Track -> Motion: head-fixed displacements from the subject's neutral, in the base model's basis, at 30 fps.

The one place where the tracker's result becomes the model's input.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from model.checkpoint import Checkpoint
from model.motion import FPS, Motion, topology_hash
from personalize.av_sync import estimate_av_offset
from personalize.errors import UserError
from personalize.files import sha256_file, write_json
from personalize.heads import run_head
from personalize.quality import read_reasons
from personalize.reporter import Reporter
from personalize.run import RunFolder, read_frames, read_track, tool_version
from personalize.settings import Settings
from personalize.sound import read_audio
from personalize.subject_data import base_path
from tracker.head import HeadModel
from tracker.track import Track

F32 = NDArray[np.float32]
# The embedded head's mean is scaled to adults' mean distance between the pupils (tools/build_head.py).
SCALE = "the head model's prior: a video does not show absolute size; the embedded head's eyes are 62 mm apart, sd 4"
FRAMES_AT_ONCE = 256
# A gap longer than this between two tracked frames is not bridged: nothing was seen there.
LONGEST_BRIDGE_S = 0.15


@dataclass(frozen=True)
class BaseFace:
    """The topology a motion is registered to: template [D, 3] m, faces [F, 3], orthonormal basis [K, D, 3]."""

    template: F32
    faces: NDArray[np.int32]
    basis: F32

    @property
    def topology(self) -> str:
        """sha256 of D and the faces."""
        return topology_hash(len(self.template), self.faces)


@dataclass(frozen=True)
class Transfer:
    """Barycentric correspondences: base vertex d lies at `weights[d] · head.vertices[corners[d]]`.

    corners: [D, 3] i32. weights: [D, 3]. residual_mm: mean distance of the fitted base mesh to the head's surface.
    """

    corners: NDArray[np.int32]
    weights: F32
    residual_mm: float

    def apply(self, values: F32) -> F32:
        """[..., D_head, 3] -> [..., D, 3]."""
        return np.einsum("dc,...dcx->...dx", self.weights, values[..., self.corners, :]).astype(np.float32)


def register_run(run: RunFolder, settings: Settings, folder: Path, report: Reporter) -> None:
    """Write motion.npz and registration.json of a run: the motion, and where its sound lies on its clock."""
    frames = read_frames(run.path / "ingest/frames.npz")
    track = read_track(run.path / "refine/track.npz")
    reasons = read_reasons(run.path / "refine/quality.csv")
    used = reasons == "ok"
    if not used.any():
        ((reason, _),) = Counter(reasons.tolist()).most_common(1)
        raise UserError(
            f"{run.video}: no frame is in use, mostly for {reason!r} (see docs/run-folder.md); look at "
            f"{run.path / 'overlay.mp4'}, and give a lower --min-confidence if the mesh lies well, else a better video"
        )
    track = dataclasses.replace(track, valid=used)
    base = Checkpoint.load(base_path(settings))
    motion, facts = register(
        track, frames.segment, run_head(settings), BaseFace(base.template, base.faces, base.basis)
    )
    sound = run.path / "ingest/audio.wav"
    audio, start_s = read_audio(sound)
    offset = estimate_av_offset(track.time, track.lip_gap_mm, track.valid, audio, start_s)
    applied = offset.offset_s if offset.sure else 0.0
    if applied:
        report.say(
            f"the sound is {abs(applied) * 1000:.0f} ms {'late' if applied > 0 else 'early'}: corrected"
        )
    provenance = {
        "tool": "personalize",
        "version": tool_version(),
        "synthetic": False,
        "source": run.video_sha256,
        "checkpoint": None,
        "seed": None,
        "guidance": None,
        # With the motion, which may be used outside of this folder, and the files whose sound is meant.
        "av_offset_s": applied,
        "av_offset_of": [run.video_sha256, sha256_file(sound)],
    }
    dataclasses.replace(motion, provenance=provenance).save(folder / "motion.npz")
    facts |= {"av_offset_s": applied, "av_offset_estimate_s": offset.offset_s, "av_offset_sure": offset.sure}
    write_json(folder / "registration.json", facts)


def transfer_between(base: BaseFace, template: F32, faces: NDArray[np.int32]) -> Transfer:
    """Non-rigid registration of the base mesh onto a head of another topology (Amberg et al. 2007, trimesh).

    template: [D_head, 3] m. A similarity between bounding boxes starts it; both heads are upright and face +z.
    """
    target = trimesh.Trimesh(template, faces, process=False)
    low, high = base.template.min(0), base.template.max(0)
    scale = float(np.linalg.norm(np.ptp(template, axis=0)) / np.linalg.norm(high - low))
    start = (base.template - (low + high) / 2) * scale + (template.min(0) + template.max(0)) / 2
    # Not trimesh's mesh_other: it also tries the head upside down.
    _, aligned, _ = trimesh.registration.icp(
        start, target, threshold=1e-7, max_iterations=50, reflection=False
    )
    source = trimesh.Trimesh(aligned, base.faces, process=False)
    fitted = trimesh.registration.nricp_amberg(source, target, distance_threshold=0.02)
    closest, distance, triangle = trimesh.proximity.closest_point(target, fitted)
    weights = trimesh.triangles.points_to_barycentric(target.triangles[triangle], closest)
    corners = np.asarray(faces)[triangle].astype(np.int32)
    return Transfer(corners, weights.astype(np.float32), float(distance.mean() * 1000))


def register(
    track: Track, segment: NDArray[np.int32], head: HeadModel, base: BaseFace
) -> tuple[Motion, dict[str, Any]]:
    """The subject's motion in the base topology, and what registration did to it.

    segment: [T] i4, id of the uninterrupted shot of each frame; nothing is interpolated across two of them.
    The report's keys: topology, head, transferred, transfer_residual_mm, projection_residual_mm, frames, valid_frames,
    eye_distance_mm and scale, which says where absolute size comes from.
    """
    neutral = head.vertices(track.identity, np.zeros(track.expression.shape[1], np.float32))
    same = topology_hash(len(head.template), head.faces) == base.topology
    transfer = None if same else transfer_between(base, neutral, head.faces)
    coefficients, projection_mm = _project(track, neutral, head, base, transfer)
    start_s, resampled, valid = resample(coefficients, track.time, track.valid, segment)
    motion = Motion(
        fps=FPS,
        start_s=start_s,
        template=neutral if transfer is None else transfer.apply(neutral),
        faces=base.faces,
        basis=base.basis,
        coefficients=resampled,
        valid=valid,
    )
    report = {
        "topology": base.topology,
        "head": track.head,
        "transferred": transfer is not None,
        "transfer_residual_mm": 0.0 if transfer is None else transfer.residual_mm,
        "projection_residual_mm": projection_mm,
        "frames": len(valid),
        "valid_frames": int(valid.sum()),
        "eye_distance_mm": _eye_distance_mm(head, track.identity),
        "scale": SCALE,
    }
    return motion, report


def _eye_distance_mm(head: HeadModel, identity: F32) -> float:
    left, right = (
        joint.position + identity @ joint.identity_basis
        for joint in (head.joints["left_eye"], head.joints["right_eye"])
    )
    return float(1e3 * np.linalg.norm(left - right))


def _project(
    track: Track, neutral: F32, head: HeadModel, base: BaseFace, transfer: Transfer | None
) -> tuple[F32, float]:
    """Coefficients [T, K] of the displacements, and the mean vertex distance in mm that the basis does not hold."""
    basis = base.basis.reshape(len(base.basis), -1)
    coefficients = np.zeros((len(track.time), len(basis)), np.float32)
    residuals = []
    for start in range(0, len(track.time), FRAMES_AT_ONCE):
        rows = slice(start, start + FRAMES_AT_ONCE)
        # Gaze stays out of the motion: eyeballs turn, and a basis of displacements cannot.
        moved = head.vertices(track.identity, track.expression[rows], jaw=track.jaw[rows]) - neutral
        displacement = moved if transfer is None else transfer.apply(moved)
        flat = displacement.reshape(len(displacement), -1)
        coefficients[rows] = flat @ basis.T
        rest = (flat - coefficients[rows] @ basis).reshape(displacement.shape)
        residuals.append(np.linalg.norm(rest, axis=-1).mean(1) * 1000)
    return coefficients, float(np.concatenate(residuals)[track.valid].mean())


def resample(
    values: F32, time: NDArray[np.float64], valid: NDArray[np.bool_], segment: NDArray[np.int32]
) -> tuple[float, F32, NDArray[np.bool_]]:
    """Values [T, K] at presentation times -> 30 fps: (start_s, [N, K], valid [N]).

    Each run of valid frames of one segment is interpolated on its own, by shape-preserving cubics: they pass
    through every measured frame and cannot overshoot a closure. Frames between runs hold the nearest value and are not
    valid, of two shots that meet at least one.
    """
    start_s = float(time[0])
    at = start_s + np.arange(int(np.floor((time[-1] - start_s) * FPS + 1e-6)) + 1) / FPS
    measured = np.flatnonzero(valid)
    middles = (time[measured][1:] + time[measured][:-1]) / 2
    nearest = measured[np.searchsorted(middles, at)]
    result, shot = values[nearest].astype(np.float32), np.full(len(at), -1)
    breaks = (np.diff(segment[measured]) != 0) | (np.diff(time[measured]) > LONGEST_BRIDGE_S)
    for number, run in enumerate(np.split(measured, np.flatnonzero(breaks) + 1)):
        if len(run) < 2:
            continue
        inside = (at >= time[run[0]] - 1e-6) & (at <= time[run[-1]] + 1e-6)
        result[inside] = PchipInterpolator(time[run], values[run], axis=0)(at[inside])
        shot[inside] = number
    # Of 60 frames a second a cut takes one, and the motion's frames may lie on those before and behind it: side by side
    # they would be learned from as one movement.
    meet = (shot[1:] != shot[:-1]) & (shot[:-1] >= 0)
    return start_s, result, (shot >= 0) & ~np.append(False, meet)
