"""Refine a clip's landmark track by the grey levels of the skin, in bounded memory: one stretch at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tracker.fit import make_track, resume, runs, smoothness_between, trusted
from tracker.rigid_pose import hold_poses
from tracker.skin_fit import Photometry, Subject, fit_stretch, learn_levels
from tracker.track import F32, F64, Bundle, Camera, Landmarks, Track
from tracker.view import U8, Index

if TYPE_CHECKING:
    from tracker.head import HeadModel

KEYS = 48  # frames, spread over the clip, that tell the albedo
STRETCH, OVERLAP = 120, 8  # frames solved at once, and how many more on both sides belong to the neighbours
HALFWAY = 0.5  # to the bundle's poses: grey levels err as much, but slowly, and the tracks at random
HELD_BYTES = 256 << 20  # of cut-out faces, about 100 s of them; a longer clip is read twice instead
Frame = tuple[float, U8]


@dataclass(frozen=True)
class Refined:
    """A track, and how far its skin is from what it should look like.

    deviation: [T, 2] mean deviation of the grey levels, of all skin and of the mouth's, 1 in the clip's median; NaN
    where nothing was compared.
    """

    track: Track
    deviation: F32


def refine_track(
    track: Track,
    landmarks: Landmarks,
    camera: Camera,
    bundle: Bundle,
    head: HeadModel,
    segment: NDArray[np.int32],
    frames: Callable[[], Iterable[Frame]],
    progress: Callable[[int, int], None] | None = None,
    photometry: Photometry | None = None,
    evidence: F32 | None = None,
) -> Refined:
    """Expression, pose and gaze of the valid frames again, with the pictures; identity and camera stay.

    segment: [T], number of the uninterrupted shot. frames: begins the clip anew: (time s, rgb [H, W, 3] u8), one for
    each row of the landmarks; a long clip's are read twice. A frame whose skin does not come nearer to what it should
    look like keeps its landmark fit, and so does one whose picture is missing. bundle, evidence: see `fit_track`; poses
    end halfway between what the grey levels and the bundle tell.
    What it gains is printed by `python -m benchmarks tracking`: pose and jitter mostly; the lips' openings are left
    to the landmarks, see `Photometry.pair_noise_mm`.
    """
    photometry = photometry or Photometry()
    energy, x, observed, good = resume(track, landmarks, camera, head, evidence)
    unknown = np.full((len(track.time), 2), np.nan, np.float32)
    if not len(good):
        return Refined(track, unknown)
    subject = Subject.of(head, track.identity, energy, photometry)
    keys, cuts = _looked_at(subject, camera, frames, good)
    if not keys:
        return Refined(track, unknown)
    rows = np.array(list(keys))
    levels = learn_levels(subject, list(keys.values()), rows, x[rows])
    deviation = np.full((len(good), 2), np.nan)
    refined = x.copy()
    for start, part in _stretches(cuts, len(good)):
        rows = np.array(list(part))
        smoothness = smoothness_between(energy, landmarks.time, good[rows], segment, photometry.smoothness)
        found, before, after = fit_stretch(subject, levels, list(part.values()), rows, x[rows], smoothness)
        better = np.isfinite(found).all(1) & (after[:, 0] < before[:, 0])
        own = (rows >= start) & (rows < start + STRETCH)
        refined[rows[own & better]] = found[own & better]
        deviation[rows[own]] = np.where(better[:, None], after, before)[own]
        if progress:
            progress(min(start + STRETCH, len(good)), len(good))
    if camera.method != "prior":
        refined = hold_poses(refined, bundle, good, runs(good, segment), trusted(evidence, good), HALFWAY)
    out = make_track(
        landmarks, camera, head, energy, observed, track.identity.astype(np.float64), refined, good
    )
    return Refined(out, _relative(deviation, good, len(track.time)))


def _looked_at(
    subject: Subject, camera: Camera, frames: Callable[[], Iterable[Frame]], good: Index
) -> tuple[dict[int, U8], Iterable[tuple[int, U8]]]:
    """Rows and cut-out faces of the key frames, and of all frames `good`; a short clip's pictures are read once."""
    keys, rows = np.unique(np.linspace(0, len(good) - 1, KEYS).round().astype(int)), np.arange(len(good))
    if len(good) * subject.window.size[0] * subject.window.size[1] > HELD_BYTES:
        chosen = dict(_cuts(subject, camera, frames(), good[keys], keys))
        return chosen, _cuts(subject, camera, frames(), good, rows)
    held = dict(_cuts(subject, camera, frames(), good, rows))
    return {row: held[row] for row in keys.tolist() if row in held}, held.items()


def _cuts(
    subject: Subject, camera: Camera, frames: Iterable[Frame], wanted: Index, rows: Index
) -> Iterator[tuple[int, U8]]:
    """Row and cut-out face of each frame wanted [n], in order. rows: [n] of the subject's windows."""
    row_of = dict(zip(wanted.tolist(), rows.tolist()))
    for frame, (_, rgb) in enumerate(frames):
        if frame in row_of:
            yield row_of[frame], subject.window.cut(camera.lens.picture(rgb), row_of[frame])


def _stretches(cuts: Iterable[tuple[int, U8]], total: int) -> Iterator[tuple[int, dict[int, U8]]]:
    """First row of each stretch, and the cut-outs of it and of the frames that it overlaps."""
    held: dict[int, U8] = {}
    start = 0
    for row, cut in cuts:
        held[row] = cut
        if row + 1 >= min(start + STRETCH + OVERLAP, total):
            yield start, held
            start += STRETCH
            held = {row: cut for row, cut in held.items() if row >= start - OVERLAP}
    if any(row >= start for row in held):
        yield start, held


def _relative(deviation: F64, good: Index, total: int) -> F32:
    """[T, 2] times the median, of deviations [n, 2] of the frames `good`."""
    out = np.full((total, 2), np.nan, np.float32)
    if np.isfinite(deviation).any():
        out[good] = deviation / np.maximum(np.nanmedian(deviation, axis=0), 1e-9)
    return out
