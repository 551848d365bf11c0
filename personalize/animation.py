"""New speech, the subject's way of speaking: motion files and films with sound."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.errors import ModelError
from model.motion import FPS, Motion
from model.speech import SpeechEncoder, load_encoder
from model.synthesis import synthesize
from personalize.errors import UserError
from personalize.files import sha256_file
from personalize.render.face import FaceCamera
from personalize.reporter import Reporter
from personalize.run import tool_version
from personalize.sound import FILM_RATE, on_video_clock, read_audio
from personalize.subject_data import speech_features
from personalize.video_writer import VideoWriter

F32 = NDArray[np.float32]

FILM_SIZE = (720, 720)
SHORTEST_S = 0.1  # of sound: no syllable is shorter
SOUND_SLACK_S = 0.1  # sound and pictures of one recording may end this far apart
MOTION_NAME, FILM_NAME = "motion.npz", "animation.mp4"


def animate_speech(
    speech: Path,
    subject: Path,
    out: Path | None,
    samples: int,
    guidance: float | None,
    seed: int,
    encoder: str | None,
    report: Reporter,
) -> Iterator[Path]:
    """Write `motion.npz` and `animation.mp4` of each sample; yields their paths.

    subject: a run folder or a checkpoint file. With several samples each lies in a folder of its own, `0`, `1`, …
    Time 0 of the motion is time 0 of a sound file, the first picture of a video file. encoder: folder or hub name of
    the speech encoder that the checkpoint needs; None for the embedded one. Raises UserError for sound or checkpoint
    that cannot be used, and for an output that cannot be written.
    """
    places = output_places(out or Path(f"{speech.stem}.animation"), samples, [speech])
    path = checkpoint_of(subject)
    hearing = speech_encoder(encoder)
    checkpoint = load_checkpoint(path, hearing)
    sound, start_s = read_speech(speech)
    frames = max(1, round((start_s + len(sound) / FILM_RATE) * FPS))
    s = checkpoint.guidance if guidance is None else guidance
    try:
        features = speech_features(speech, np.arange(frames) / FPS, hearing)
        with report.stage("synthesis"):
            motions = synthesize(
                checkpoint, features, guidance=s, samples=samples, seed=seed, progress=report.progress
            )
    except ModelError as error:
        raise UserError(f"{speech}: {error}") from error
    audio = on_video_clock(sound, start_s, frames / FPS, FILM_RATE)
    for index, (place, coefficients) in enumerate(zip(places, motions)):
        motion = Motion(
            fps=FPS,
            start_s=0.0,
            template=checkpoint.template,
            faces=checkpoint.faces,
            basis=checkpoint.basis,
            coefficients=coefficients,
            valid=np.ones(len(coefficients), bool),
            provenance={
                "tool": "personalize",
                "version": tool_version(),
                "synthetic": True,
                "source": speech.name,
                "checkpoint": sha256_file(path),
                "seed": seed,
                "samples": samples,
                "sample": index,
                "guidance": s,
            },
        )
        yield from write_sample(place, motion, checkpoint.regions["face"], audio, report)


def speech_encoder(source: str | None) -> SpeechEncoder:
    """The encoder in a folder or of a hub name, None: the embedded one. Raises UserError for another thing."""
    try:
        return load_encoder(source)
    except ModelError as error:
        raise UserError(str(error)) from error


def checkpoint_of(subject: Path) -> Path:
    """Where the checkpoint of a run folder lies, or the file itself. Raises UserError where there is none."""
    path = subject / "checkpoint.safetensors" if subject.is_dir() else subject
    if not path.is_file():
        raise UserError(
            f"{subject}: no checkpoint there; give a finished run folder or a checkpoint.safetensors"
        )
    return path


def load_checkpoint(path: Path, encoder: SpeechEncoder | None) -> Checkpoint:
    """A subject. encoder: None where nothing is heard. Raises UserError for another thing, or another encoder's."""
    try:
        return Checkpoint.load(path, encoder=None if encoder is None else encoder.name)
    except ModelError as error:
        raise UserError(str(error)) from error


def read_speech(speech: Path, until_s: float = 0.0) -> tuple[F32, float]:
    """Sound [S] at 48 kHz and the time s of its first sample.

    Raises UserError where there is nothing to hear, or it ends before a motion that lasts `until_s`.
    """
    sound, start_s = read_audio(speech, FILM_RATE)
    if not np.any(np.abs(sound) > 1e-4):
        raise UserError(f"{speech}: there is no sound in it; give a recording of speech")
    if len(sound) < SHORTEST_S * FILM_RATE:
        raise UserError(
            f"{speech}: only {1e3 * len(sound) / FILM_RATE:.0f} ms of sound; give a recording of speech"
        )
    end_s = start_s + len(sound) / FILM_RATE
    if end_s < until_s - SOUND_SLACK_S:
        raise UserError(
            f"{speech}: its sound ends at {end_s:.2f} s, the motion at {until_s:.2f} s; give the whole recording"
        )
    return sound, start_s


def output_places(folder: Path, samples: int, inputs: Iterable[Path | None]) -> list[Path]:
    """The folder of each sample: `folder` itself, or of several `0`, `1`, … in it; none is made yet.

    Raises UserError where one cannot be written, or where what is written would replace one of the inputs.
    """
    places = [folder] if samples == 1 else [folder / str(index) for index in range(samples)]
    read = {os.path.realpath(path) for path in inputs if path is not None}
    for place in places:
        if not _can_be_written(place):
            raise UserError(f"{place}: cannot be written; choose another --out")
        for name in (MOTION_NAME, FILM_NAME):
            if os.path.realpath(place / name) in read:
                raise UserError(f"{place}: holds the {name} that this command reads; choose another --out")
    return places


def _can_be_written(folder: Path) -> bool:
    """Whether files may be put into a folder that is there, or the folder be made."""
    try:
        nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    except OSError:
        return False
    return nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)


def write_sample(
    place: Path, motion: Motion, face: NDArray[np.integer], sound: F32 | None, report: Reporter
) -> Iterator[Path]:
    """Motion and film in the folder `place`, made if need be; yields their paths. Sound as for `write_film`."""
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{place}: cannot be written ({error.strerror}); choose another --out") from None
    (place / FILM_NAME).unlink(missing_ok=True)  # of another motion, should this end before its own is drawn
    motion.save(place / MOTION_NAME)
    yield place / MOTION_NAME
    with report.stage("film"):
        write_film(place / FILM_NAME, motion, face, sound, report)
    yield place / FILM_NAME


def write_film(
    path: Path, motion: Motion, face: NDArray[np.integer], sound: F32 | None, report: Reporter
) -> None:
    """The motion from the front, 30 fps, with its sound [S] at 48 kHz from the motion's first frame on, if any."""
    camera = FaceCamera(motion.template, motion.faces, face, FILM_SIZE)
    with VideoWriter(path, motion.fps, FILM_SIZE, sound, FILM_RATE) as film:
        for frame in range(len(motion.valid)):
            displacement = np.tensordot(motion.coefficients[frame], motion.basis, axes=1)
            film.write(camera.picture(displacement))
            report.progress(frame + 1, len(motion.valid))
