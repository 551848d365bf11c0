"""The overlay film, a small copy for the report, and the contact sheet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from personalize.files import write_atomic
from personalize.media import VideoWriter, on_video_clock, read_audio, read_frames
from personalize.quality import read_reasons
from personalize.render.text import caption
from personalize.run import RunFolder, read_landmarks, read_track
from tracker.head import HeadModel
from tracker.overlay import contact_sheet, draw_overlay, panel_size

PREVIEW_WIDTH, PREVIEW_CRF, PREVIEW_S = 720, 30, 60.0
WORST, SPREAD = 8, 8
TILE, FACE_MARGIN = 480, 1.5  # px; of the face's own extent
AUDIO_RATE = 48_000

U8 = NDArray[np.uint8]


def write_overlay(
    run: RunFolder, head: HeadModel, folder: Path, progress: Callable[[int, int], None]
) -> None:
    """Write overlay.mp4 with the original sound, preview.mp4 for the report, and contact_sheet.png."""
    track = read_track(run.path / "refine/track.npz")
    landmarks = read_landmarks(run.path / "landmarks/landmarks.npz")
    reasons = read_reasons(run.path / "refine/quality.csv")
    total = len(track.time)
    shown = set(notable_frames(track.valid, track.confidence).tolist())
    kept: dict[int, U8] = {}
    fps = (total - 1) / float(track.time[-1]) if total > 1 else 25.0
    width, height = panel_size(landmarks.size)
    small = (PREVIEW_WIDTH, round(PREVIEW_WIDTH * height / (2 * width) / 2) * 2)
    sound = on_video_clock(*read_audio(run.video, AUDIO_RATE), float(track.time[-1]) + 1 / fps, AUDIO_RATE)
    preview_sound = sound[: round(PREVIEW_S * AUDIO_RATE)]
    with (
        VideoWriter(folder / "overlay.mp4", fps, (2 * width, height), sound, AUDIO_RATE) as film,
        VideoWriter(folder / "preview.mp4", fps, small, preview_sound, AUDIO_RATE, PREVIEW_CRF) as preview,
    ):
        for frame, (time, rgb) in enumerate(read_frames(run.video)):
            picture = draw_overlay(rgb, track, frame, landmarks, head, str(reasons[frame]))
            film.write(picture, time)
            if time < PREVIEW_S:
                preview.write(cv2.resize(picture, small, interpolation=cv2.INTER_AREA), time)
            if frame in shown:
                scale = height / rgb.shape[0]
                tile = _around_face(picture[:, width:], landmarks.points[frame, :, :2] * scale)
                kept[frame] = caption(tile, f"{time:.2f} s, confidence {track.confidence[frame]:.2f}")
            progress(frame + 1, total)
    sheet = contact_sheet([kept[frame] for frame in notable_frames(track.valid, track.confidence)])
    _, png = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    write_atomic(folder / "contact_sheet.png", lambda stream: stream.write(png.tobytes()))


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


def _around_face(picture: U8, points: NDArray[np.float32]) -> U8:
    """A square of the picture around the points [478, 2] px, TILE px a side: on it a wrong mesh can be seen."""
    low, high = points.min(0), points.max(0)
    side = float((high - low).max()) * FACE_MARGIN
    scale = TILE / side
    window = np.array([[scale, 0, 0], [0, scale, 0]])
    window[:, 2] = (TILE - 1) / 2 - scale * (low + high) / 2
    tile: U8 = cv2.warpAffine(picture, window, (TILE, TILE), flags=cv2.INTER_AREA)
    return tile
