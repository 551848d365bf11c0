"""Refine a clip's landmark track by its pictures: openings by colours, identity and then all frames by grey levels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tracker.energy import landmark_model
from tracker.fit import at_rest, make_track, resume, runs, smoothness_between, trusted, with_lips_shut
from tracker.irises import EyeWindows, iris_shifts
from tracker.key_frames import key_frames
from tracker.lip_flow import LipFlow
from tracker.lip_lines import LipLines, fineness
from tracker.lip_motion import along_lines, links, steadied
from tracker.lip_opening import lip_edges
from tracker.rigid_pose import hold_poses, turned_as_far
from tracker.skin_fit import Level, Subject, fit_landmarks, fit_stretch, learn_levels
from tracker.skin_identity import fit_identity_to_skin, nearer_to_skin
from tracker.threads import side_by_side
from tracker.track import F32, F64, Bundle, Camera, Landmarks, Track
from tracker.view import U8, Index

if TYPE_CHECKING:
    from tracker.head import HeadModel

# Frames that tell the albedo, half as many the identity: so many at least and at most, and no more than one of
# KEYS_APART, since each costs as much as three fits.
KEYS, KEYS_APART = (12, 48), 5
# Frames solved at once, and how many more on both sides belong to the neighbours: for so long a time, and so many
# at least, no more than are solved.
STRETCH, OVERLAP, OVERLAP_S = 120, 8, 0.32
HALFWAY = 0.5  # to the bundle's poses: grey levels err as much, but slowly, and the tracks at random
HELD_BYTES = 256 << 20  # of cut-out faces, about 100 s of them; a longer clip is read twice instead
Frame = tuple[float, U8]


@dataclass(frozen=True)
class Refined:
    """A track, and what speaks against it.

    deviation: [T, 2] mean deviation of the grey levels, of all skin and of the mouth's, 1 in the clip's median; NaN
    where nothing was compared. like_lips: see `lip_edges`; fineness: of the lips, see `tracker.lip_lines.fineness`; NaN
    where no colours were read.
    """

    track: Track
    deviation: F32
    like_lips: float = np.nan
    fineness: float = np.nan


@dataclass(frozen=True)
class Details:
    """What is kept of all pictures, by rows: colours along the lines across the mouth, and greys of the eyes.

    flow: follows the mouth from one look to the next.
    """

    lines: LipLines
    flow: LipFlow
    eyes: EyeWindows
    colours: dict[int, U8] = field(default_factory=dict)
    greys: dict[int, U8] = field(default_factory=dict)

    def look(self, rgb: U8, row: int) -> None:
        """At the picture [H, W, 3] of a row."""
        self.colours[row] = self.lines.read(rgb, row)
        self.flow.look(rgb, row)
        self.greys[row] = self.eyes.read(rgb, row)


def refine_track(
    track: Track,
    landmarks: Landmarks,
    camera: Camera,
    bundle: Bundle,
    head: HeadModel,
    segment: NDArray[np.int32],
    frames: Callable[[], Iterable[Frame]],
    progress: Callable[[int, int], None] | None = None,
    evidence: F32 | None = None,
) -> Refined:
    """Identity, and expression, pose and gaze of the valid frames again, with the pictures; the camera stays.

    segment: [T], number of the uninterrupted shot. frames: begins the clip anew: (time s, rgb [H, W, 3] u8), one for
    each row of the landmarks; a long clip's are read twice. A frame whose skin does not come nearer to what it should
    look like keeps its landmark fit, and so does one whose picture is missing. bundle: its poses, turned as far as
    they and the landmarks tell together, are taken where skin looks as much alike from frame to frame under them,
    in part where it hardly looks less so; after the grey levels they go half of that way once more.
    evidence: see `fit_track`.
    What it gains is printed by `python -m benchmarks tracking`: openings by the colours between the lips and by how the
    lips move (tracker/lip_opening.py, tracker/lip_motion.py, tracker/lip_flow.py), depth by how the skin shifts in a
    turn (tracker/skin_identity.py), gaze by the irises (tracker/irises.py), pose and
    jitter by the grey levels of the skin.
    """
    energy, x, observed, good = resume(track, landmarks, camera, head, evidence)
    unknown = np.full((len(track.time), 2), np.nan, np.float32)
    if not len(good):
        return Refined(track, unknown)
    sound = trusted(evidence, good)
    subject = Subject.of(head, track.identity, energy, observed, camera.lens.ends(camera.size, good))
    lines = LipLines.across(observed, energy.px_per_m, x)
    count = int(np.clip(len(sound) // KEYS_APART, *KEYS))
    usual = sound[np.linspace(0, len(sound) - 1, count).round().astype(int)]
    keys = key_frames(observed[sound], energy.px_per_m[sound], count // 2).of(sound)
    run, time = runs(good, segment, landmarks.time), landmarks.time[good]
    apart = links(time)
    details = Details(lines, LipFlow(lines, {apart[0], apart[-1]}), EyeWindows.of(observed, energy.px_per_m))
    held, cuts = _looked_at(subject, details, camera, frames, good, {*usual, *keys.rows})
    rows = np.array([row for row in held if row in usual], np.int64)
    if not len(rows):
        return Refined(track, unknown)
    bundle = turned_as_far(bundle, x, good, sound, camera.focal_sd_log)
    middle = energy.model.upper_face.mean(0)
    on_bundle = hold_poses(x, bundle, good, run, time, sound, middle)
    rigid = nearer_to_skin(subject, held, rows, x, on_bundle)
    x = hold_poses(x, bundle, good, run, time, sound, middle, rigid)
    widths, like_lips = _read_widths(details, good, segment, landmarks.time, sound)
    opened = lines.opened(observed, lines.widths(_fitted(subject, observed, x)) if widths is None else widths)
    subject = _with_landmarks(subject, opened, x, sound)
    identity = fit_identity_to_skin(subject, held, keys, x)
    if widths is not None or (identity != track.identity).any():
        subject = subject.with_identity(identity)
        smoothness = smoothness_between(subject.energy, landmarks.time, good, segment)
        x = fit_landmarks(subject, x, smoothness)
        x = hold_poses(x, bundle, good, run, time, sound, middle, rigid)
    levels = learn_levels(subject, [held[row] for row in rows], rows, x[rows])
    refined, deviation = _fitted_to_skin(subject, levels, cuts, x, good, segment, landmarks.time, progress)
    refined = hold_poses(refined, bundle, good, run, time, sound, middle, HALFWAY * rigid)
    looking = _with_irises(details, opened, sound)
    out = make_track(landmarks, camera, head, subject.energy, looking, identity, refined, good)
    fine = fineness(np.stack([details.colours[row] for row in rows]))
    return Refined(out, _relative(deviation, good, len(track.time)), like_lips, fine)


def _fitted_to_skin(
    subject: Subject,
    levels: list[Level],
    cuts: Iterable[tuple[int, U8]],
    x: F64,
    good: Index,
    segment: NDArray[np.int32],
    time: F64,
    progress: Callable[[int, int], None] | None,
) -> tuple[F64, F64]:
    """x [n, U] by grey levels where they bring the skin nearer to what it should look like; deviation [n, 2].

    cuts: cut-out faces by rows, in order. good: [n], the rows' frames. segment, time: see `_read_widths`.
    """
    refined, deviation = x.copy(), np.full((len(x), 2), np.nan)

    def fitted(stretch: tuple[int, dict[int, U8]]) -> tuple[int, Index, F64, F64, F64]:
        start, part = stretch
        rows = np.array(list(part))
        smoothness = smoothness_between(subject.energy, time, good[rows], segment, subject.smoothness)
        return start, rows, *fit_stretch(subject, levels, list(part.values()), rows, x[rows], smoothness)

    stretches = _stretches(cuts, len(x), _overlap(time[good]))
    for start, rows, found, before, after in side_by_side(fitted, stretches):
        better = np.isfinite(found).all(1) & (after[:, 0] < before[:, 0])
        own = (rows >= start) & (rows < start + STRETCH)
        refined[rows[own & better]] = found[own & better]
        deviation[rows[own]] = np.where(better[:, None], after, before)[own]
        if progress:
            progress(min(start + STRETCH, len(x)), len(x))
    return refined, deviation


def _read_widths(
    details: Details, good: Index, segment: NDArray[np.int32], time: F64, sound: Index
) -> tuple[F64 | None, float]:
    """[n, Q] mm between the lips, of the colours along the lines; None where they do not tell it; `like_lips`.

    Rows without colours keep the landmarks' widths, and lips are not followed across them. good: [n], the rows' frames.
    segment: [T], number of the uninterrupted shot. time: [T] s. sound: rows that are believed.
    """
    colours, marks = details.colours, details.lines.marks
    rows, along = np.array(list(colours)), np.stack(list(colours.values()))
    bare = np.isin(rows, sound)
    edges, like_lips = lip_edges(along, marks[rows], np.flatnonzero(bare))
    if edges is None:
        return None, like_lips
    widths = marks[..., 2] - marks[..., 1]
    run = np.where(bare, runs(good[rows], segment, time), -1)
    moved = [along_lines(edges, along, run, time[good[rows]]), details.flow.motion(edges)]
    widths[rows] = steadied(edges, moved, run, time[good[rows]])
    return widths, like_lips


def _with_irises(details: Details, observed: F64, sound: Index) -> F64:
    """The landmarks [n, 478, 2] px with irises where the pictures have them. sound: rows that are believed."""
    rows, greys = np.array(list(details.greys)), np.stack(list(details.greys.values()))
    shifts = np.zeros((len(observed), 2, 2))
    shifts[rows] = iris_shifts(greys, details.eyes.seen[rows], np.flatnonzero(np.isin(rows, sound)))
    return details.eyes.moved(observed, shifts)


def _fitted(subject: Subject, observed: F64, x: F64) -> F64:
    """The landmarks [n, 478, 2] px with those that the head has where x [n, U] puts them."""
    shape = subject.energy.shape(subject.identity.astype(np.float64))
    out = observed.copy()
    out[:, subject.energy.model.landmarks] = subject.energy.project(shape, x)
    return out


def _with_landmarks(subject: Subject, observed: F64, x: F64, sound: Index) -> Subject:
    """The subject whose landmarks lie at observed [n, 478, 2] px, and are believed in the rows `sound`.

    x: [n, U], of which the rotations are read.
    """
    # The head's own, which does not hold what the landmarks had read of shut lips.
    model = landmark_model(subject.head, subject.energy.weights)
    energy = replace(subject.energy, model=model, observed=observed[:, model.landmarks])
    rest = at_rest(observed, energy.px_per_m, sound)
    return replace(subject, energy=with_lips_shut(energy, x, rest))


def _looked_at(
    subject: Subject,
    details: Details,
    camera: Camera,
    frames: Callable[[], Iterable[Frame]],
    good: Index,
    keys: set[int],
) -> tuple[dict[int, U8], Iterable[tuple[int, U8]]]:
    """By rows: cut-out faces of the key frames, and of all frames `good`, whose details are looked at.

    A short clip's pictures are read once.
    """
    short = len(good) * subject.window.size[0] * subject.window.size[1] <= HELD_BYTES
    held: dict[int, U8] = {}
    for row, rgb in _pictures(camera, frames(), good):
        details.look(rgb, row)
        if short or row in keys:
            held[row] = subject.window.cut(rgb, row)
    chosen = {row: cut for row, cut in held.items() if row in keys}
    if short:
        return chosen, held.items()
    again = _pictures(camera, frames(), good)
    return chosen, ((row, subject.window.cut(rgb, row)) for row, rgb in again)


def _pictures(camera: Camera, frames: Iterable[Frame], good: Index) -> Iterator[tuple[int, U8]]:
    """Row and picture of each of the frames `good` [n], in order, distortion and zoom taken out."""
    row_of = {frame: row for row, frame in enumerate(good.tolist())}
    for frame, (_, rgb) in enumerate(frames):
        if frame in row_of:
            yield row_of[frame], camera.lens.picture(rgb, frame)


def _overlap(time: F64) -> int:
    """How many frames on both sides a stretch of frames at `time` [n] s shares with its neighbours."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else OVERLAP_S
    return int(np.clip(round(OVERLAP_S / step), OVERLAP, STRETCH))


def _stretches(
    cuts: Iterable[tuple[int, U8]], total: int, overlap: int
) -> Iterator[tuple[int, dict[int, U8]]]:
    """First row of each stretch, and the cut-outs of it and of the frames that it overlaps on both sides."""
    held: dict[int, U8] = {}
    start = 0
    for row, cut in cuts:
        held[row] = cut
        if row + 1 >= min(start + STRETCH + overlap, total):
            yield start, held
            start += STRETCH
            held = {row: cut for row, cut in held.items() if row >= start - overlap}
    while any(row >= start for row in held):  # the film may break off
        yield start, held
        start += STRETCH
        held = {row: cut for row, cut in held.items() if row >= start - overlap}


def _relative(deviation: F64, good: Index, total: int) -> F32:
    """[T, 2] times the median, of deviations [n, 2] of the frames `good`."""
    out = np.full((total, 2), np.nan, np.float32)
    for column, values in enumerate(deviation.T):
        if (known := np.isfinite(values)).any():
            out[good, column] = values / max(float(np.median(values[known])), 1e-9)
    return out
