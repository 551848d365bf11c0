"""Error of the tracker where the truth is known: `python -m benchmarks tracking [NAME | VIDEO ...]`.

person    the embedded head itself as noisy landmarks, true focal: lower bounds, since truth and fit share the head
inside    a film of the embedded head
own       films of heads that the model cannot imitate (benchmarks/rendered_heads.py), made once and kept
unseen    six such films drawn by lot (benchmarks/strangers.py), by which no method and no constant is chosen
shared    rendered scan heads of the shared data ($PERSONALIZE_SHARED), where it is at hand

Films go through the pipeline's own stages: usable frames, landmarks, camera, fit. NAMEs (`hand`, `person1`) choose
clips; `stranger101` and up draw `further` ones, by which methods may be chosen; for a VIDEO only consistency can be
told. With --lens every camera wrote its focal length down, as far off as the tracker takes it to be; with --enlarged
two of five seconds of every film are enlarged by 1.3, as editors do it.
At the end: the numbers wanted, and whether they are reached, in all and by group.

surf, mean      distance of the neutral face from the true surface after one similarity; of the mean head's, mm
face, rigid     face vertices, neutral and motion, after one similarity a clip and after one rigid transform, mm
lips, plane, depth      lip vertices about their mean over time: in all, in the face's plane, in depth, mm
neutr           lip vertices against the neutral, mm
r, rmse, about  lip opening: correlation, RMSE, RMSE about its mean, mm
rot, focal      head rotation without the constant, degrees; focal length, %
lids, gaze      how far lids are apart, RMSE about its mean, mm; where the eyes look, without the constant, degrees
jitter, still   second difference of the lips' error; face vertices' rms on a clip where nothing moves, mm
close, false    share of the lips' closures reached within one frame; of the fitted ones, upon open lips
auc             how often a frame whose lips are hidden, behind a hand or in profile, has less confidence than others
back            frames until the fit recovers from a hand, a fast turn or a turn aside
lost            share of the frames with bare lips that have no fit, and so count in no error but `back`, %
out, kept       share of those that have a fit which is left out by default; of the hidden ones that are used, %
ms, cpu         time a frame of all stages up to here, from the search for usable frames on: on the clock,
                and of all processors
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.enlarged import enlarged
from benchmarks.films import film
from benchmarks.ground_truth import GroundTruth
from benchmarks.in_model import noisy_landmarks
from benchmarks.real_tracks import agreement, eye_distance, raw_openings
from benchmarks.rendered_heads import SCENES
from benchmarks.strangers import number_of, strangers
from benchmarks.track_bars import Row, print_bars
from benchmarks.track_errors import compare
from personalize.container import probe
from personalize.face_reading import read_face
from personalize.ingest import find_usable
from personalize.pictures import FrameReader
from tracker.camera import FILM_MM, MIDDLE, MIDDLE_SD_LOG, estimate_camera
from tracker.confidence import bare, judge
from tracker.fit import fit_track
from tracker.head import HeadModel, load_head
from tracker.occlusion import Appearance
from tracker.refine import refine_track
from tracker.track import F32, F64, Bundle, Camera, Landmarks, Track

PERSONS, PERSON_FRAMES = 3, 500
COLUMNS = {
    "surf": "surface_mm",
    "mean": "mean_surface_mm",
    "face": "face_scaled_mm",
    "rigid": "face_rigid_mm",
    "lips": "lip_motion_mm",
    "plane": "lip_in_plane_mm",
    "depth": "lip_depth_mm",
    "neutr": "lip_neutral_mm",
    "r": "opening_r",
    "rmse": "opening_rmse_mm",
    "about": "opening_centred_mm",
    "rot": "rotation_deg",
    "focal": "focal_pct",
    "lids": "lids_mm",
    "gaze": "gaze_deg",
    "jitter": "jitter_mm",
    "still": "still_mm",
    "close": "closures",
    "false": "false_closures",
    "auc": "confidence_auc",
    "back": "recovery_frames",
    "lost": "lost_pct",
    "out": "left_out_pct",
    "kept": "kept_pct",
    "ms": "ms",
    "cpu": "cpu",
}
TIMES = ("ms", "cpu")
DECIMALS = (
    dict.fromkeys(("r", "jitter", "still"), 3)
    | dict.fromkeys(("focal", "lost", "out", "kept"), 1)
    | dict.fromkeys(("back", "ms", "cpu"), 0)
)
EMPTY = np.zeros((0, 3), np.float32)
NO_BUNDLE = Bundle(np.zeros(0, np.int32), EMPTY, EMPTY, EMPTY, np.zeros((0, 4), np.float32))


@dataclass(frozen=True)
class Clip:
    """What the fit works on. appearance, video: None without pictures. spent: [2] up to here, see `clock`."""

    landmarks: Landmarks
    camera: Camera
    bundle: Bundle
    usable: NDArray[np.bool_]
    segment: NDArray[np.int32]
    appearance: Appearance | None
    video: Path | None
    spent: F64


def clock() -> F64:
    """[2] ms: the time on the wall, and that of all processors."""
    return 1e3 * np.array([time.perf_counter(), time.process_time()])


def stages(clip: Clip, head: HeadModel) -> Iterator[tuple[str, Track, dict[str, float]]]:
    """The track after each stage, its name, and the time spent on the whole way there, ms a frame."""
    landmarks, camera, count = clip.landmarks, clip.camera, len(clip.usable)
    evidence = None if clip.appearance is None else bare(clip.appearance)
    start = clock()
    track = fit_track(landmarks, camera, head, clip.usable, clip.segment, evidence=evidence)
    spent = clip.spent + (clock() - start) / count
    yield "landmarks", judged(track, clip), dict(zip(TIMES, spent))
    if (video := clip.video) is not None:
        start = clock()
        refined = refine_track(
            *(track, landmarks, camera, clip.bundle, head, clip.segment, lambda: FrameReader(video)),
            evidence=evidence,
        )
        spent += (clock() - start) / count
        yield "refined", judged(refined.track, clip, refined.deviation), dict(zip(TIMES, spent))


def judged(track: Track, clip: Clip, deviation: F32 | None = None) -> Track:
    """The track with the confidence that the pictures leave it."""
    return track if clip.appearance is None else judge(track, clip.appearance, deviation)[0]


def watched(video: Path, head: HeadModel, recorded_mm: float = 0.0) -> Clip:
    """Usable frames, landmarks and camera of a film, as the pipeline finds them.

    recorded_mm: in the place of what the file tells of the lens, see `estimate_camera`.
    """
    start = clock()
    info = probe(video)
    frames, _ = find_usable(info)
    landmarks, appearance, features = read_face(video, frames)
    recorded_mm = recorded_mm or info.focal_mm
    camera, bundle = estimate_camera(
        landmarks, features, head, frames.seen, frames.segment, recorded_mm=recorded_mm
    )
    spent = (clock() - start) / len(frames.time)
    return Clip(landmarks, camera, bundle, frames.usable, frames.segment, appearance, video, spent)


def written_lens(truth: GroundTruth, video: Path, name: str) -> float:
    """mm on film 36 mm wide: what the camera of a clip might have written of its lens, too long or too short."""
    info = probe(video)
    off = MIDDLE_SD_LOG * (-1) ** sum(name.encode())
    return truth.focal / max(info.width, info.height) * FILM_MM / MIDDLE * float(np.exp(off))


def only_landmarks(landmarks: Landmarks, focal: float) -> Clip:
    """Landmarks under a known camera."""
    count, size = len(landmarks.time), landmarks.size
    camera = Camera(focal, 0.0, ((size[0] - 1) / 2, (size[1] - 1) / 2), (), size, "given", "")
    everywhere, one_shot = np.ones(count, bool), np.zeros(count, np.int32)
    return Clip(landmarks, camera, NO_BUNDLE, everywhere, one_shot, None, None, np.zeros(2))


def ground_truths(
    head: HeadModel, chosen: set[str], lens: bool = False, larger: bool = False
) -> Iterator[tuple[str, str, Clip, GroundTruth]]:
    """(group, name, clip, truth) of every clip, or of the chosen ones.

    lens: whether cameras wrote theirs down. larger: whether two of five seconds are enlarged.
    """
    for seed in range(PERSONS):
        if wanted(f"person{seed}", chosen):
            truth, landmarks = noisy_landmarks(head, PERSON_FRAMES, seed)
            yield "person", f"person{seed}", only_landmarks(landmarks, truth.focal), truth
    made = [
        *(("own" if scene.bend_mm else "inside", scene) for scene in SCENES if wanted(scene.name, chosen)),
        *strangers(chosen),
    ]
    films = ((group, scene.name, *film(scene, head)) for group, scene in made)
    scans = (
        ("shared", path.stem, path.with_suffix(".mp4"), GroundTruth.load(path))
        for path in scan_heads()
        if wanted(path.stem, chosen)
    )
    for group, name, video, truth in chain(films, scans):
        with edited(video, larger) as shown:
            yield group, name, watched(shown, head, written_lens(truth, video, name) if lens else 0.0), truth


def edited(video: Path, larger: bool) -> AbstractContextManager[Path]:
    """The video, or one of which two of five seconds are enlarged."""
    return enlarged(video) if larger else nullcontext(video)


def compile_ahead(head: HeadModel) -> None:
    """Have everything compiled that is compiled when it is first called, so that no clip's time holds it."""
    # Of a mouth that never opens no colours are read.
    shortest = min((scene for scene in SCENES if scene.speaks), key=lambda scene: scene.seconds)
    for _ in stages(watched(film(shortest, head)[0], head), head):
        pass


