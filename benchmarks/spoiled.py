"""How a clip is tracked when its film is spoiled, and whether that is told: `python -m benchmarks spoiled VIDEO ...`.

The first seconds of a video are written anew as they are, and spoiled: compressed, in other light, with noise, out of
focus, without colours, shaken, with things pasted over the mouth, captions over the chin, enlarged by turns, and small
in a wide picture. Each goes through the command up to `judge`.

used            frames that are used by default, %
bare out        of those that nothing covers or shakes, which are left out; %
covered used    of those in which the mouth is covered all the way, or which are shaken as far, which are used; %
rmse, bias, r   lip opening of the other used frames against the copy that is not spoiled, mm
turn            how the head is turned there towards whoever looks at it, against the same without the constant, degrees
warnings        how each begins
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.enlarged import by_turns
from benchmarks.track_errors import rotation_error
from personalize.container import probe
from personalize.pictures import FrameReader
from personalize.quality import read_reasons
from personalize.run import read_landmarks, read_track
from personalize.sound import on_video_clock, read_audio
from personalize.video_writer import VideoWriter
from tracker.landmark_indices import LEFT_EYE_OUTER, LIPS, POINTS, RIGHT_EYE_OUTER
from tracker.track import F32, F64, Track

U8 = NDArray[np.uint8]
Picture = Callable[[U8, F32], U8]  # of a picture [H, W, 3] and its landmarks [478, 2] px

SECONDS = 13.0
GAMMA = 2.2
FOREHEAD = 151
DARK = (28, 25, 25)
WARNED = 36  # characters
WIDE = (1920, 1080)  # px
WORDS = ("EVERY", "two", "TENTHS", "of a second", "ANOTHER", "word", "COMES")
WORD_S = 0.4  # how long it stays
UNDER, LETTER = 0.55, 0.3  # how far under the mouth, and how high, of the distance between the eyes
WHITE = (255, 255, 255)
INSET = 2.6  # times the distance between the eyes: half of what is seen around a small face
BELOW = 1.3  # of the distance between the eyes: how far under the mouth a cover comes from


@dataclass(frozen=True)
class Spell(ABC):
    """Something that comes at the `times`, s, within `ramp` s, and stays for `hold` s."""

    times: tuple[float, ...]
    ramp: float
    hold: float

    def near(self, time: float) -> float:
        """0..1, 1 where it is there altogether."""
        inside = (min(time - t, t + 2 * self.ramp + self.hold - time) / self.ramp for t in self.times)
        return float(np.clip(max(inside), 0, 1))

    @abstractmethod
    def over(self, rgb: U8, points: F32, near: float) -> U8:
        """The picture [H, W, 3] with it; points: landmarks [478, 2] px."""


@dataclass(frozen=True)
class Shaken(Spell):
    """The camera moves aside while the shutter is open, by `far` of the distance between the eyes."""

    far: float = 0.3

    def over(self, rgb: U8, points: F32, near: float) -> U8:
        """The picture smeared."""
        eyes = float(np.linalg.norm(points[LEFT_EYE_OUTER] - points[RIGHT_EYE_OUTER]))
        length = round(near * self.far * eyes) if np.isfinite(eyes) else 0
        return rgb if length < 2 else np.asarray(cv2.blur(rgb, (length, 1)), np.uint8)


@dataclass(frozen=True)
class Cover(Spell):
    """Something that comes over the mouth from below.

    skin: as the forehead, or a dark ball. wide: of the distance between the eyes. aside: of that, to the left.
    """

    skin: bool = True
    wide: float = 1.0
    aside: float = 0.0

    def over(self, rgb: U8, points: F32, near: float) -> U8:
        """The picture with it."""
        if near == 0 or not np.isfinite(points).all():
            return rgb
        out = rgb.copy()
        eyes = float(np.linalg.norm(points[LEFT_EYE_OUTER] - points[RIGHT_EYE_OUTER]))
        middle = points[list(LIPS)].mean(0) + eyes * np.array([self.aside, BELOW * (1 - near)])
        if not self.skin:
            return cv2.circle(out, middle.round().astype(int).tolist(), round(self.wide * eyes / 2), DARK, -1)
        width, height = round(self.wide * eyes), round(0.75 * eyes)
        left, top = (middle - (width / 2, height / 2)).round().astype(int)
        skin = _around(rgb, points[FOREHEAD], 0.28 * eyes, 0.14 * eyes)
        fingers = 0.9 + 0.12 * np.sin(12 * np.linspace(0, 1, width))[None, :, None]
        patch = np.clip(cv2.resize(skin, (width, height)) * fingers, 0, 255)
        low, high = np.maximum((top, left), 0), np.minimum((top + height, left + width), rgb.shape[:2])
        if (high > low).all():
            shown = patch[low[0] - top : high[0] - top, low[1] - left : high[1] - left]
            out[low[0] : high[0], low[1] : high[1]] = shown
        return out


class Small:
    """The head, small in the corner of a wide picture, which is empty or shows a photograph.

    eyes: px between them. photograph: the film's first picture with a face.
    """

    def __init__(self, eyes: float, photograph: bool) -> None:
        self._eyes, self._with_photograph = eyes, photograph
        self._first: tuple[U8, F64] | None = None

    def __call__(self, rgb: U8, points: F32) -> U8:
        """The wide picture, blank until a face is seen."""
        if self._first is None:
            if not np.isfinite(points).all():
                return np.zeros((WIDE[1], WIDE[0], 3), np.uint8)
            self._first = rgb, self._inset(points)
        still, place = self._first
        out = np.full((WIDE[1], WIDE[0], 3), 200, np.uint8)
        if self._with_photograph:
            scale = WIDE[1] / still.shape[0]
            large = cv2.resize(still, None, fx=scale, fy=scale)[:, : WIDE[0] // 2]
            out[:, : large.shape[1]] = large
        side = round(2 * INSET * self._eyes)
        blurred = cv2.GaussianBlur(rgb, (0, 0), max(0.5 / place[0, 0] - 0.5, 0.01))
        out[-side:, -side:] = cv2.warpAffine(blurred, place, (side, side), flags=cv2.INTER_LINEAR)
        return out

    def _inset(self, points: F32) -> F64:
        """[2, 3] from px of the film to those of what is seen of it."""
        eyes = points[[RIGHT_EYE_OUTER, LEFT_EYE_OUTER]].astype(np.float64)
        scale = self._eyes / np.linalg.norm(eyes[1] - eyes[0])
        return np.column_stack([scale * np.eye(2), INSET * self._eyes - scale * eyes.mean(0)])


class Captioned:
    """Words one after another where the chin was in the first picture with a face."""

    def __init__(self, fps: float) -> None:
        self._held, self._shown = round(WORD_S * fps), 0
        self._first: tuple[F64, float] | None = None

    def __call__(self, rgb: U8, points: F32) -> U8:
        """The picture with its word."""
        word = WORDS[self._shown // self._held % len(WORDS)]
        self._shown += 1
        if self._first is None and np.isfinite(points).all():
            eyes = float(np.linalg.norm(points[LEFT_EYE_OUTER] - points[RIGHT_EYE_OUTER]))
            self._first = points[list(LIPS)].mean(0) + np.array([0, UNDER * eyes]), LETTER * eyes
        if self._first is None:
            return rgb
        middle, height = self._first
        out, font, bold = rgb.copy(), cv2.FONT_HERSHEY_DUPLEX, max(1, round(height / 10))
        size = cv2.getFontScaleFromHeight(font, max(2, round(height)), bold)
        (wide, high), _ = cv2.getTextSize(word, font, size, bold)
        left, base = (middle + np.array([-wide, high]) / 2).round().astype(int).tolist()
        for colour, thick in ((DARK, 3 * bold), (WHITE, bold)):
            cv2.putText(out, word, (left, base), font, size, colour, thick, cv2.LINE_AA)
        return out


class Enlarged:
    """Every other shot larger, about the picture's middle."""

    def __init__(self, fps: float) -> None:
        self._fps, self._shown = fps, 0

    def __call__(self, rgb: U8, _: F32) -> U8:
        """The picture, or the middle of it."""
        self._shown += 1
        return by_turns(rgb, (self._shown - 1) / self._fps)


