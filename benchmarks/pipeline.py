"""The whole command on videos, as a user runs it: `python -m benchmarks pipeline VIDEO ... [--out DIR]`.

Seconds a stage, milliseconds a frame of the two that the tracker's speed is judged by, the total, the peak memory of
the command's process, and whether the lips follow the picture: Pearson r of the track's lip opening with the raw 2D one
(points 13 and 14 over the distance between the eyes). A stage that was cached shows the seconds of when it was made.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.real_tracks import agreement, raw_openings
from personalize.pipeline import STAGES
from personalize.run import RunFolder, read_landmarks, read_track


def lip_opening_r(run: Path) -> float:
    """Correlation of `lip_gap_mm` with the landmarks' own opening, over the tracked frames."""
    track = read_track(run / "refine/track.npz")
    raw = raw_openings(read_landmarks(run / "landmarks/landmarks.npz"))
    return agreement(track, raw, track.valid)[0]


def main() -> None:
    """Run and print, one video after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("videos", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, help="keeps the run folders there, and continues them")
    parser.add_argument("--iterations", type=int, help="instead of the command's default")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for video in arguments.videos:
            run = (arguments.out or Path(folder)) / f"{video.stem}.personalize"
            command = [sys.executable, "-m", "cli.main", "run", str(video), "--out", str(run)]
            if arguments.iterations:
                command += ["--iterations", str(arguments.iterations)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            report(video, run)


def report(video: Path, run: Path) -> None:
    """The table of one video."""
    entries = RunFolder.open(run).stages
    seconds = {stage.name: float(entries[stage.name]["seconds"]) for stage in STAGES}
    frames = len(read_track(run / "refine/track.npz").time)
    peak_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024**2
    print(f"\n{video.name}: {frames} frames")
    for name, took in seconds.items():
        print(f"  {name:<14}{took:8.1f} s{1e3 * took / frames:10.1f} ms/frame")
    print(f"  {'total':<14}{sum(seconds.values()):8.1f} s = {sum(seconds.values()) / 60:.1f} min")
    print(f"  peak memory of the largest run so far {peak_gb:.2f} GB")
    print(f"  lip opening against raw 2D: r = {lip_opening_r(run):.4f}", flush=True)


if __name__ == "__main__":
    main()
