"""Focal length, its uncertainty and the time it takes: `python -m benchmarks.camera [VIDEO ...]`.

One line a clip: first the rendered heads of the shared data, where the truth is known, then the videos named.
Beside them the error of the bundle's head rotations, their constant difference removed.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.ground_truth import GroundTruth
from benchmarks.track_errors import rotation_error
from personalize.container import probe
from personalize.face_reading import read_face
from personalize.ingest import find_usable
from tracker.camera import estimate_camera
from tracker.head import HeadModel, load_head
from tracker.track import Bundle, Camera


def measure(path: Path, head: HeadModel) -> tuple[Camera, Bundle, float]:
    """Camera and bundle of one video, and the seconds that the camera stage took."""
    info = probe(path)
    frames, _ = find_usable(info)
    landmarks, _, features = read_face(path, frames)
    start = time.perf_counter()
    camera, bundle = estimate_camera(
        landmarks, features, head, frames.seen, frames.segment, recorded_mm=info.focal_mm
    )
    return camera, bundle, time.perf_counter() - start


def line(path: Path, camera: Camera, bundle: Bundle, seconds: float, truth: GroundTruth | None) -> str:
    """One row of the table."""
    long_side = max(camera.size)
    row = (
        f"{path.stem:>28} {camera.method:>7} {camera.focal_px / long_side:8.3f} {camera.focal_sd_log:7.3f} "
        f"{len(bundle.frame):7d} {len(bundle.points):7d} {seconds:7.1f}"
    )
    if truth is None:
        return row
    found = Rotation.from_rotvec(bundle.rotation).as_matrix()
    error = rotation_error(found, truth.rotation[bundle.frame]) if len(found) else np.nan
    return row + f" {truth.focal / long_side:8.3f} {camera.focal_px / truth.focal - 1:+7.1%} {error:9.2f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("videos", nargs="*", type=Path, metavar="VIDEO")
    videos = parser.parse_args().videos
    head = load_head()
    shared = Path(os.environ.get("PERSONALIZE_SHARED", Path(__file__).parents[2] / "shared"))
    rendered = sorted((shared / "data" / "gt").glob("*.mp4"))
    print(
        f"{'clip':>28} {'method':>7} {'f / long':>8} {'sd log':>7} {'frames':>7} {'points':>7} {'took s':>7} "
        f"{'truth':>8} {'error':>7} {'rot. deg':>9}"
    )
    for path in [*rendered, *videos]:
        truth = GroundTruth.load(path.with_suffix(".npz")) if path in rendered else None
        print(line(path, *measure(path, head), truth), flush=True)


if __name__ == "__main__":
    main()