def scan_heads() -> list[Path]:
    """The truths of the shared data."""
    shared = Path(os.environ.get("PERSONALIZE_SHARED", Path(__file__).parents[2] / "shared"))
    return sorted((shared / "data/gt").glob("*.npz"))


def known_names() -> list[str]:
    """Of all clips."""
    persons = [f"person{seed}" for seed in range(PERSONS)]
    return [*persons, *(scene.name for scene in SCENES), *(path.stem for path in scan_heads())]


def wanted(name: str, chosen: set[str]) -> bool:
    """Whether a clip was chosen; without a choice all are."""
    return not chosen or name in chosen


def consistency(track: Track, landmarks: Landmarks) -> dict[str, float]:
    """Residual in % of the outer-eye distance, lip opening against the raw landmarks', gap when closed."""
    seen = track.valid
    raw = raw_openings(landmarks)
    gap = track.lip_gap_mm[seen]
    return {
        "reprojection_pct": 100 * float((track.reprojection_px / eye_distance(landmarks))[seen].mean()),
        "opening_r": agreement(track, raw, seen)[0],
        "gap_at_closure_mm": float(np.median(gap[raw[seen] <= np.quantile(raw[seen], 0.1)])),
        "gap_p95_mm": float(np.quantile(gap, 0.95)),
        "confidence": float(track.confidence[seen].mean()),
    }


