"""478 face landmarks and 52 blendshape scores per frame, with Google's Face Landmarker networks.

Pixel centres are at integers throughout. The network's own coordinates put them at halves (a mirror test
shows a shift of half a crop pixel); sampling the crop at its pixels' centres and reading the output in units
of the crop's width, edge to edge, leaves none. Every crop is also read mirrored and the two are averaged: on
rendered heads this takes a fifth off the jitter and an eighth off the error of the lips, for 6 ms a frame of a
second processor.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.resources import files
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.face_detector import Face, FaceDetector, holds
from tracker.halving import halved
from tracker.landmark_indices import (
    BLENDSHAPE_INPUT,
    BLENDSHAPE_NAMES,
    LEFT_EYE_OUTER,
    MIRRORED,
    POINTS,
    RIGHT_EYE_OUTER,
)
from tracker.networks import open_network
from tracker.track import F32, STEP_S, Landmarks

INPUT_SIZE = 256  # px, side of the landmark network's square input
MARGIN = 1.5  # side of the region over the long side of the face's box
MIN_PRESENCE = 0.5  # below, the face counts as lost
# How far a crop and its mirror image may be read apart, as a share of the face, and what halves the presence. Faces
# that are seen are below .02 but behind a hand (.03) and half out of the picture (.04); in profile, where the network
# invents faces, .05 to .26 are usual.
APART, APART_HALF = 0.02, 0.04
SEARCH_INTERVAL = 10  # frames between searches in tiles while no face is found: each is dozens of detections
# Share of the new frame's region in the smoothed one, STEP_S after the last. A region that jumps adds jitter, one that
# lags costs up to .5 px where a face crosses its own width in a second.
SMOOTHING = 0.35


@dataclass(frozen=True)
class Roi:
    """A rotated square in the picture: centre x, y px, side px, angle rad (x to y)."""

    x: float
    y: float
    side: float
    angle: float

    def to_picture(self) -> NDArray[np.float64]:
        """[2, 3] affine map from the unit square (0..1, edge to edge) to picture pixels."""
        cos, sin = self.side * np.cos(self.angle), self.side * np.sin(self.angle)
        linear = np.array([[cos, -sin], [sin, cos]])
        offset = np.array([self.x, self.y]) - linear @ (0.5, 0.5)
        return np.column_stack([linear, offset])

    def blend(self, other: Roi, share: float) -> Roi:
        """This region moved towards `other` by `share` (0..1) of the way."""
        turn = (other.angle - self.angle + np.pi) % (2 * np.pi) - np.pi
        return Roi(
            self.x + share * (other.x - self.x),
            self.y + share * (other.y - self.y),
            self.side + share * (other.side - self.side),
            self.angle + share * turn,
        )


def roi_from_face(face: Face) -> Roi:
    """The region of a detection: its box's long side x MARGIN, level with the eyes."""
    (left, top, right, bottom), (right_eye, left_eye) = face.box, face.keypoints[:2]
    return _roi((left, top), (right, bottom), left_eye - right_eye)


def roi_from_points(points: F32) -> Roi:
    """The region around landmarks [478, 2 or 3] px: their box's long side x MARGIN, level with the eyes."""
    xy = points[:, :2]
    return _roi(xy.min(0), xy.max(0), xy[LEFT_EYE_OUTER] - xy[RIGHT_EYE_OUTER])


def _roi(low: Iterable[float], high: Iterable[float], eyes: F32) -> Roi:
    (left, top), (right, bottom) = low, high
    side = MARGIN * max(right - left, bottom - top, 1.0)
    return Roi(
        float(left + right) / 2, float(top + bottom) / 2, float(side), float(np.arctan2(eyes[1], eyes[0]))
    )


