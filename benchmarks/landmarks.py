"""Steady landmarking time per frame: `python -m benchmarks.landmarks VIDEO ...`.

One line a video and number of threads: milliseconds a frame for decoding and for landmarking, with the first
frame, which is searched, left out, and the worst frame.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from personalize.pictures import FrameReader
from tracker.landmarker import FaceLandmarker, LandmarkTracker

FRAMES = 150


def measure(video: Path, threads: int) -> tuple[float, float, float, int]:
    """Milliseconds a frame to decode and to landmark (medians), the longest, and frames with a face."""
    tracker = LandmarkTracker(FaceLandmarker(threads))
    decoding, landmarking, faces = [], [], 0
    before = time.perf_counter()
    for index, (_, rgb) in enumerate(FrameReader(video)):
        decoded = time.perf_counter()
        faces += tracker.next(rgb) is not None
        after = time.perf_counter()
        decoding.append(1e3 * (decoded - before))
        landmarking.append(1e3 * (after - decoded))
        before = after
        if index == FRAMES:
            break
    return float(np.median(decoding)), float(np.median(landmarking[1:])), max(landmarking[1:]), faces


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("videos", nargs="*", type=Path, metavar="VIDEO")
    videos = parser.parse_args().videos
    print(f"{'video':40} {'threads':>7} {'decode ms':>9} {'landmarks ms':>12} {'worst ms':>8} {'faces':>5}")
    for video in videos:
        for threads in (1, 2):
            decode, landmarks, worst, faces = measure(video, threads)
            print(f"{video.name:40} {threads:7} {decode:9.1f} {landmarks:12.1f} {worst:8.1f} {faces:5}")


if __name__ == "__main__":
    main()
