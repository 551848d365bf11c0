"""quality.csv: one row a frame, so that a person or a program can see which frames to distrust."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from personalize.files import write_text
from personalize.shots import REASONS, Frames
from tracker.confidence import from_above_deg
from tracker.refine import Refined
from tracker.track import F32, Track

COLUMNS = (
    *("frame", "time_s", "valid", "confidence", "reprojection_px", "photometric", "lip_gap_mm"),
    *("yaw_deg", "pitch_deg", "roll_deg", "reason"),
)
# Of what is between the lips (see tracker.lip_opening): 2 to 16 % in films and clips that are well lit.
LIKE_LIPS = 0.2
# See tracker.lip_lines: sharp clips have .13 and more, a face of 50 px between the eyes .09, blurred ones .07 to .08.
FINE = 0.083
# How high the camera stands in the median frame. From about here on openings err by twice what is usual, too narrow.
FROM_ABOVE_DEG = 13.0
COVERED_OFTEN = 0.2  # of the frames that show the face: gestures cover fewer
FACING_CAMERA = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def head_angles(rotation: NDArray[np.float32]) -> NDArray[np.float64]:
    """Yaw, pitch, roll [T, 3] in degrees of axis-angle head rotations [T, 3]; zero faces the camera upright.

    Yaw is positive when the subject turns to their left, pitch when the head goes back, roll when it leans to
    the subject's left shoulder.
    """
    turned = FACING_CAMERA.inv() * Rotation.from_rotvec(rotation)
    angles: NDArray[np.float64] = turned.as_euler("YXZ", degrees=True)
    return angles * np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class LeftOut:
    """A stretch of frames left out for one reason: from its first frame to the end of its last, s."""

    start_s: float
    end_s: float
    reason: str


def frame_reasons(frames: Frames, track: Track, doubts: Sequence[str], least: float) -> list[str]:
    """Why each frame is left out; `ok` where it is used, to learn from and to be judged by.

    Ingest's reason, `no_face` where nothing was fitted, or below the `least` confidence what speaks against the fit
    (`doubts`, see tracker.confidence.judge). This is the one place that decides; quality.csv carries it on.
    """
    known = (frames.reasons[index] for index in frames.reason)
    return [
        reason if reason != "ok" else "no_face" if not valid else "ok" if sure >= least else doubt
        for reason, valid, doubt, sure in zip(known, track.valid, doubts, track.confidence)
    ]


def lip_warnings(refined: Refined) -> list[str]:
    """What the person should know of how well the openings are read."""
    texts = []
    if refined.like_lips > LIKE_LIPS:
        texts.append(
            f"the inside of the mouth hardly differs in colour from the lips ({refined.like_lips:.0%} of it looks like "
            "them): lip openings may be measured half a millimetre to a millimetre off; film in better light, sharper, "
            "or compressed less"
        )
    if refined.fineness < FINE:
        texts.append(
            "the face is out of focus, or its details are lost otherwise: lip openings may be measured one or two "
            "millimetres too wide; focus on the face, clean the lens, film closer"
        )
    seen = refined.track.valid
    above = float(np.median(from_above_deg(refined.track)[seen])) if seen.any() else 0.0
    if above > FROM_ABOVE_DEG and np.isfinite(refined.fineness):
        texts.append(
            f"the face is filmed from above, by some {above:.0f} degrees: lip openings may be measured a tenth to a "
            "third too narrow; film from the height of the eyes or from below"
        )
    return texts


def cover_warnings(reasons: NDArray[np.str_]) -> list[str]:
    """What the person should know of a face that is covered for long. reasons: [T], of quality.csv."""
    shown = ~np.isin(reasons, REASONS[1:])
    covered = (reasons == "occluded").sum() / max(shown.sum(), 1)
    if covered < COVERED_OFTEN:
        return []
    return [
        f"something covers mouth, cheek or eye in {covered:.0%} of the frames that show the face (a hand, a "
        "microphone, a mask): these are left out, and in others it may still hide part of the mouth; film the face "
        "uncovered"
    ]


def read_reasons(path: Path) -> NDArray[np.str_]:
    """The reason of each frame [T], from quality.csv."""
    with path.open(newline="", encoding="utf-8") as stream:
        return np.array([row["reason"] for row in csv.DictReader(stream)])


def left_out(time: NDArray[np.float64], reasons: NDArray[np.str_]) -> list[LeftOut]:
    """The stretches of frames [T] that are not `ok`, in order."""
    ends = np.append(time[1:], time[-1] + (np.median(np.diff(time)) if len(time) > 1 else 0.0))
    first = np.flatnonzero(np.append(True, reasons[1:] != reasons[:-1]))
    last = np.append(first[1:], len(reasons)) - 1
    return [
        LeftOut(float(time[a]), float(ends[b]), str(reasons[a]))
        for a, b in zip(first, last)
        if reasons[a] != "ok"
    ]


def write_quality(path: Path, track: Track, reasons: Sequence[str], photometric: F32) -> None:
    """Write the table. photometric: [T], 1 in a usual frame of the clip, NaN and then empty where not compared."""
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
                "" if np.isnan(photometric[frame]) else f"{photometric[frame]:.3f}",
                f"{track.lip_gap_mm[frame]:.3f}",
                *(f"{angle:.2f}" for angle in angles[frame]),
                reasons[frame],
            ]
        )
    write_text(path, stream.getvalue())
