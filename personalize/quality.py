"""quality.csv: one row a frame, so that a person or a program can see which frames to distrust."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from personalize.files import write_text
from personalize.shots import Frames
from tracker.track import F32, Track

COLUMNS = (
    *("frame", "time_s", "valid", "confidence", "reprojection_px", "photometric", "lip_gap_mm"),
    *("yaw_deg", "pitch_deg", "roll_deg", "reason"),
)
FACING_CAMERA = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def head_angles(rotation: NDArray[np.float32]) -> NDArray[np.float64]:
    """Yaw, pitch, roll [T, 3] in degrees of axis-angle head rotations [T, 3]; zero faces the camera upright.

    Yaw is positive when the subject turns to their left, pitch when the head goes back, roll when it leans to
    the subject's left shoulder.
    """
    turned = FACING_CAMERA.inv() * Rotation.from_rotvec(rotation)
    angles: NDArray[np.float64] = turned.as_euler("YXZ", degrees=True)
    return angles * np.array([1.0, -1.0, -1.0])


def frame_reason(frames: Frames, track: Track, frame: int) -> str:
    """Why a frame is left out; `ok` when it is used."""
    if track.valid[frame]:
        return "ok"
    reason = frames.reasons[frames.reason[frame]]
    return reason if reason != "ok" else "no_face"


def write_quality(path: Path, track: Track, frames: Frames, photometric: F32 | None = None) -> None:
    """Write the table. photometric: [T], 1 in a usual frame of the clip, NaN and then empty where not compared."""
    compared = np.full(len(track.time), np.nan, np.float32) if photometric is None else photometric
    stream = io.StringIO()
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(COLUMNS)
    # A tracker with a neck joint turns the head by it too.
    turned = Rotation.from_rotvec(track.rotation) * Rotation.from_rotvec(track.neck)
    angles = head_angles(turned.as_rotvec().astype(np.float32))
    for frame, time in enumerate(track.time):
        table.writerow(
            [
                frame,
                f"{time:.4f}",
                int(track.valid[frame]),
                f"{track.confidence[frame]:.3f}",
                f"{track.reprojection_px[frame]:.3f}",
                "" if np.isnan(compared[frame]) else f"{compared[frame]:.3f}",
                f"{track.lip_gap_mm[frame]:.3f}",
                *(f"{angle:.2f}" for angle in angles[frame]),
                frame_reason(frames, track, frame),
            ]
        )
    write_text(path, stream.getvalue())