def _around(rgb: U8, place: F32, wide: float, high: float) -> U8:
    """A rectangle of the picture, at least a pixel large."""
    reach = np.array([wide, high])
    left, top = np.maximum(place - reach, 0).astype(int)
    right, bottom = np.maximum(place + reach, (left + 1, top + 1)).astype(int)
    return rgb[top:bottom, left:right]


def lit(factor: float) -> Picture:
    """With so many times the light, in eight bits."""
    light = np.clip(factor * (np.arange(256) / 255) ** GAMMA, 0, 1)
    levels = np.round(255 * light ** (1 / GAMMA)).astype(np.uint8)
    return lambda rgb, _: levels[rgb]


def noisy(deviation: float) -> Picture:
    """With white noise, grey levels."""
    random = np.random.default_rng(0)
    return lambda rgb, _: np.clip(
        rgb + deviation * random.standard_normal(rgb.shape, np.float32) + 0.5, 0, 255
    ).astype(np.uint8)


def blurred(share: float) -> Picture:
    """By a Gaussian whose standard deviation is a share of the distance between the eyes."""

    def change(rgb: U8, points: F32) -> U8:
        eyes = float(np.linalg.norm(points[LEFT_EYE_OUTER] - points[RIGHT_EYE_OUTER]))
        return np.asarray(cv2.GaussianBlur(rgb, (0, 0), share * eyes), np.uint8) if np.isfinite(eyes) else rgb

    return change


