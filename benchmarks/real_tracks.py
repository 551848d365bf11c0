"""What can be told of tracks of real clips: `python -m benchmarks real_tracks RUN [RUN ...]`.

The runs must have come as far as `judge`. There is no truth: the landmarks' own opening (called raw below,
though what landmarks are known to err by is taken out) is what the eye would say first, and wrong in its own way.

used        frames in use, by quality.csv; all below is of these
r, slope    of the lip opening with the raw landmarks', of the landmark fit and refined
shut        the tenth of the frames whose raw lips are closest: median opening of the landmark fit and refined; of the
            latter what 95 % stay below, and the largest, mm
still       rms of the face's vertices in the head frame about straight lines over time, landmark fit and refined, mm,
            in the second in which the landmarks move least
back        frames after one out of use until the residual is below 1.5 times the clip's median again, at most
cuts        how many; residual in the second and the third frame after one, by the clip's median
beside      how far the re-rendered eyes, nose and mouth lie beside the picture's: median, 99 % and largest, mm, and
            when; in how many frames it is not found (`benchmarks/beside.py`)
plosives    words that begin with b, p or m, by WORDS.json beside the video (`words`: word, start s): how many of them
            have the fitted lips closed within one frame of the narrowest raw ones; for how many the middles of the
            closures, raw and fitted, differ by one frame at most; the narrowest fitted opening, median and 90 %, mm
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.beside import PARTS, shifts
from benchmarks.track_errors import CLOSED_MM, recovery_frames
from personalize import run as files
from personalize.quality import read_reasons
from personalize.run import RunFolder
from tracker.head import HeadModel, load_head
from tracker.landmark_indices import LEFT_EYE_OUTER, RIGHT_EYE_OUTER
from tracker.track import F64, Landmarks, Track

INNER_LIPS = (13, 14)  # upper and lower, in the middle
EYES_MM = 90.0  # between the outer corners of the eyes, about
AROUND_S = 0.16  # a word's first sound closes the lips so near to its start
PLOSIVES = tuple("bpm")
STILL_S = 1.0

Bool = NDArray[np.bool_]


def eye_distance(landmarks: Landmarks) -> F64:
    """[T] px between the outer corners of the eyes; NaN without a face."""
    return _apart(landmarks, LEFT_EYE_OUTER, RIGHT_EYE_OUTER)


def raw_openings(landmarks: Landmarks) -> F64:
    """[T] mm between the inner lips' middles, by the distance of the eyes; NaN without a face."""
    return EYES_MM * _apart(landmarks, *INNER_LIPS) / eye_distance(landmarks)


def _apart(landmarks: Landmarks, one: int, other: int) -> F64:
    """[T] px between two landmarks."""
    points = landmarks.points[..., :2].astype(np.float64)
    return np.asarray(np.linalg.norm(points[:, one] - points[:, other], axis=-1))


def agreement(track: Track, raw: F64, seen: Bool) -> tuple[float, float]:
    """Correlation of the track's opening with the raw ones [T] mm over the frames seen [T], and slope upon them."""
    gap = track.lip_gap_mm[seen]
    return float(np.corrcoef(raw[seen], gap)[0, 1]), float(np.polyfit(raw[seen], gap, 1)[0])


def stillest(points: F64, time: F64, seen: Bool, segment: NDArray[np.int32]) -> slice:
    """The frames of the second in which points [T, L, 2] move least, all of them seen [T] and in one shot; or none."""
    count = int(np.searchsorted(time, time[0] + STILL_S, side="right"))
    whole = [
        start
        for start in range(len(time) - count + 1)
        if seen[start : start + count].all() and segment[start] == segment[start + count - 1]
    ]
    if not whole:
        return slice(0, 0)
    start = min(whole, key=lambda first: about_lines(points[first : first + count]))
    return slice(start, start + count)


def about_lines(places: F64) -> float:
    """Rms of the distances of places [n, L, 2 or 3] from the straight lines over time that fit them best."""
    rows = places.reshape(len(places), -1)
    line = np.vander(np.arange(len(rows)), 2)
    rest = rows - line @ np.linalg.lstsq(line, rows, rcond=None)[0]
    return float(np.sqrt((rest.reshape(places.shape) ** 2).sum(-1).mean()))


def shaking(track: Track, head: HeadModel, frames: slice) -> float:
    """Rms of the face's vertices in the head frame about straight lines over some frames' time, mm."""
    vertices = head.vertices(track.identity, track.expression[frames], jaw=track.jaw[frames])
    return 1e3 * about_lines(vertices[:, head.regions["face"]].astype(np.float64))


def after_cuts(residual: F64, valid: Bool, segment: NDArray[np.int32]) -> tuple[float, float]:
    """Residual [T] in the second and third frame of each shot but the first, by the clip's median; NaN without."""
    starts = np.flatnonzero(np.diff(segment)) + 1
    usual = np.median(residual[valid])
    second, third = (starts + step for step in (1, 2))
    means = [
        float(residual[rows][valid[rows]].mean() / usual) if valid[rows].any() else np.nan
        for rows in (part[part < len(residual)] for part in (second, third))
    ]
    return means[0], means[1]


