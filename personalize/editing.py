"""Edits of a motion file: which frames and parts of the face are kept, where its sound lies, and what is written."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.diffusion import Rule
from model.editing import Kept, check_motion, edit, seam_of, with_frames
from model.errors import ModelError
from model.motion import Motion, MotionError
from model.speech import SpeechEncoder
from personalize.animation import (
    checkpoint_of,
    load_checkpoint,
    output_places,
    read_speech,
    speech_encoder,
    write_sample,
)
from personalize.errors import UserError
from personalize.files import sha256_file
from personalize.regions import kept_share
from personalize.reporter import Reporter
from personalize.run import tool_version
from personalize.sound import FILM_RATE, on_video_clock
from personalize.subject_data import speech_features
from personalize.times import frames_at

F32 = NDArray[np.float32]

OFFSET = ("av_offset_s", "av_offset_of")  # of the run's sound, whatever is heard in an edit


@dataclass(frozen=True)
class EditSettings:
    """What is kept, as a user says it, and how the rest is drawn.

    keep, keyframes: times as for `frames_at`; keyframes come from the motion file `source` where one is given.
    keep_regions, remake: names of parts of the face, one of the two. blend_mm: width of the border between parts.
    unconditional: the sound is not listened to, only played. guidance: None for the checkpoint's own.
    encoder: folder or hub name of the speech encoder that the checkpoint needs; None for the embedded one.
    """

    keep: str = ""
    keyframes: str = ""
    source: Path | None = None
    keep_regions: tuple[str, ...] = ()
    remake: tuple[str, ...] = ()
    blend_mm: float = 20.0
    unconditional: bool = False
    samples: int = 1
    guidance: float | None = None
    seed: int = 0
    rule: Rule = "posterior"
    encoder: str | None = None


def edit_motion(
    path: Path, subject: Path, speech: Path | None, out: Path | None, settings: EditSettings, report: Reporter
) -> Iterator[Path]:
    """Write `motion.npz` and `animation.mp4` of each sample, as `animate_speech` does; yields their paths.

    path: a motion file; the results have its frames, clock and template. speech: time 0 is presentation time 0 (of a
    video file, its first picture), None for an unconditional edit without sound. Raises UserError for input that cannot
    be used.
    """
    places = output_places(
        out or Path(f"{path.stem}.edit"), settings.samples, [path, settings.source, speech]
    )
    heard = speech is not None and not settings.unconditional
    checkpoint_path = checkpoint_of(subject)
    encoder = speech_encoder(settings.encoder) if heard else None
    checkpoint = load_checkpoint(checkpoint_path, encoder)
    motion = _load_motion(path)
    try:
        check_motion(checkpoint, motion)
        sound, features = (None, None) if speech is None else _sound_of(speech, motion, encoder, report)
        guidance = _guidance(settings, checkpoint, heard)
        kept = _kept(motion, checkpoint, settings)
        with report.stage("synthesis"):
            edited = edit(
                checkpoint,
                features,
                kept,
                guidance=guidance,
                samples=settings.samples,
                seed=settings.seed,
                rule=settings.rule,
                progress=report.progress,
            )
    except ModelError as error:
        raise UserError(f"{path}: {error}") from error
    facts = {
        "tool": "personalize",
        "version": tool_version(),
        "synthetic": True,
        "source": None if speech is None else speech.name,
        "checkpoint": sha256_file(checkpoint_path),
        "seed": settings.seed,
        "samples": settings.samples,
        "guidance": guidance,
        "rule": settings.rule,
        **{name: motion.provenance[name] for name in OFFSET if name in motion.provenance},
        "edit": _as_json(path, kept, settings),
    }
    face = checkpoint.regions["face"]
    for index, (place, result) in enumerate(zip(places, edited)):
        seam = seam_of(result, kept.frames, motion, face)
        report.say(f"sample {index}: {kept.frames.sum()} of {len(kept.frames)} frames kept, seam {seam:.2f}")
        result = dataclasses.replace(result, provenance=facts | {"sample": index})
        yield from write_sample(place, result, face, sound, report)


def _guidance(settings: EditSettings, checkpoint: Checkpoint, heard: bool) -> float:
    """The s that is used; UserError where one is asked for and there is nothing to be guided by."""
    if heard:
        return checkpoint.guidance if settings.guidance is None else settings.guidance
    if settings.guidance is not None:
        raise UserError("--guidance: needs --audio, and no --unconditional; leave it out")
    return 0.0


def _load_motion(path: Path) -> Motion:
    try:
        return Motion.load(path)
    except MotionError as error:
        raise UserError(f"{error}; give the motion.npz of a run or of an animation") from error


def _kept(motion: Motion, checkpoint: Checkpoint, settings: EditSettings) -> Kept:
    """What the settings keep. Frames of spans in which no face was seen are made anew."""
    frames = frames_at(settings.keep, motion, "--keep")
    keyframes = frames_at(settings.keyframes, motion, "--keyframes")
    if settings.source is not None:
        if not keyframes.any():
            raise UserError("--from: say with --keyframes which times are taken from it")
        motion = _with_keyframes(motion, settings.source, keyframes)
    unseen = np.flatnonzero(keyframes & ~motion.valid)
    if len(unseen):
        time = motion.start_s + unseen[0] / motion.fps
        raise UserError(f"--keyframes: no face was seen at {time:.2f} s; choose another time")
    share = kept_share(checkpoint, settings.keep_regions, settings.remake, settings.blend_mm / 1000)
    return Kept(motion, (frames | keyframes) & motion.valid, share)


def _with_keyframes(motion: Motion, source: Path, keyframes: NDArray[np.bool_]) -> Motion:
    """The motion with some frames from another file: of the same presentation time, to the nearest frame."""
    other = _load_motion(source)
    times = motion.start_s + np.flatnonzero(keyframes) / motion.fps
    places = np.floor((times - other.start_s) * other.fps + 0.5).astype(int)
    outside = (places < 0) | (places >= len(other.valid))
    if outside.any():
        end_s = other.start_s + len(other.valid) / other.fps
        raise UserError(
            f"--keyframes: {times[outside][0]:.2f} s is outside {source}, which is from {other.start_s:.2f} to"
            f" {end_s:.2f} s"
        )
    return with_frames(motion, other, keyframes, places)


def _sound_of(
    speech: Path, motion: Motion, encoder: SpeechEncoder | None, report: Reporter
) -> tuple[F32, F32 | None]:
    """Sound [S] at 48 kHz from the motion's first frame on, and the speech features [N, W] of its frames.

    No features without an encoder.
    """
    times = motion.start_s + np.arange(len(motion.valid)) / motion.fps
    sound, start_s = read_speech(speech, times[-1])
    offset_s = motion.sound_offset_s(sha256_file(speech))
    times += offset_s
    if not offset_s and motion.provenance.get("av_offset_s"):
        report.say(f"{speech}: not the sound on which the motion's offset was found, which is not applied")
    length_s = len(times) / motion.fps
    try:
        features = None if encoder is None else speech_features(speech, times, encoder)
    except ModelError as error:
        raise UserError(f"{speech}: {error}") from error
    return on_video_clock(sound, start_s - times[0], length_s, FILM_RATE), features


def _as_json(path: Path, kept: Kept, settings: EditSettings) -> dict[str, object]:
    """What was kept, for the provenance."""
    return {
        "motion": path.name,
        "motion_sha256": sha256_file(path),
        "keep": settings.keep,
        "keyframes": settings.keyframes,
        "from_sha256": None if settings.source is None else sha256_file(settings.source),
        "keep_regions": list(settings.keep_regions),
        "remake": list(settings.remake),
        "blend_mm": settings.blend_mm,
        "kept_frames": int(kept.frames.sum()),
    }
