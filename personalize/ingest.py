"""First stage: what the file holds, which frames show the person, the sound on their clock, the split."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from personalize.container import MediaInfo, probe, quantizer
from personalize.errors import UserError
from personalize.people import FaceFollower, Tracklet, main_person, sureness_of_turns
from personalize.pictures import FrameReader
from personalize.shots import (
    CUT_WINDOW_S,
    F32,
    F64,
    FACE_JUMPS,
    MAX_GAP_S,
    MIN_SHOT_S,
    MOST_WINDOW,
    NEARLY_SMALL,
    REASONS,
    SMALL_FACE,
    Bool,
    Changes,
    Frames,
    find_shots,
    repeated,
    sudden,
    usable_seconds,
)
from personalize.sound import SPEECH_RATE, on_video_clock, read_audio
from personalize.split import make_split
from tracker.landmark_indices import LEFT_EYE_OUTER, RIGHT_EYE_OUTER
from tracker.landmarker import FaceLandmarker

Progress = Callable[[int, int], None] | None

SEARCH_SIDE = 960  # px: faces are looked for in pictures of at most this size
MIN_USABLE_S = 10.0  # less is refused: fine-tuned on 5 s the model diverges
GOOD_USABLE_S = 30.0  # less gives a warning
MIN_RATE = 8.0  # different pictures a second; with fewer lips shut and open between two of them unseen
MIN_EYES_PX = 20.0  # between the eyes; below, lip motion is lost in the landmarks' jitter
GOOD_EYES_PX = 45.0
# Mean grey level of the face. Dark skin in poor light has 67; below 50, openings come to err by .4 to 1.1 mm.
MIN_LIGHT, GOOD_LIGHT = 15.0, 52.0
# Share of the face's colour values that cannot be brighter: well lit faces have up to .1.
MAX_BURNT, GOOD_BURNT = 0.5, 0.2
MIN_SHARPNESS = 0.2  # see people.sharpness: blocky or noisy video has 0.3 to 0.6
MAX_TILT_DEG = 60.0  # of the line of the eyes: people tilt their heads by up to 45
TURN_S, TURN_LOOKS = 1.0, 4  # between looks whether the picture is turned, and the fewest that tell it
# In so many looks a face is found more surely where the picture is turned as it should be, by so much usually: .06 at
# least for pictures on their side, .04 at most for heads tilted by 42 degrees.
TURN_SHARE, SURER = 0.75, 0.05
SILENCE = 1e-3  # peak of the sound, -60 dB
MOST_SILENT_S = 1.0  # of pictures before the sound begins or after it ends
MOST_INTERLACED = 0.5  # share of the pictures
# Steps of grey, as a share of H.264's at quantizer 0, for each px between the eyes, above which openings err by half a
# millimetre more. They double with every six of the quantizer, of which telephones and webcams have 16 to 27.
COARSE = 0.3
MAX_UNSEEN_S = 0.3  # a face is taken to be there when the detector misses it for no longer

DESCRIPTIONS = {
    "no_face": "no face is seen",
    "cut": "cuts and shots too short to track",
    "other_person": "another person's face or a photograph's, or one covered so that it looks like another's",
    "too_small": "the face is too small",
    "too_dark": "the face is too dark",
    "too_bright": "the face is overexposed",
    "blurred": "the face is blurred",
    "corrupt": "damaged in the file",
    "duplicate": "the picture before is repeated",
}
REMEDIES = {
    "no_face": "keep the face in the picture, turned to the camera",
    "cut": "longer shots would be used",
    "other_person": "film one person, or crop the video to one",
    "too_small": "film closer",
    "too_dark": "film with more light",
    "too_bright": "film with less light or exposure",
    "blurred": "film in focus, with more light",
    "corrupt": "copy or export the file again",
    "duplicate": "where pictures stand still, record or export the video again",
}


@dataclass(frozen=True)
class Ingested:
    """Everything the ingest folder holds. audio: mono f32 at 16 kHz, sample 0 at the first picture."""

    media: MediaInfo
    frames: Frames
    audio: F32
    split: dict[str, Any]
    warnings: list[str]


def ingest_video(path: Path | str, progress: Progress = None) -> Ingested:
    """Look through a video: times, usable frames, sound, split.

    Raises UserError when the file is no video, its clock is set back, it has no sound or silence only, too few pictures
    a second, lies on its side or upside down, or has under 10 s of one usable face.
    """
    media = probe(path)
    audio = _read_sound(media)
    frames, warnings = find_usable(media, progress)
    seconds = usable_seconds(frames)
    if seconds < MIN_USABLE_S:
        raise UserError(_too_little(media, frames, seconds))
    if seconds < GOOD_USABLE_S:
        warnings.insert(
            0,
            f"only {seconds:.1f} s of usable face: film more; 30 s are acceptable, results improve up to about 100 s",
        )
    end = float(frames.time[-1] + np.median(np.diff(frames.time)))
    sound = on_video_clock(*audio, end)
    if not sound.any():
        raise UserError(
            f"{media.path}: all the sound lies before the first picture or after the last; export the video again"
        )
    warnings += _without_sound(*audio, end)
    return Ingested(media, frames, sound, make_split(frames), warnings)


def _read_sound(media: MediaInfo) -> tuple[F32, float]:
    if not media.has_audio:
        raise UserError(
            f"{media.path}: there is no sound that can be read in this file; give a video with the person's speech"
        )
    samples, start = read_audio(media.path)
    if not len(samples) or float(np.abs(samples).max()) < SILENCE:
        raise UserError(f"{media.path}: the sound is silent; give a video with the person's speech")
    return samples, start


def _without_sound(samples: F32, start: float, end: float) -> list[str]:
    """That the sound begins late or ends early. start: s after the first picture. end: s, of the pictures."""
    known = (start, start + len(samples) / SPEECH_RATE)
    if known[0] <= MOST_SILENT_S and known[1] >= end - MOST_SILENT_S:
        return []
    return [
        f"there is sound only from {max(known[0], 0):.1f} to {min(known[1], end):.1f} s of {end:.1f} s: lips that move "
        "outside of that are learned as silent; cut the video to it, or export it again with all its sound"
    ]


def find_usable(media: MediaInfo, progress: Progress = None) -> tuple[Frames, list[str]]:
    """Frames of a video with their reasons, and warnings.

    In one pass: a cut is told by the pictures behind it too, so what was followed across one is divided afterwards.
    """
    looked = _looked_through(media, progress)
    time, again = looked.time, looked.again
    _check_rate(media, time[~again])
    segment = find_shots(time, looked.change, looked.face)
    mine, others = main_person([shot for face in looked.faces for shot in face.shots(segment)])
    _check_upright(media, mine, looked.turns)
    total = len(time)
    reason = np.full(total, REASONS.index("no_face"), np.uint8)
    for tracklet in others:
        reason[tracklet.frames] = REASONS.index("other_person")
    measures = np.full((total, 8), np.nan, np.float32)  # box, eyes, light, burnt, sharpness
    for tracklet in mine:
        rows = _filled(tracklet, time)
        known = tracklet.frames[0] + np.flatnonzero(~np.isnan(rows[:, 0]))
        reason[known] = 0
        measures[known] = rows[known - tracklet.frames[0]]
    scale = max(1.0, max(media.width, media.height) / SEARCH_SIDE)
    box, eyes, (light, burnt, sharp) = measures[:, :4] * scale, measures[:, 4] * scale, measures[:, 5:].T
    seen = reason == 0
    marks = {
        "blurred": seen & (sharp < MIN_SHARPNESS),
        "too_dark": seen & (light < MIN_LIGHT),
        "too_bright": seen & (burnt > MAX_BURNT),
        "too_small": seen & (eyes < MIN_EYES_PX),
        "cut": seen & _cut(time, segment),
        "duplicate": again & seen,
        "corrupt": looked.corrupt,
    }
    for name, marked in marks.items():  # the last that applies stays
        reason[marked] = REASONS.index(name)
    frames = Frames(time, reason == 0, reason, REASONS, segment, box.astype(np.float32))
    notes = _form(media, looked.reader, total) + _lost_in_file(media, time)
    return frames, notes + _warnings(frames, eyes, light, burnt, quantizer(Path(media.path)))


def _check_rate(media: MediaInfo, changed: F64) -> None:
    """Raise UserError when the picture changes, at the times `changed` [n] s, too rarely to learn speech from it."""
    if len(changed) < 2:
        return  # it stands still, which is another complaint
    rate = round(1 / float(np.median(np.diff(changed))), 1)
    if rate < MIN_RATE:
        raise UserError(
            f"{media.path}: only {rate:.1f} different pictures a second, which miss how lips move; at least "
            f"{MIN_RATE:.0f} are needed: record it again, best at 24 or more"
        )


def _check_upright(media: MediaInfo, person: list[Tracklet], turns: list[F64]) -> None:
    """Raise UserError when the person lies on their side or head for most of the clip: the head is fitted upright.

    turns: [4] of some of the pictures, see `sureness_of_turns`.
    """
    across = [shape[LEFT_EYE_OUTER, :2] - shape[RIGHT_EYE_OUTER, :2] for t in person for shape in t.shapes]
    tilt = np.degrees(np.arctan2(*np.transpose(across)[::-1])) if across else np.zeros(1)
    # Turned faces are found as upright ones too, whatever they are.
    gains = np.array([turn - turn[0] for turn in turns if turn[0] > 0]).reshape(-1, 4)
    quarters = 0
    if len(gains) >= TURN_LOOKS:
        surer = np.median(gains, axis=0)
        told = (np.quantile(gains, 1 - TURN_SHARE, axis=0) > 0) & (surer > SURER)
        quarters = int((told * surer).argmax())
    if quarters in (1, 3) or float(np.median(np.abs(tilt))) > MAX_TILT_DEG:
        raise UserError(
            f"{media.path}: the picture lies on its side, no upright face is in it; turn the video"
        )
    if quarters:
        raise UserError(f"{media.path}: the picture is upside down; turn the video")


@dataclass(frozen=True)
class _Seen:
    """What one pass over the pictures shows.

    time: [T] s. change, face: [T], how much each differs from the last, see `find_shots`. again: [T] repeated. corrupt:
    [T] damaged. faces: all, in px of pictures of at most SEARCH_SIDE. turns: `sureness_of_turns` of some. reader: at
    its end.
    """

    time: F64
    change: F64
    face: F64
    again: Bool
    corrupt: Bool
    faces: list[Tracklet]
    turns: list[F64]
    reader: FrameReader


def _looked_through(media: MediaInfo, progress: Progress) -> _Seen:
    landmarker = FaceLandmarker()
    reader, follower = FrameReader(media.path, SEARCH_SIDE), FaceFollower(landmarker)
    expected = max(1, round(media.duration_s * media.fps))
    recent = deque[tuple[float, float]](maxlen=min(max(3, round(CUT_WINDOW_S * media.fps)), MOST_WINDOW))
    changes, rows, turns, next_look = Changes(), [], list[F64](), 0.0
    for index, (time, rgb) in enumerate(reader):
        whole, near, face = changes.next(rgb, follower.boxes, follower.foremost)
        rows.append((time, whole, near, face, reader.damaged))
        gap = len(rows) > 1 and time - rows[-2][0] > MAX_GAP_S
        pictures, faces = zip(*recent) if recent else ((), ())
        cut = sudden(near[0], pictures) or sudden(face, faces, FACE_JUMPS)
        follower.add(index, time, rgb, gap or cut)
        recent.append((near[0], face))
        if follower.widest is not None and time >= next_look:
            next_look = time + TURN_S
            turns.append(sureness_of_turns(landmarker, rgb, follower.widest))
        if progress is not None:
            progress(min(len(rows), expected), expected)
    times, whole_views, near_views, above_mouth, damaged = zip(*rows)
    # Once for the clip: two measures side by side would look like motion and rest.
    widths: list[list[float]] = [[] for _ in times]
    for sighting in (sighting for face in follower.tracklets for sighting in face.sightings):
        widths[sighting.frame].append(float(sighting.box[2] - sighting.box[0]))
    side = min(SEARCH_SIDE, max(media.width, media.height))
    seen = [frame for frame in widths if frame] or [[np.inf]]
    widest, narrowest = (float(np.median([of(frame) for frame in seen])) / side for of in (max, min))
    of_cuts = near_views if widest < SMALL_FACE else whole_views
    of_repeats = near_views if narrowest < NEARLY_SMALL * SMALL_FACE else whole_views
    at, differences = np.array(times), np.array([change for change, _ in of_cuts])
    again = repeated(at, *(np.array(column) for column in zip(*of_repeats)))
    return _Seen(
        at, differences, np.array(above_mouth), again, np.array(damaged), follower.tracklets, turns, reader
    )


def _form(media: MediaInfo, reader: FrameReader, total: int) -> list[str]:
    """Pictures whose size changes, or that are woven of two fields."""
    texts = []
    if not np.isnan(reader.resized_s):
        texts.append(
            f"the size of the pictures changes at {reader.resized_s:.1f} s; all are taken at the first one's, "
            f"{media.width}x{media.height} px: if most of the later ones are larger, give only the part after that"
        )
    if reader.interlaced > MOST_INTERLACED * total:
        texts.append(
            "the film is interlaced: lips may be measured a third less well; set the camera to progressive pictures"
        )
    return texts


def _filled(tracklet: Tracklet, time: F64) -> F64:
    """[n, 8] measures of each frame from a tracklet's first to its last.

    Frames that the detector missed are interpolated; NaN where it missed too many.
    """
    index = np.array(tracklet.frames)
    span = time[index[0] : index[-1] + 1]
    known = np.array([sighting.measures for sighting in tracklet.sightings])
    rows = np.column_stack([np.interp(span, time[index], column) for column in known.T])
    after = np.searchsorted(time[index], span)
    gap = time[index][after] - time[index][np.maximum(after - 1, 0)]
    rows[(gap > MAX_UNSEEN_S) & (time[index][after] != span)] = np.nan
    return rows


def _cut(time: F64, segment: NDArray[np.int32]) -> Bool:
    """[T] first frames after a cut, and shots too short to track."""
    first = np.diff(segment, prepend=segment[0]) != 0
    length = np.array([np.ptp(time[segment == s]) for s in range(segment[-1] + 1)])
    return first | (length[segment] < MIN_SHOT_S)


def _lost_in_file(media: MediaInfo, time: F64) -> list[str]:
    """What the file holds no pictures of: gaps, and an end that comes early."""
    texts = []
    gaps = np.flatnonzero(np.diff(time) > MAX_GAP_S)
    if len(gaps):
        seconds, first = float(np.diff(time)[gaps].sum()), float(time[gaps[0]])
        where = f"{len(gaps)} gaps, the first" if len(gaps) > 1 else "a gap"
        texts.append(
            f"{seconds:.1f} s without pictures, in {where} at {first:.1f} s: the film counts as cut there; export it "
            "again, or record it without dropping pictures"
        )
    if media.duration_s - time[-1] > 1.0:
        texts.append(
            f"the file breaks off at {time[-1]:.1f} s of {media.duration_s:.1f} s; copy or export it again if you need "
            "the rest"
        )
    return texts


def _warnings(frames: Frames, eyes: F32, light: F32, burnt: F32, steps: float) -> list[str]:
    """What the person should know of a clip that is used all the same. steps: see `quantizer`."""
    texts = []
    total = len(frames.time)
    for number, name in enumerate(REASONS[1:], 1):
        share = float((frames.reason == number).mean())
        if share > 0.05 or (share > 0 and name == "corrupt"):
            texts.append(f"{share:.1%} of {total} frames left out: {DESCRIPTIONS[name]}; {REMEDIES[name]}")
    if frames.usable.any():
        size, level, lost = (float(np.median(measure[frames.usable])) for measure in (eyes, light, burnt))
        if size < GOOD_EYES_PX:
            texts.append(
                f"the face is small ({size:.0f} px between the eyes): lips will be measured coarsely; film closer, or "
                "in a higher resolution"
            )
        if 2 ** (steps / 6) > COARSE * size:
            texts.append(
                f"the film is compressed hard (quantizer {steps:.0f} of 51, {size:.0f} px between the eyes): lips and "
                "how the head turns may be measured half as well; give the original, or film in a higher quality"
            )
        if level < GOOD_LIGHT:
            texts.append(
                f"the face is dark ({level:.0f} of 255): lips may be measured up to a millimetre off; film with more "
                "light"
            )
        if lost > GOOD_BURNT:
            texts.append(
                f"the face is overexposed ({lost:.0%} of its colours cut off): lips may be measured half a millimetre "
                "off; film with less light or exposure"
            )
    return texts


def _too_little(media: MediaInfo, frames: Frames, seconds: float) -> str:
    """One line: how much usable face there was, and what was in the way most."""
    counts = np.bincount(frames.reason, minlength=len(REASONS))[1:]
    if not frames.usable.any() and counts[0] == counts.sum():
        return f"{media.path}: no face was found in it; give a video of a talking face"
    text = f"{media.path}: only {seconds:.1f} s of usable face, at least {MIN_USABLE_S:.0f} s are needed"
    if counts.max() > 0.05 * len(frames.time):
        name = REASONS[1 + int(counts.argmax())]
        text += f"; in {counts.max() / len(frames.time):.0%} of the frames {DESCRIPTIONS[name]}"
    return text + "; give a longer or better video"
