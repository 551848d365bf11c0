"""Whose face is where: detections joined to tracklets, tracklets joined to people by the shape of the face."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from tracker.face_detector import Face, around, holds, overlaps
from tracker.landmark_bias import landmark_bias
from tracker.landmarker import FaceLandmarker, roi_from_face
from tracker.similarity import similarity

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

PATCH = 64  # px, side of the face for light and sharpness
MIDDLE = np.s_[PATCH // 4 :, PATCH // 5 : -PATCH // 5]  # of it: no background, which may be a white wall
BRIGHTEST = 250  # a colour value that the camera may have cut off
MIN_OVERLAP = 0.3  # intersection over union of a face's boxes from one picture to the next
SURE_OVERLAP = 0.5  # below which it is looked for once more: a head that is small may be taken for a face
WIDER = 1.5  # times the foremost face, until another is it
MAX_LOST_S = 0.4  # a face unseen for longer is another tracklet
SAMPLE_S = 0.6  # time between two looks at the face's shape
MIN_PRESENCE = 0.5  # of the landmarker: what it does not take for a face is none, whatever the detector says
SEARCH_S, SELDOM_S = 1.0, 3.0  # between searches for small faces in tiles: while none is seen, while some are
# Landmarks of a face that differ by less (of norm 1) in such a share of so many looks or more are a photograph's: in
# film these come to .0005, people who listen to .005 in any two seconds.
STILL, STILL_SHARE, STILL_LOOKS = 0.001, 0.75, 4
PORTRAIT = (12, 14)  # px, width and height of the grey picture that people are told apart by
# Of pairs of shots of 2 s of one person 1 % (94 people rendered) and 12 % (seven filmed, mostly of one who laughs and
# weeps) lie farther apart; of two people's 1 % (rendered: one hair style) lie nearer, and none (filmed: 2.4 and more).
SHAPE_SCALE, PORTRAIT_SCALE, OTHER_PERSON = 10.0, 0.25, 1.7
MOST_LOOKS = 100  # of a face, to bound memory
TURN = 2  # how many of the features of a face say how it is turned


@dataclass(frozen=True)
class Sighting:
    """One face in one picture.

    frame: index. time: s. box: [4] px. eyes: px between the eyes. light: mean grey level of the face. burnt: share of
    its colour values that cannot be brighter. sharpness: see `sharpness`. sample: every SAMPLE_S the landmarks
    [478, 3] px and a PORTRAIT, unless the landmarker takes it for no face.
    """

    frame: int
    time: float
    box: F32
    eyes: float
    light: float
    burnt: float
    sharpness: float
    sample: tuple[F32, U8] | None = None

    @property
    def measures(self) -> list[float]:
        """[8]: box, eyes, light, burnt, sharpness."""
        return [*self.box, self.eyes, self.light, self.burnt, self.sharpness]


@dataclass(eq=False)
class Tracklet:
    """One face followed from picture to picture.

    latest: the landmarks of its last samples. still: by these it is a photograph.
    """

    sightings: list[Sighting]
    next_sample: float = -1.0
    latest: deque[F32] = field(default_factory=lambda: deque(maxlen=STILL_LOOKS))
    still: bool = False

    @property
    def box(self) -> F32:
        """[4] px, where it was last seen."""
        return self.sightings[-1].box

    @property
    def frames(self) -> list[int]:
        """Indices."""
        return [sighting.frame for sighting in self.sightings]

    @property
    def shapes(self) -> list[F32]:
        """The landmarks of its samples."""
        return [sighting.sample[0] for sighting in self.sightings if sighting.sample]

    def some_looks(self) -> list[tuple[F32, U8]]:
        """MOST_LOOKS of its samples at most, spread over time."""
        looks = [sighting.sample for sighting in self.sightings if sighting.sample]
        return [
            looks[k] for k in np.linspace(0, len(looks) - 1, min(len(looks), MOST_LOOKS)).round().astype(int)
        ]

    @property
    def weight(self) -> float:
        """How much the face is in the picture: its frames times its width."""
        return float(sum(sighting.box[2] - sighting.box[0] for sighting in self.sightings))

    def shots(self, segment: NDArray[np.int32]) -> list[Tracklet]:
        """Its parts in each uninterrupted shot, whose number is segment [T]: behind a cut it may be somebody else."""
        return [
            Tracklet(list(part)) for _, part in groupby(self.sightings, lambda seen: int(segment[seen.frame]))
        ]


class FaceFollower:
    """Finds every face in every picture and joins those that overlap, be there a cut between them or not."""

    def __init__(self, landmarker: FaceLandmarker) -> None:
        self._landmarker = landmarker
        self._open: list[Tracklet] = []
        self._searched = -np.inf
        self._foremost: Tracklet | None = None
        self.tracklets: list[Tracklet] = []

    def add(self, index: int, time: float, rgb: U8, sudden: bool = False) -> None:
        """Look at the next picture [H, W, 3]. sudden: there may be a cut before it, and every face another one."""
        if sudden:
            for followed in self._open:
                followed.next_sample = time
                followed.latest.clear()
        self._open = [t for t in self._open if time - t.sightings[-1].time <= MAX_LOST_S]
        waiting = list(self._open)
        for face in self._find(time, rgb):
            shared = _overlaps(face.box, [followed.box for followed in waiting])
            if max(shared, default=0.0) >= MIN_OVERLAP:
                tracklet = waiting.pop(int(shared.argmax()))
            else:
                tracklet = Tracklet([])
                self.tracklets.append(tracklet)
                self._open.append(tracklet)
            patch = _face_patch(rgb, face.box)
            grey = cv2.cvtColor(patch, cv2.COLOR_RGB2GRAY)
            sighting = Sighting(
                index,
                time,
                face.box,
                eyes=float(np.linalg.norm(face.keypoints[0] - face.keypoints[1])),
                light=float(grey.mean()),
                burnt=float((patch[MIDDLE] >= BRIGHTEST).mean()),
                sharpness=sharpness(grey),
                sample=self._sample(tracklet, time, face, rgb),
            )
            tracklet.sightings.append(sighting)
        seen = [face for face in self._no_photographs if face.sightings[-1].frame == index]
        widest = max(seen, key=lambda face: _width(face.box), default=None)
        same = self._foremost if any(face is self._foremost for face in seen) else None
        if same is None or widest is None or _width(widest.box) > WIDER * _width(same.box):
            self._foremost = widest

    @property
    def boxes(self) -> list[F32]:
        """[4] px of each face that is being followed, where it was last seen."""
        return [followed.box for followed in self._open]

    @property
    def widest(self) -> F32 | None:
        """[4] px, where the widest face that is being followed was last seen; a photograph's if there is no other."""
        return max((face.box for face in self._no_photographs or self._open), key=_width, default=None)

    @property
    def foremost(self) -> F32 | None:
        """[4] px of the face in the last picture by which cuts are told, no photograph's; None without any.

        The widest, but the same as before as long as no other is clearly wider: two would differ as at a cut.
        """
        return None if self._foremost is None else self._foremost.box

    @property
    def _no_photographs(self) -> list[Tracklet]:
        return [followed for followed in self._open if not followed.still]

    def _find(self, time: float, rgb: U8) -> list[Face]:
        detector = self._landmarker.detector
        faces = detector.detect(rgb)
        # One too small for the whole picture is missed there, or seen at a wrong size, or beside another.
        seen = [face.box for face in faces]
        missed = [box for box in self.boxes if max(_overlaps(box, seen), default=0.0) < SURE_OVERLAP]
        # The surroundings of two may show the same face.
        faces = apart([*faces, *(face for box in missed for face in detector.detect_near(rgb, box))])
        if time - self._searched >= (SELDOM_S if faces else SEARCH_S):
            self._searched = time
            faces += apart(detector.search(rgb, besides=[face.box for face in faces]))
        return faces

    def _sample(self, tracklet: Tracklet, time: float, face: Face, rgb: U8) -> tuple[F32, U8] | None:
        if time < tracklet.next_sample:
            return None
        tracklet.next_sample = time + SAMPLE_S
        points, presence, _ = self._landmarker.landmarks(rgb, roi_from_face(face))
        if presence < MIN_PRESENCE:
            return None
        tracklet.latest.append(points)
        tracklet.still = is_photograph(tracklet.latest)
        return points, _portrait(rgb, points)


