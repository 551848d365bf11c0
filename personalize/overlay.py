"""The overlay film, a small copy for the report, and the contact sheet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model.files import write_bytes
from personalize.errors import UserError
from personalize.pictures import FrameReader
from personalize.render.track import TrackPictures, grid
from personalize.run import RunFolder
from personalize.sound import FILM_RATE, on_video_clock, read_audio
from personalize.video_writer import VideoWriter
from tracker.head import HeadModel
from tracker.overlay import MODES

CRF, PRESET = 22, "superfast"  # half of the time goes into encoding
PREVIEW_CRF, PREVIEW_S = 30, 60.0
WORST, SPREAD, COLUMNS = 8, 8, 4


def check_modes(modes: Sequence[str]) -> None:
    """Raises UserError when one of the modes does not exist."""
    for mode in modes:
        if mode not in MODES:
            raise UserError(f"--overlay {mode}: no such mode; give one or more of {','.join(MODES)}")


def write_overlay(
    run: RunFolder, head: HeadModel, modes: Sequence[str], folder: Path, progress: Callable[[int, int], None]
) -> None:
    """Write overlay.mp4 with the original sound, preview.mp4 for the report, and contact_sheet.png.

    modes: of tracker.overlay.MODES, each a picture beside the video; the contact sheet shows the first.
    """
    pictures = TrackPictures.of(run, head, modes)
    track, size = pictures.track, pictures.size
    half = (size[0] // 2, size[1] // 2)
    total, end = len(track.time), float(track.time[-1])
    fps = (total - 1) / end if total > 1 else 25.0
    sound = on_video_clock(*read_audio(run.video, FILM_RATE), end + 1 / fps, FILM_RATE)
    start = sound[: round(PREVIEW_S * FILM_RATE)]
    notable = notable_frames(track.valid, track.confidence).tolist()
    tiles = {}
    with (
        VideoWriter(folder / "overlay.mp4", fps, size, sound, FILM_RATE, CRF, PRESET) as film,
        VideoWriter(folder / "preview.mp4", fps, half, start, FILM_RATE, PREVIEW_CRF, PRESET) as preview,
    ):
        for frame, (time, rgb) in enumerate(FrameReader(run.video)):
            picture = pictures.film(rgb, frame)
            film.write(picture, time)
            if time < PREVIEW_S:
                preview.write(cv2.resize(picture, half, interpolation=cv2.INTER_AREA), time)
            if frame in notable:
                tiles[frame] = pictures.tile(rgb, frame)
            progress(frame + 1, total)
    sheet = cv2.cvtColor(grid([tiles[frame] for frame in notable], COLUMNS), cv2.COLOR_RGB2BGR)
    _, png = cv2.imencode(".png", sheet)
    write_bytes(folder / "contact_sheet.png", png.tobytes())


def notable_frames(valid: NDArray[np.bool_], confidence: NDArray[np.float32]) -> NDArray[np.intp]:
    """The least certain tracked frames, apart from each other, then a spread of ordinary ones."""
    tracked = np.flatnonzero(valid)
    apart = max(1, len(tracked) // (4 * WORST))
    worst: list[int] = []
    for frame in tracked[np.argsort(confidence[tracked], kind="stable")]:
        if all(abs(int(frame) - other) >= apart for other in worst):
            worst.append(int(frame))
        if len(worst) == WORST:
            break
    spread = tracked[np.linspace(0, len(tracked) - 1, SPREAD).round().astype(int)]
    return np.concatenate([np.asarray(worst, np.intp), spread])