def as_it_is(rgb: U8, _: F32) -> U8:
    """The same."""
    return rgb


def grey(rgb: U8, _: F32) -> U8:
    """Without colours."""
    return np.repeat(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)


WHOLE = "as it is"


def ways(fps: float) -> dict[str, tuple[Picture | Spell, int]]:
    """Name -> what is done to each picture, x264's crf. For one video: some remember its first picture."""
    return {
        WHOLE: (as_it_is, 12),
        "crf 30": (as_it_is, 30),
        "crf 36": (as_it_is, 36),
        "three times the light": (lit(3), 18),
        "a tenth of the light": (lit(0.1), 18),
        "noise": (noisy(30), 18),
        "out of focus": (blurred(0.021), 18),
        "no colours": (grey, 18),
        "a hand, four times": (Cover((1.5, 4.5, 7.5, 10.0), 0.3, 0.7), 18),
        "half a hand, slowly": (Cover((3.0,), 2.0, 2.0, wide=0.55, aside=0.28), 18),
        "shaken, four times": (Shaken((1.5, 4.5, 7.5, 10.0), 0.1, 0.3), 18),
        "a ball, for 5.5 s": (Cover((1.0,), 0.5, 5.5, skin=False, wide=0.56, aside=-0.1), 18),
        "a ball, from 1 s on": (Cover((1.0,), 0.3, SECONDS, skin=False, wide=0.56, aside=-0.1), 18),
        "captions": (Captioned(fps), 18),
        "enlarged by turns": (Enlarged(fps), 18),
        "small": (Small(62, photograph=False), 18),
        "small, by a photograph": (Small(75, photograph=True), 18),
    }


def write_spoiled(video: Path, out: Path, way: Picture | Spell, crf: int, points: F32) -> None:
    """The first SECONDS of a video, spoiled. points: [T, 478, 2] px, its landmarks; fewer count as none."""
    info = probe(video)
    sound = on_video_clock(*read_audio(video), SECONDS)
    none = np.full((POINTS, 2), np.nan, np.float32)

    def pictures() -> Iterator[tuple[float, U8]]:
        for frame, (time, rgb) in enumerate(FrameReader(video)):
            if time >= SECONDS:
                return
            marks = points[frame] if frame < len(points) else none
            yield time, way.over(rgb, marks, way.near(time)) if isinstance(way, Spell) else way(rgb, marks)

    changed = pictures()
    first = next(changed)
    height, width = first[1].shape[:2]
    with VideoWriter(out, info.fps, (width, height), sound, crf=crf) as writer:
        for time, rgb in chain([first], changed):
            writer.write(rgb, time)