def _width(box: F32) -> float:
    return float(box[2] - box[0])


def apart(faces: list[Face]) -> list[Face]:
    """Of faces one of which holds the other's middle the surer, best score first."""
    kept: list[Face] = []
    for face in sorted(faces, key=lambda face: -face.score):
        if not any(holds(face.box, other.box) or holds(other.box, face.box) for other in kept):
            kept.append(face)
    return kept


def sureness_of_turns(landmarker: FaceLandmarker, rgb: U8, box: F32) -> F64:
    """[4] how surely a face is found around a box: as it is, and turned by one, two and three quarters to the left.

    One that lies on its side or head is found too, often as an upright one, but less surely.
    """
    part, _ = around(rgb, box)
    pictures = (np.ascontiguousarray(np.rot90(part, quarters)) for quarters in range(4))
    return np.array(
        [max((face.score for face in landmarker.detector.detect(p)), default=0.0) for p in pictures]
    )


def _face_patch(rgb: U8, box: F32) -> U8:
    """The face as [PATCH, PATCH, 3]."""
    left, top, right, bottom = np.round(box).astype(int)
    part = rgb[max(0, top) : max(0, bottom) + 1, max(0, left) : max(0, right) + 1]
    part = part if part.size else np.zeros((1, 1, 3), np.uint8)
    return np.asarray(cv2.resize(part, (PATCH, PATCH), interpolation=cv2.INTER_AREA), np.uint8)