def closures(raw: F64, gap: F64, time: F64, valid: Bool, starts: list[float]) -> list[tuple[float, float]]:
    """Of each word that starts at a moment in use: how closed the lips are, and how far from when they should be.

    The narrowest gap [T] mm within a frame of the narrowest raw opening [T] mm; by how many frames the middles of both
    closures, the frames within CLOSED_MM of the narrowest, differ.
    """
    found = []
    for start in starts:
        rows = np.flatnonzero(np.abs(time - start) < AROUND_S)
        if not len(rows) or not (valid[rows] & np.isfinite(raw[rows])).all():
            continue
        narrowest = rows[raw[rows].argmin()]
        middles = [np.flatnonzero(curve < curve.min() + CLOSED_MM).mean() for curve in (raw[rows], gap[rows])]
        near = gap[max(narrowest - 1, 0) : narrowest + 2].min()
        found.append((float(near), abs(float(middles[1] - middles[0]))))
    return found


def mesh_on_picture(beside: F64, time: F64, used: Bool) -> list[str]:
    """How far the PARTS [T, 4] mm of the mesh lie beside the picture's in the frames used [T], in words."""
    lines = []
    for part, apart in zip(PARTS, beside[used].T):
        told = "not told"
        if np.isfinite(apart).any():
            median, most, largest = np.nanquantile(apart, (0.5, 0.99, 1.0))
            when = time[used][np.nanargmax(apart)]
            told = f"{median:.2f}, 99 % {most:.2f}   largest {largest:.2f} at {when:.2f} s"
        lines.append(f"beside {part} {told}   not found {np.isnan(apart).sum()}")
    return lines


def plosive_starts(words: Path) -> list[float]:
    """Starts in s of the words that begin with b, p or m."""
    listed = json.loads(words.read_text(encoding="utf-8"))["words"]
    return [float(entry["start"]) for entry in listed if entry["word"].lower().startswith(PLOSIVES)]


def report(folder: Path) -> list[str]:
    """The lines of one run."""
    run = RunFolder.open(folder)
    landmarks = files.read_landmarks(folder / "landmarks/landmarks.npz")
    segment = files.read_frames(folder / "ingest/frames.npz").segment
    fits = {name: files.read_track(folder / name / "track.npz") for name in ("track", "refine")}
    raw, refined, head = raw_openings(landmarks), fits["refine"], load_head()
    if refined.head != f"{head.name}@{head.sha256}":
        raise SystemExit(f"{folder}: tracked with {refined.head}; only runs of the embedded head are judged")
    used = read_reasons(folder / "refine/quality.csv") == "ok"
    seen = used & np.isfinite(raw)
    gap = refined.lip_gap_mm.astype(np.float64)
    shut = seen & (raw <= np.quantile(raw[seen], 0.1))
    medians = [float(np.median(fit.lip_gap_mm[shut])) for fit in fits.values()]
    agreements = [agreement(fit, raw, seen) for fit in fits.values()]
    lines = [
        f"{folder.stem}: used {used.sum()} of {len(raw)}",
        "  r {:.3f}, {:.3f}   slope {:.2f}, {:.2f}".format(*np.transpose(agreements).ravel()),
        "  shut {:.2f}, {:.2f}   95 % {:.2f}   largest {:.2f}".format(
            *medians, *np.quantile(gap[shut], (0.95, 1.0))
        ),
    ]
    points = landmarks.points[..., :2] / eye_distance(landmarks)[:, None, None]
    if (calm := stillest(points, refined.time, seen, segment)).stop:
        lines.append("  still {:.3f}, {:.3f}".format(*(shaking(fit, head, calm) for fit in fits.values())))
    error = np.where(refined.valid, refined.reprojection_px, np.inf).astype(np.float64)
    if np.isfinite(back := recovery_frames(error, ~used)):
        lines.append(f"  back {back:.0f}")
    if cuts := np.count_nonzero(np.diff(segment)):
        residual = refined.reprojection_px.astype(np.float64)
        lines.append("  cuts {}: {:.2f}, {:.2f}".format(cuts, *after_cuts(residual, used, segment)))
    lines += [f"  {line}" for line in mesh_on_picture(shifts(run, head, used), refined.time, used)]
    words = run.video.with_suffix(".words.json")
    if words.is_file() and (found := closures(raw, gap, refined.time, seen, plosive_starts(words))):
        near, apart = np.transpose(found)
        median, most = np.quantile(near, (0.5, 0.9))
        lines.append(
            f"  plosives {(near < CLOSED_MM).sum()} of {len(near)} closed   middles {(apart <= 1).sum()}"
            f"   narrowest {median:.2f}, 90 % {most:.2f}"
        )
    return lines


def main() -> None:
    """Print what can be told of each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    for folder in parser.parse_args().runs:
        print(*report(folder), sep="\n", flush=True)


if __name__ == "__main__":
    main()