def cell(column: str, value: float) -> str:
    """A figure, or a dot where there is none."""
    text = f"{value:.{DECIMALS.get(column, 2)}f}" if np.isfinite(value) else "."
    return f"{text:>{max(6, len(column) + 1)}}"


def main() -> None:
    """Print the table, and the numbers wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("clips", nargs="*", metavar="NAME | VIDEO")
    parser.add_argument("--lens", action="store_true", help="cameras wrote their focal lengths down")
    parser.add_argument(
        "--enlarged", action="store_true", help="two of five seconds of every film are enlarged"
    )
    options = parser.parse_args()
    named = options.clips
    videos = [Path(name) for name in named if Path(name).suffix]
    chosen = {name for name in named if not Path(name).suffix}
    if unknown := {name for name in chosen - set(known_names()) if number_of(name) is None}:
        parser.error(f"no clip {', '.join(sorted(unknown))}; there are {', '.join(known_names())}, strangerN")
    if not named and not scan_heads():
        print("without rendered scan heads: $PERSONALIZE_SHARED does not name a folder with data/gt")
    head, rows = load_head(), list[Row]()
    if videos or not named or not all(name.startswith("person") for name in chosen):
        compile_ahead(head)
    if chosen or not named:
        print(
            f"{'clip':16s} {'stage':10s}", *(f"{name:>{max(6, len(name) + 1)}}" for name in COLUMNS), sep=""
        )
        for group, name, clip, truth in ground_truths(head, chosen, options.lens, options.enlarged):
            for stage, track, spent in stages(clip, head):
                errors = compare(track, head, truth) | spent
                rows.append(Row(group, name, stage, errors))
                cells = (cell(column, errors.get(key, np.nan)) for column, key in COLUMNS.items())
                print(f"{name:16s} {stage:10s}", *cells, sep="", flush=True)
    for video in videos:
        with edited(video, options.enlarged) as shown:
            clip = watched(shown, head)
            for stage, track, spent in stages(clip, head):
                figures = consistency(track, clip.landmarks) | spent
                print(f"{video.stem} {stage}", *(f"{k} {v:.3f}" for k, v in figures.items()), flush=True)
    if rows:
        print_bars(rows)


if __name__ == "__main__":
    main()