def _portrait(rgb: U8, points: F32) -> U8:
    """The head with its hair as a grey picture of size PORTRAIT, eyes and mouth always at the same places."""
    features = np.stack([points[i, :2].mean(0) for i in ((33, 133), (362, 263), (61, 291))])
    places = np.array([[22, 30], [42, 30], [32, 52]], np.float32)
    to_portrait, _ = cv2.estimateAffinePartial2D(features, places)
    if to_portrait is None:  # points that coincide
        return np.zeros(PORTRAIT[::-1], np.uint8)
    blur = 0.5 / max(float(np.sqrt(abs(np.linalg.det(to_portrait[:, :2])))), 1e-3)
    head = cv2.warpAffine(
        cv2.GaussianBlur(rgb, (0, 0), blur), to_portrait, (64, 72), borderMode=cv2.BORDER_REPLICATE
    )
    return cv2.cvtColor(cv2.resize(head, PORTRAIT, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)


def sharpness(grey: U8) -> float:
    """Standard deviation of the finest details of a picture over that of the whole: 0 for a flat one."""
    return float(cv2.Laplacian(grey, cv2.CV_32F).std() / (grey.std() + 1.0))


def _overlaps(box: F32, others: list[F32]) -> F32:
    """Intersection over union [n] of a box [4] px with n others."""
    return overlaps(box.reshape(2, 2), np.reshape(others, (-1, 2, 2)))


def align(shapes: F64, reference: F64) -> F64:
    """Shapes [N, 478, 3] centred, scaled to norm 1 and turned onto `reference` [478, 3]."""
    shapes = shapes - shapes.mean(1, keepdims=True)
    shapes = shapes / np.sqrt((shapes**2).sum((1, 2), keepdims=True))
    _, rotation, _ = similarity(shapes, reference)
    return shapes @ rotation.transpose(0, 2, 1)


def is_photograph(shapes: Sequence[F32]) -> bool:
    """Whether landmarks [478, 3] of a face at several times hardly ever move, as those of a photograph on a slide."""
    if len(shapes) < STILL_LOOKS:
        return False
    aligned = align(np.asarray(shapes, np.float64), np.asarray(shapes[0], np.float64))
    moved = np.linalg.norm(aligned - np.median(aligned, axis=0), axis=(1, 2))
    return float(np.quantile(moved, STILL_SHARE)) < STILL


def differences(faces: Sequence[Tracklet]) -> F64:
    """[n, n] between faces that have samples, each by the two looks that are most alike: heads turn, faces move.

    Of two looks: the distance of their shapes, without what goes with how they are turned (see
    tracker.landmark_bias), and the lack of correlation of their portraits.
    """
    looks = [face.some_looks() for face in faces]
    first = np.cumsum([0, *map(len, looks)])
    shapes, pictures = zip(*(look for of_face in looks for look in of_face))
    scores = landmark_bias().features(np.stack(shapes))[0][:, TURN:]
    portraits = np.stack([picture.ravel() for picture in pictures]).astype(np.float64)
    apart = np.zeros((len(faces), len(faces)))
    for row, (start, end) in enumerate(pairwise(first)):
        # A flat picture is like no other.
        uncorrelated = np.nan_to_num(cdist(portraits[start:end], portraits, "correlation"), nan=1.0)
        distance = cdist(scores[start:end], scores) / SHAPE_SCALE + uncorrelated / PORTRAIT_SCALE
        apart[row] = np.minimum.reduceat(distance.min(axis=0), first[:-1])
    return apart


def main_person(tracklets: list[Tracklet]) -> tuple[list[Tracklet], list[Tracklet]]:
    """(tracklets of the person who is most in the picture, those of others). What is no face is in neither.

    A photograph is another person, unless there is nobody else.
    """
    faces = [t for t in tracklets if t.shapes]
    people = [t for t in faces if not is_photograph(t.shapes)] or faces
    persons = [[people[row] for row in rows] for rows in _persons(people)]
    best = max(persons, key=lambda same: sum(t.weight for t in same), default=[])
    mine = {id(t) for t in best}
    return best, [t for t in faces if id(t) not in mine]


def _persons(faces: list[Tracklet]) -> list[NDArray[np.int64]]:
    """Rows of faces that look like each other, person by person; nobody is in two places at once.

    The most alike are joined first: in two seconds a face shows but part of how it looks. (Single linkage, but scipy's
    knows of nobody who must stay apart.)
    """
    number = np.arange(len(faces))
    if len(faces) > 1:
        apart = differences(faces)
        first, last = np.array([(face.frames[0], face.frames[-1]) for face in faces]).T
        # Of persons, each by the number of one of their faces.
        at_once = (first[:, None] <= last) & (first <= last[:, None])
        pairs = np.argwhere(np.triu(apart < OTHER_PERSON, 1))
        for mine, theirs in (number[pair] for pair in pairs[np.argsort(apart[tuple(pairs.T)])]):
            if mine != theirs and not at_once[mine, theirs]:
                number[number == theirs] = mine
                at_once[mine] |= at_once[theirs]
                at_once[:, mine] |= at_once[:, theirs]
    return [np.flatnonzero(number == one) for one in np.unique(number)]
