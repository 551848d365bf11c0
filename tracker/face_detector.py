"""Face detection: BlazeFace short range on the whole picture, or on parts of it for small faces."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.halving import halved
from tracker.networks import open_network
from tracker.track import F32

INPUT_SIZE = 128  # px, side of the network's square input
MIN_SCORE = 0.5
MIN_OVERLAP = 0.3  # detections that overlap more (intersection over union) are one face
TILE_DIVISORS = (2, 3, 5)  # tile side = long side / divisor; the last finds eyes 36 px apart in 1920
HEAD_MARGIN = 0.5  # of a face's width and height, to each side
KEYPOINTS = 6  # right eye, left eye, nose tip, mouth, right ear, left ear (the subject's)


@dataclass(frozen=True)
class Face:
    """One detected face in pixels of the picture, pixel centres at integers.

    box: [4] left, top, right, bottom. keypoints: [6, 2] right eye, left eye, nose tip, mouth, right ear, left
    ear (the subject's). score: 0..1.
    """

    box: F32
    keypoints: F32
    score: float


def anchors() -> F32:
    """Anchor centres [896, 2] (x, y) in 0..1: 16 x 16 cells of two anchors, then 8 x 8 cells of six."""
    centres = []
    for cells, repeats in ((16, 2), (8, 6)):
        y, x = np.mgrid[:cells, :cells].reshape(2, -1)
        centres.append(np.repeat(np.stack([x, y], 1) + 0.5, repeats, axis=0) / cells)
    return np.concatenate(centres).astype(np.float32)


def decode(regressors: F32, logits: F32, centres: F32) -> tuple[F32, F32]:
    """The network's output as points and scores of the anchors above MIN_SCORE.

    regressors: [896, 16], logits: [896], centres: [896, 2]. Returns points [N, 8, 2] in 0..1 of the input
    (left top, right bottom, six keypoints) and scores [N] in 0..1.
    """
    scores = 1.0 / (1.0 + np.exp(-np.clip(logits, -80.0, 80.0)))
    keep = scores >= MIN_SCORE
    values = regressors[keep].reshape(-1, 2 + KEYPOINTS, 2) / INPUT_SIZE
    centre, extent = values[:, 0] + centres[keep], values[:, 1]
    corners = np.stack([centre - extent / 2, centre + extent / 2], 1)
    points = np.concatenate([corners, values[:, 2:] + centres[keep, None]], 1)
    return points.astype(np.float32), scores[keep].astype(np.float32)


def overlaps(box: F32, boxes: F32) -> F32:
    """Intersection over union [N] of box [2, 2] with boxes [N, 2, 2] (left top, right bottom)."""
    sides = np.minimum(box[1], boxes[:, 1]) - np.maximum(box[0], boxes[:, 0])
    shared = np.prod(np.maximum(sides, 0.0), axis=1)
    union = np.prod(box[1] - box[0]) + np.prod(boxes[:, 1] - boxes[:, 0], axis=1) - shared
    return (shared / np.maximum(union, 1e-9)).astype(np.float32)


def merge(points: F32, scores: F32) -> list[tuple[F32, float]]:
    """Weighted non-maximum suppression: overlapping detections become their mean weighted by score.

    points: [N, 8, 2] as from `decode`, scores: [N]. Returns (points [8, 2], best score) a face, best first.
    """
    order = np.argsort(-scores, kind="stable")
    points, scores = points[order], scores[order]
    faces = []
    while len(scores):
        same = overlaps(points[0, :2], points[:, :2]) > MIN_OVERLAP
        same[0] = True  # also when its box is empty
        weights = scores[same] / scores[same].sum()
        faces.append((np.einsum("n,nkc->kc", weights, points[same]).astype(np.float32), float(scores[0])))
        points, scores = points[~same], scores[~same]
    return faces


def merged(faces: Iterable[Face]) -> list[Face]:
    """Faces found in several parts of a picture, each once, best score first."""
    found = list(faces)
    points = [np.concatenate([face.box.reshape(2, 2), face.keypoints]) for face in found]
    return _faces(np.stack(points), np.array([face.score for face in found], np.float32)) if found else []


def _faces(points: F32, scores: F32) -> list[Face]:
    """As `merge`."""
    return [Face(p[:2].reshape(4), p[2:], score) for p, score in merge(points, scores)]


def letterbox(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float, tuple[int, int]]:
    """The picture [H, W, 3] inside a black INPUT_SIZE square: (square, scale, (left, top) border in px)."""
    times = int(np.log2(max(*rgb.shape[:2], INPUT_SIZE) / INPUT_SIZE))
    rgb = halved(rgb, times)
    height, width = rgb.shape[:2]
    scale = INPUT_SIZE / max(height, width)
    inner = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(rgb, inner, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    left, top = (INPUT_SIZE - inner[0]) // 2, (INPUT_SIZE - inner[1]) // 2
    square = np.zeros((INPUT_SIZE, INPUT_SIZE, 3), np.uint8)
    square[top : top + inner[1], left : left + inner[0]] = small
    return square, scale / 2**times, (left, top)


def tiles(width: int, height: int, divisor: int) -> Iterator[tuple[int, int, int]]:
    """Squares (left, top, side = long side / divisor) that cover the picture and overlap by half or more."""
    side = -(-max(width, height) // divisor)

    def starts(length: int) -> NDArray[np.int64]:
        spare = max(0, length - side)
        return np.linspace(0, spare, 1 + -(-2 * spare // side)).round().astype(np.int64)

    for top in starts(height):
        for left in starts(width):
            yield int(left), int(top), side


def around(rgb: NDArray[np.uint8], box: F32) -> tuple[NDArray[np.uint8], tuple[int, int]]:
    """The surroundings of a face's box [4] px, three times as large, and their (left, top) corner in the picture."""
    side = 1.5 * max(box[2] - box[0], box[3] - box[1])
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    left, top = max(0, int(x - side)), max(0, int(y - side))
    return rgb[top : int(y + side) + 1, left : int(x + side) + 1], (left, top)


def holds(box: F32, other: F32) -> bool:
    """Whether the middle of `other` lies in `box`, both [4] px."""
    middle = (other[:2] + other[2:]) / 2
    return bool((middle > box[:2]).all() and (middle < box[2:]).all())


def _head(box: F32) -> F32:
    """[4] px, what the head with its hair takes around the box [4] px of its face."""
    margin = HEAD_MARGIN * (box[2:] - box[:2])
    return np.concatenate([box[:2] - margin, box[2:] + margin])


class FaceDetector:
    """The detection network with its anchors."""

    def __init__(self, network: bytes, threads: int = 1) -> None:
        """network: the .tflite file's bytes."""
        self._network = open_network(network, threads)
        self._input = self._network.get_input_details()[0]["index"]
        outputs = {tuple(d["shape"]): d["index"] for d in self._network.get_output_details()}
        self._regressors, self._logits = outputs[(1, 896, 16)], outputs[(1, 896, 1)]
        self._anchors = anchors()

    def detect(self, rgb: NDArray[np.uint8]) -> list[Face]:
        """Faces in rgb [H, W, 3] u8, best score first: those that are no small part of it."""
        return self._detect_in(rgb, (0, 0))

    def detect_near(self, rgb: NDArray[np.uint8], box: F32) -> list[Face]:
        """Faces in the surroundings of a box [4] px, best score first."""
        part, (left, top) = around(rgb, box)
        return self._detect_in(part, (left, top)) if part.size else []

    def search(self, rgb: NDArray[np.uint8], besides: Sequence[F32] = ()) -> list[Face]:
        """Faces in ever smaller tiles of rgb [H, W, 3], best score first.

        besides: [4] px, boxes of faces that are known: what is found in their heads is none.
        """
        height, width = rgb.shape[:2]
        heads = [_head(box) for box in besides]
        parts = (
            self._detect_in(rgb[top : top + side, left : left + side], (left, top))
            for divisor in TILE_DIVISORS
            for left, top, side in tiles(width, height, divisor)
        )
        faces = merged(face for part in parts for face in part)
        return [face for face in faces if not any(holds(head, face.box) for head in heads)]

    def _detect_in(self, rgb: NDArray[np.uint8], offset: tuple[int, int]) -> list[Face]:
        """Faces, in px of the whole picture, in one cut-out at `offset` (left, top)."""
        square, scale, border = letterbox(rgb)
        self._network.set_tensor(self._input, (square.astype(np.float32) / 127.5 - 1.0)[None])
        self._network.invoke()
        regressors = self._network.get_tensor(self._regressors)[0]
        logits = self._network.get_tensor(self._logits)[0, :, 0]
        points, scores = decode(regressors, logits, self._anchors)
        # Edges of the input are at 0 and 1, so pixel centres are at (i + 0.5) / INPUT_SIZE.
        pixels = (points * INPUT_SIZE - np.array(border, np.float32)) / scale - 0.5
        return _faces(pixels + np.array(offset, np.float32), scores)
