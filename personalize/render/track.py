"""What the overlay shows of a frame: the video, the fitted face in several modes, and how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from personalize.pictures import FrameReader
from personalize.quality import read_reasons
from personalize.run import RunFolder, read_landmarks, read_track
from tracker.albedo import Albedo, learn_albedo
from tracker.head import HeadModel
from tracker.overlay import NEEDS_ALBEDO, draw_modes, letter
from tracker.raster import project
from tracker.scene import Crop, Scene, place, scene
from tracker.track import Landmarks, Track

PANEL = 640  # px, the longer side of each picture in the film
FACE_MARGIN, TILE_MARGIN = 0.25, 0.12  # of the face's own extent, on each side of it
ONE_ROW = 3  # pictures; more go into two rows
FOOTER, LETTERS = 44, 15  # px, heights
TILE = 480  # px, side of a picture of the contact sheet
KEYS = 32  # frames that tell the albedo
GOOD, DOUBTFUL, BAD = (70, 200, 90), (245, 180, 40), (240, 80, 70)
DARK = (30, 30, 30)

U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class TrackPictures:
    """Draws any frame of a run: its track, in which modes, on which part of the picture.

    landmarks: without the camera's distortion and zoom, which are taken out of the pictures too.
    reasons: [T] why each frame is left out, `ok` where it is not.
    """

    track: Track
    landmarks: Landmarks
    reasons: Sequence[str]
    head: HeadModel
    modes: Sequence[str]
    crop: Crop
    albedo: Albedo | None

    @classmethod
    def of(cls, run: RunFolder, head: HeadModel, modes: Sequence[str]) -> TrackPictures:
        """Read the run's track; learn the subject's albedo where one of the modes needs it."""
        track = read_track(run.path / "refine/track.npz")
        landmarks = read_landmarks(run.path / "landmarks/landmarks.npz").through(track.lens)
        reasons = read_reasons(run.path / "refine/quality.csv").tolist()
        valid = np.flatnonzero(track.valid)
        crop = around_face(landmarks.points[valid, :, :2], landmarks.size)
        albedo = None
        if any(mode in NEEDS_ALBEDO for mode in modes):
            keys = set(valid[np.linspace(0, len(valid) - 1, KEYS).round().astype(int)].tolist())
            albedo = learn_albedo(
                scene(track.lens.picture(rgb, frame), crop, track, frame, landmarks, head)
                for frame, (_, rgb) in enumerate(FrameReader(run.video))
                if frame in keys
            )
        return cls(track, landmarks, reasons, head, modes, crop, albedo)

    @property
    def columns(self) -> int:
        """How many pictures stand side by side in the film: the video and one for each mode."""
        count = 1 + len(self.modes)
        return count if count <= ONE_ROW else -(-count // 2)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the film, px."""
        width, height = self.crop.size
        return self.columns * width, -(-(1 + len(self.modes)) // self.columns) * height + FOOTER

    def film(self, rgb: U8, frame: int) -> U8:
        """The film's picture: the video and each mode, below them time and confidence."""
        rgb = self.track.lens.picture(rgb, frame)
        panels = [self.crop.picture(rgb), *self._drawn(rgb, frame, self.crop, self.modes)]
        for panel, name in zip(panels, ("video", *self.modes)):
            letter(panel, name, (LETTERS, 2 * LETTERS), LETTERS)
        return np.concatenate([grid(panels, self.columns), self._footer(frame)])

    def tile(self, rgb: U8, frame: int) -> U8:
        """The scene of a tracked frame in the first mode: on it a wrong mesh can be seen."""
        seen = self.scene(rgb, frame)
        (tile,) = draw_modes(seen, self.modes[:1], self.head, self.albedo)
        text, colour = self._verdict(frame)
        letter(tile, f"{self.track.time[frame]:.2f} s", (LETTERS, 2 * LETTERS), LETTERS)
        letter(tile, text, (LETTERS, 4 * LETTERS), LETTERS, colour)
        cv2.rectangle(tile, (0, 0), (TILE - 1, TILE - 1), colour, 3)
        return tile

    def scene(self, rgb: U8, frame: int) -> Scene:
        """A square of TILE px around the face of a tracked frame."""
        points = project(place(self.track, frame, self.head)[1], self.track.focal, self.track.principal)
        low, high = points.min(0), points.max(0)
        side = round(float((high - low).max()) * (1 + 2 * TILE_MARGIN))
        x, y = np.round((low + high - side) / 2).astype(int).tolist()
        close = Crop((x, y), (side, side), (TILE, TILE))
        rgb = self.track.lens.picture(rgb, frame)
        return scene(rgb, close, self.track, frame, self.landmarks, self.head)

    def _drawn(self, rgb: U8, frame: int, crop: Crop, modes: Sequence[str]) -> list[U8]:
        if not self.track.valid[frame]:
            return [crop.picture(rgb) for _ in modes]
        seen = scene(rgb, crop, self.track, frame, self.landmarks, self.head)
        return draw_modes(seen, modes, self.head, self.albedo)

    def _verdict(self, frame: int) -> tuple[str, tuple[int, int, int]]:
        """Confidence, why the frame is left out if it is, and the colour to say it in."""
        confidence, reason = float(self.track.confidence[frame]), self.reasons[frame]
        said = f"confidence {confidence:.2f}"
        if reason != "ok":
            return f"{said}, left out: {reason}", BAD
        return said, GOOD if confidence >= 0.5 else DOUBTFUL

    def _footer(self, frame: int) -> U8:
        """[FOOTER, W, 3]: a bar as long as the confidence, the time, and the verdict."""
        footer = np.full((FOOTER, self.size[0], 3), DARK, np.uint8)
        text, colour = self._verdict(frame)
        base = FOOTER - 11
        footer[:6, : round(self.size[0] * float(self.track.confidence[frame]))] = colour
        letter(footer, f"{self.track.time[frame]:.2f} s, frame {frame}", (LETTERS, base), LETTERS)
        letter(footer, text, (20 * LETTERS, base), LETTERS, colour)
        return footer


def around_face(points: NDArray[np.float32], size: tuple[int, int]) -> Crop:
    """The part of pictures of this size in which the face of landmarks [n, 478, 2] px always lies."""
    found = points[np.isfinite(points).any((1, 2))]
    low, high = np.nanmin(found, axis=1), np.nanmax(found, axis=1)
    margin = FACE_MARGIN * np.median(high - low, axis=0).max()
    first = np.floor(np.clip(low.min(0) - margin, 0, np.array(size) - 2)).astype(int)
    last = np.ceil(np.clip(high.max(0) + margin, first + 2, size)).astype(int)
    width, height = (last - first).tolist()
    scale = PANEL / max(width, height)
    # Even, so that the film's half is whole pixels.
    shown = (2 * max(1, round(width * scale / 2)), 2 * max(1, round(height * scale / 2)))
    return Crop((int(first[0]), int(first[1])), (width, height), shown)


def grid(pictures: list[U8], columns: int) -> U8:
    """Pictures of one size -> one picture, row by row; what is left over is dark."""
    blank = np.full_like(pictures[0], DARK[0])
    filled = [*pictures, *[blank] * (-len(pictures) % columns)]
    return np.concatenate(
        [np.concatenate(filled[start : start + columns], axis=1) for start in range(0, len(filled), columns)]
    )