def errors(run: Path, whole: Path, spell: Spell | None) -> list[float]:
    """[7]: used, bare out, covered used, %; against the run `whole` RMSE, bias, mm, and r of the openings, and turn."""
    track, right = (read_track(folder / "refine/track.npz") for folder in (run, whole))
    used = read_reasons(run / "refine/quality.csv") == "ok"
    near = np.array([spell.near(time) if spell else 0.0 for time in track.time])
    bare, covered = near == 0, near == 1
    known = used & bare & np.isin(np.round(track.time, 3), np.round(right.time[right.valid], 3))
    found, true = track.lip_gap_mm[known], np.interp(track.time[known], right.time, right.lip_gap_mm)
    error = (found - true).astype(np.float64)
    shares = [used.mean(), 1 - used[bare].mean(), used[covered].mean() if covered.any() else np.nan]
    r = float(np.corrcoef(found, true)[0, 1])
    same = np.searchsorted(right.time, track.time[known] - 1e-3)
    return [
        *(100 * float(share) for share in shares),
        float(np.sqrt((error**2).mean())),
        float(error.mean()),
        r,
        rotation_error(towards_camera(track, known), towards_camera(right, same)),
    ]


def towards_camera(track: Track, frames: NDArray[np.integer | np.bool_]) -> F64:
    """Head rotations [n, 3, 3] of some frames in a camera that looks at where the head is on average.

    In the corner of a wide picture a head that looks into the lens is turned aside for the camera.
    """
    ahead = Rotation.align_vectors([[0.0, 0.0, 1.0]], track.translation[frames].mean(0, keepdims=True))[0]
    return np.asarray((ahead * Rotation.from_rotvec(track.rotation[frames])).as_matrix())


def main() -> None:
    """Spoil, run and print, one video after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("videos", type=Path, nargs="+")
    for video in parser.parse_args().videos:
        columns = (
            *(("bare out", 10), ("covered used", 14)),
            *(("rmse", 7), ("bias", 7), ("r", 7), ("turn", 7)),
        )
        print(
            f"\n{video.name}\n{'':24s}{'used':>6s}", *(f"{name:>{wide}s}" for name, wide in columns), sep=""
        )
        with tempfile.TemporaryDirectory() as folder:
            spoil(video, Path(folder))


def spoil(video: Path, folder: Path) -> None:
    """All ways, in a folder for films and runs."""
    points, whole = np.zeros((0, POINTS, 2), np.float32), folder / f"{WHOLE}.run"
    for name, (way, crf) in ways(probe(video).fps).items():
        film, run = folder / f"{name}.mp4", folder / f"{name}.run"
        write_spoiled(video, film, way, crf, points)
        command = [sys.executable, "-m", "cli.main", "run", str(film), "--out", str(run), "--until", "judge"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        lines = done.stderr.splitlines()
        if done.returncode:
            said = lines[-1] if lines else f"exit code {done.returncode}"
            print(f"{name:24s}refused: {said.removeprefix(f'personalize: {film}: ')[:90]}", flush=True)
            if name == WHOLE:  # there is nothing to compare with
                return
            continue
        if name == WHOLE:
            points = read_landmarks(run / "landmarks/landmarks.npz").points[..., :2]
        used, out, covered, rmse, bias, r, turn = errors(run, whole, way if isinstance(way, Spell) else None)
        warnings = [line.removeprefix("warning: ") for line in lines if line.startswith("warning: ")]
        warned = "; ".join(text[:WARNED] for text in warnings if "of usable face" not in text)
        print(
            f"{name:24s}{used:6.1f}{out:10.1f}{covered:14.1f}{rmse:7.2f}{bias:7.2f}{r:7.3f}{turn:7.2f}  {warned}",
            flush=True,
        )


if __name__ == "__main__":
    main()