def crop(rgb: NDArray[np.uint8], roi: Roi) -> NDArray[np.uint8]:
    """The region of rgb [H, W, 3] as [INPUT_SIZE, INPUT_SIZE, 3], the picture's border repeated outside."""
    to_picture = roi.to_picture()
    # Pixel i of the crop is centred at (i + 0.5) / INPUT_SIZE of the unit square.
    linear = to_picture[:, :2] / INPUT_SIZE
    offset = to_picture[:, 2] + linear @ (0.5, 0.5)
    # Reading single pixels of a far larger region would alias: average whole blocks first.
    times = int(np.log2(max(roi.side / INPUT_SIZE, 1)))
    if times:
        block = 2**times
        corner, part = _around(rgb, roi, block)
        rgb = halved(part, times)
        linear, offset = linear / block, (offset - corner + 0.5) / block - 0.5
    return cv2.warpAffine(
        rgb,
        np.column_stack([linear, offset]),
        (INPUT_SIZE, INPUT_SIZE),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _around(rgb: NDArray[np.uint8], roi: Roi, block: int) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Corner (x, y) px, and part of rgb [H, W, 3] around `roi`: whole blocks of block x block pixels."""
    size = np.array([rgb.shape[1], rgb.shape[0]])
    reach = roi.side * (abs(np.cos(roi.angle)) + abs(np.sin(roi.angle))) / 2 + block
    low = np.clip(np.floor(np.array([roi.x, roi.y]) - reach), 0, size - block).astype(np.int64)
    blocks = np.clip((2 * reach) // block, 1, (size - low) // block).astype(np.int64)
    (left, top), (right, bottom) = low, low + blocks * block
    return low, rgb[top:bottom, left:right]


class FaceLandmarker:
    """The three networks of the embedded Face Landmarker; not for use by several threads at once."""

    def __init__(self, threads: int = 1) -> None:
        """threads: of each network; more than one does not pay on two cores (benchmarks/landmarks.py)."""
        with files("tracker").joinpath("assets/face_landmarker.task").open("rb") as file:
            archive = zipfile.ZipFile(file)
            self.detector = FaceDetector(archive.read("face_detector.tflite"), threads)
            landmarks = archive.read("face_landmarks_detector.tflite")
            blendshapes = archive.read("face_blendshapes.tflite")
        self._landmarks, self._mirrored = (_Network(landmarks, threads) for _ in range(2))
        self._beside = ThreadPoolExecutor(1)  # for the mirror image, on another processor where there is one
        self._blendshapes = _Network(blendshapes, threads)

    def landmarks(self, rgb: NDArray[np.uint8], roi: Roi) -> tuple[F32, float, F32]:
        """Landmarks of the face in one region of rgb [H, W, 3] u8.

        Returns points [478, 3] (x, y in picture pixels, z in the same scale), presence 0..1, blendshapes [52]
        in the order of BLENDSHAPE_NAMES, 0..1. They are meaningless when presence is low.
        """
        picture = crop(rgb, roi).astype(np.float32) / 255.0
        reading = self._beside.submit(_read, self._mirrored, np.ascontiguousarray(picture[:, ::-1]))
        unit, logit = _read(self._landmarks, picture)
        mirrored, mirrored_logit = reading.result()
        mirrored = mirrored[MIRRORED]
        mirrored[:, 0] = 1 - mirrored[:, 0]
        agreed = agreement(unit, mirrored)
        unit = (unit + mirrored) / 2
        to_picture = roi.to_picture()
        xy = unit[:, :2] @ to_picture[:, :2].T + to_picture[:, 2]
        points = np.column_stack([xy, unit[:, 2] * roi.side]).astype(np.float32)
        (scores,) = self._blendshapes(points[None, BLENDSHAPE_INPUT, :2])
        presence = 1.0 / (1.0 + np.exp(-(logit + mirrored_logit) / 2))
        return points, float(presence) * agreed, scores.reshape(52)


def agreement(one: F32, other: F32) -> float:
    """0..1, less the farther two readings [478, 3] of one face lie apart."""
    xy = (one + other)[:, :2] / 2
    apart = np.linalg.norm((one - other)[:, :2], axis=1).mean() / np.ptp(xy, axis=0).max()
    return float(np.exp2(-max(apart - APART, 0.0) / (APART_HALF - APART)))


class _Network:
    """A .tflite network with one input, its outputs in the order of their names."""

    def __init__(self, content: bytes, threads: int) -> None:
        self._interpreter = open_network(content, threads)
        self._input = self._interpreter.get_input_details()[0]["index"]
        outputs = sorted(self._interpreter.get_output_details(), key=lambda d: str(d["name"]))
        self._outputs = [d["index"] for d in outputs]

    def __call__(self, values: F32) -> list[F32]:
        self._interpreter.set_tensor(self._input, values)
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(i) for i in self._outputs]


def _read(network: _Network, picture: F32) -> tuple[F32, float]:
    """Points [478, 3] in units of the crop's width and the logit of presence, from one crop in 0..1."""
    # The third output is a flag for a tongue that is out, which the 52 scores do without.
    points, presence, _ = network(picture[None])
    return points.reshape(POINTS, 3) / np.float32(INPUT_SIZE), float(presence.reshape(()))


class LandmarkTracker:
    """Follows one face, the largest unless told where: the landmarks of one frame give the region of the next."""

    def __init__(self, landmarker: FaceLandmarker) -> None:
        self._landmarker = landmarker
        self._roi: Roi | None = None
        self._frames_without = 0

    def reset(self) -> None:
        """Forgets the face: the next frame begins another shot."""
        self._roi = None
        self._frames_without = 0

    def next(
        self, rgb: NDArray[np.uint8], box: F32 | None = None, step_s: float = STEP_S
    ) -> tuple[F32, float, F32] | None:
        """Landmarks, presence and blendshapes (as `FaceLandmarker.landmarks`) of the next frame, or None.

        box: [4] left, top, right, bottom px of the face that is meant, where it is known. step_s: since the last one.
        """
        if (
            self._roi is not None
            and box is not None
            and not holds(box, np.array([self._roi.x, self._roi.y] * 2, np.float32))
        ):
            self.reset()
        if self._roi is not None:
            found = self._landmarker.landmarks(rgb, self._roi)
            if found[1] >= MIN_PRESENCE:
                share = 1 - (1 - SMOOTHING) ** (step_s / STEP_S)
                self._roi = self._roi.blend(roi_from_points(found[0]), share)
                return found
        return self._search(rgb, box)

    def _search(self, rgb: NDArray[np.uint8], box: F32 | None) -> tuple[F32, float, F32] | None:
        self._roi = None
        detector, due = self._landmarker.detector, self._frames_without % SEARCH_INTERVAL == 0
        self._frames_without += 1
        faces = _widest_first(detector.detect(rgb))
        if box is not None:
            # One too small for the whole picture is missed there, or seen at a wrong size, or beside another.
            faces += _widest_first(detector.detect_near(rgb, box))
            faces = [face for face in faces if holds(box, face.box)]
        elif due and not faces:
            faces = _widest_first(detector.search(rgb))
        for face in faces:
            points, presence, _ = self._landmarker.landmarks(rgb, roi_from_face(face))
            if presence < MIN_PRESENCE:
                continue
            # Once more in the region that the following frames will have: a detection's is another size.
            roi = roi_from_points(points)
            found = self._landmarker.landmarks(rgb, roi)
            if found[1] >= MIN_PRESENCE:
                self._roi, self._frames_without = roi_from_points(found[0]), 0
                return found
        return None


def _widest_first(faces: list[Face]) -> list[Face]:
    return sorted(faces, key=lambda face: face.box[0] - face.box[2])


class Watcher(Protocol):
    """Learns something else from the pictures while landmarks are read, with no pass over the video of its own."""

    def see(self, rgb: NDArray[np.uint8], points: F32, /) -> None:
        """The next picture [H, W, 3] and its landmarks [478, 3] px, NaN where there is no face."""


def track_landmarks(
    frames: Iterable[tuple[float, NDArray[np.uint8]]],
    total: int,
    cuts: set[int] | None = None,
    boxes: F32 | None = None,
    progress: Callable[[int, int], None] | None = None,
    watchers: Sequence[Watcher] = (),
) -> Landmarks:
    """Landmarks of a whole clip.

    frames: (time s, rgb [H, W, 3] u8) in order, all of one size, at least one. total: how many, for progress.
    cuts: indices of frames that begin another shot, where nothing is taken over from the frame before.
    boxes: [T, 4] px, left, top, right, bottom of the face that is meant, NaN where it is not known.
    watchers: see each picture with its landmarks.
    """
    tracker = LandmarkTracker(FaceLandmarker())
    times: list[float] = []
    rows: list[tuple[F32, float, F32]] = []
    nothing = (np.full((POINTS, 3), np.nan, np.float32), 0.0, np.zeros(52, np.float32))
    size = (0, 0)
    for index, (time, rgb) in enumerate(frames):
        if cuts is not None and index in cuts:
            tracker.reset()
        step_s = time - times[-1] if times else STEP_S
        times.append(time)
        box = None if boxes is None or np.isnan(boxes[index]).any() else boxes[index]
        rows.append(tracker.next(rgb, box, step_s) or nothing)
        size = (rgb.shape[1], rgb.shape[0])
        for watcher in watchers:
            watcher.see(rgb, rows[-1][0])
        if progress is not None:
            progress(index + 1, total)
    assert rows, "a clip without frames"
    points, presence, blendshapes = zip(*rows)
    return Landmarks(
        time=np.array(times, np.float64),
        points=np.stack(points),
        presence=np.array(presence, np.float32),
        blendshapes=np.stack(blendshapes),
        blendshape_names=BLENDSHAPE_NAMES,
        size=size,
    )
