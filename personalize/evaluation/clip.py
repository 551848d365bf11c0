"""A film to judge by: the video, the tracked motion, and one synthesized sample, with the original sound."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model.checkpoint import Checkpoint
from model.motion import Motion
from personalize.pictures import FrameReader
from personalize.render.face import FaceCamera
from personalize.render.text import caption
from personalize.run import RunFolder, read_landmarks
from personalize.sound import FILM_RATE, on_video_clock, read_audio
from personalize.video_writer import VideoWriter

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
PANEL = (400, 480)
FACE_SHARE = 0.62
CRF = 24


def write_clip(
    run: RunFolder,
    path: Path,
    motion: Motion,
    checkpoint: Checkpoint,
    time: NDArray[np.float64],
    reference: F32,
    sample: F32,
) -> None:
    """time [n] s, reference and sample [n, K] m -> an mp4 of three pictures side by side at the motion's rate."""
    camera = FaceCamera(motion.template, motion.faces, checkpoint.regions["face"], PANEL)
    sound, start_s = read_audio(run.video, FILM_RATE)
    late_s = motion.sound_offset_s(run.video_sha256)
    audio = on_video_clock(sound, start_s - float(time[0]) - late_s, len(time) / motion.fps, FILM_RATE)
    width, height = PANEL
    with VideoWriter(path, motion.fps, (3 * width, height), audio, FILM_RATE, CRF) as film:
        for index, picture in enumerate(_face_pictures(run, time)):
            panels = [caption(picture, "video")]
            for name, row in (("tracked", reference[index]), ("synthesized", sample[index])):
                displacement = np.tensordot(row, motion.basis, axes=1)
                panels.append(caption(camera.picture(displacement), name))
            film.write(np.concatenate(panels, axis=1))


def _face_pictures(run: RunFolder, time: NDArray[np.float64]) -> list[U8]:
    """The video cut to the face at times [n] s, one picture of PANEL size each: the frame shown at that time."""
    landmarks = read_landmarks(run.path / "landmarks/landmarks.npz")
    shown = np.clip(
        np.searchsorted(landmarks.time, time + 1e-6, side="right") - 1, 0, len(landmarks.time) - 1
    )
    points = landmarks.points[shown[0] : shown[-1] + 1, :, :2]
    low, high = np.nanmin(points, axis=(0, 1)), np.nanmax(points, axis=(0, 1))
    middle = (low + high) / 2
    side = float(max(high - low)) / FACE_SHARE
    scale = PANEL[1] / side
    shift = np.array([(PANEL[0] - 1) / 2, (PANEL[1] - 1) / 2]) - scale * middle
    window = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
    needed, pictures = set(shown.tolist()), {}
    for frame, (_, rgb) in enumerate(FrameReader(run.video)):
        if frame in needed:
            pictures[frame] = cv2.warpAffine(rgb, window, PANEL, flags=cv2.INTER_CUBIC)
        if frame >= shown[-1]:
            break
    return [pictures[frame] for frame in shown.tolist()]
