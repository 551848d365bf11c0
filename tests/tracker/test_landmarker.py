"""The landmarker: pure geometry by hand, then a rendered head whose landmarks are known."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracker.face_detector import (
    INPUT_SIZE,
    Face,
    FaceDetector,
    anchors,
    decode,
    letterbox,
    merge,
    overlaps,
    tiles,
)
from tracker.head import HeadModel, load_head
from tracker.landmark_indices import (
    BLENDSHAPE_INPUT,
    BLENDSHAPE_NAMES,
    LEFT_EYE_OUTER,
    MIRRORED,
    POINTS,
    RIGHT_EYE_OUTER,
)
from tracker.landmarker import (
    SEARCH_INTERVAL,
    FaceLandmarker,
    LandmarkTracker,
    Roi,
    agreement,
    crop,
    roi_from_face,
    roi_from_points,
    track_landmarks,
)
from tracker.raster import project, render

SIZE, FOCAL = 400, 900.0
CENTRE = ((SIZE - 1) / 2, (SIZE - 1) / 2)
FACING = np.diag([1.0, -1.0, -1.0])


def test_anchors_are_the_centres_of_two_grids() -> None:
    centres = anchors()
    assert centres.shape == (896, 2)
    assert np.allclose(centres[:3], [[1 / 32, 1 / 32], [1 / 32, 1 / 32], [3 / 32, 1 / 32]])
    assert np.allclose(centres[512], [1 / 16, 1 / 16]) and np.allclose(centres[-1], [15 / 16, 15 / 16])


def test_a_detection_is_relative_to_its_anchor() -> None:
    regressors = np.zeros((896, 16), np.float32)
    regressors[5, :6] = (12.8, 0, 64, 32, -12.8, 6.4)
    logits = np.full(896, -1000, np.float32)
    logits[5] = 3
    points, scores = decode(regressors, logits, anchors())
    x, y = anchors()[5] + np.array([0.1, 0])
    assert np.allclose(points[0, :2], [(x - 0.25, y - 0.125), (x + 0.25, y + 0.125)], atol=1e-6)
    assert np.allclose(points[0, 2], anchors()[5] + (-0.1, 0.05), atol=1e-6)
    assert scores == pytest.approx(1 / (1 + np.exp(-3)))


def test_overlapping_detections_become_their_weighted_mean() -> None:
    def box(x: float) -> np.ndarray:
        return np.concatenate([[[x, 0], [x + 10, 10]], np.full((6, 2), x)])

    points = np.stack([box(2), box(0), box(50)]).astype(np.float32)
    assert overlaps(points[0, :2], points[:, :2]) == pytest.approx([1, 8 / 12, 0])
    first, second = merge(points, np.array([0.6, 0.9, 0.7], np.float32))
    assert first[0][0, 0] == pytest.approx(0.8) and first[1] == pytest.approx(0.9)
    assert second[0][2, 0] == pytest.approx(50)


def test_faces_are_merged_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Means of detections may overlap though these did not: in the whole picture they are faces of their own."""
    boxes = np.float32([[0, 0, 60, 60], [12, 0, 72, 60]])
    near = [Face(box, np.zeros((6, 2), np.float32), score) for box, score in zip(boxes, (0.9, 0.8))]
    monkeypatch.setattr(FaceDetector, "_detect_in", lambda self, rgb, _: list(near))
    detector, picture = object.__new__(FaceDetector), np.zeros((100, 100, 3), np.uint8)
    assert detector.detect(picture) == near
    (face,) = detector.search(picture)  # the same two, seen in several tiles
    assert face.score == np.float32(0.9)


@pytest.mark.parametrize("size", [(1920, 1080), (1080, 1920), (360, 288), (50, 50), (1000, 3)])
def test_letterbox_keeps_the_picture_centred(size: tuple[int, int]) -> None:
    square, scale, (left, top) = letterbox(np.full((size[1], size[0], 3), 200, np.uint8))
    rows, columns = np.nonzero(square[..., 0])
    assert square.shape == (INPUT_SIZE, INPUT_SIZE, 3) and scale == INPUT_SIZE / max(size)
    assert (columns.min(), rows.min()) == (left, top)
    assert abs(columns.min() - (INPUT_SIZE - 1 - columns.max())) <= 1
    assert abs(rows.min() - (INPUT_SIZE - 1 - rows.max())) <= 1


@pytest.mark.parametrize("size", [(1920, 1080), (360, 288), (100, 900)])
@pytest.mark.parametrize("divisor", [2, 3, 5])
def test_every_small_face_lies_whole_in_some_tile(size: tuple[int, int], divisor: int) -> None:
    squares = list(tiles(*size, divisor))
    face = max(size) // divisor // 2
    rng = np.random.default_rng(0)
    for left, top in rng.uniform(0, 1, (200, 2)) * (np.maximum(np.array(size) - face, 0)):
        inside = [
            a <= left and left + face <= a + s + 1 and b <= top and min(top + face, size[1]) <= b + s + 1
            for a, b, s in squares
        ]
        assert any(inside)


def test_a_crop_takes_the_pixels_it_says() -> None:
    y, x = np.mgrid[:300, :300]
    picture = np.stack([x / 2, y / 2, 0 * x], -1).round().astype(np.uint8)
    roi = Roi(150.0, 140.0, 128.0, 0.3)
    taken = crop(picture, roi).astype(float)
    for column, row in ((10, 10), (200, 50), (128, 128)):
        unit = np.array([column + 0.5, row + 0.5]) / 256
        expected = roi.to_picture() @ (*unit, 1)
        assert np.allclose(2 * taken[row, column, :2], expected, atol=1.6)


def test_a_large_region_is_averaged_not_sampled() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (1200, 1200, 3), dtype=np.uint8)
    assert crop(noise, Roi(600, 600, 1100, 0.0)).std() < 0.4 * noise.std()
    y, x = np.mgrid[:1200, :1200]
    ramp = np.stack([x, y, y], -1) / 5
    taken = crop(ramp.round().astype(np.uint8), Roi(580, 610, 1050, -0.2)).astype(float)
    expected = Roi(580, 610, 1050, -0.2).to_picture() @ (128.5 / 256, 128.5 / 256, 1)
    assert np.allclose(5 * taken[128, 128, :2], expected, atol=4)


def test_regions_blend_the_short_way_round() -> None:
    region = Roi(0, 0, 10, np.radians(170)).blend(Roi(10, 20, 30, np.radians(-170)), 0.5)
    assert (region.x, region.y, region.side) == (5, 10, 20)
    assert abs(np.degrees(region.angle)) == pytest.approx(180)


def test_indices() -> None:
    assert len(BLENDSHAPE_NAMES) == len(set(BLENDSHAPE_NAMES)) == 52 and BLENDSHAPE_NAMES[0] == "_neutral"
    assert len(BLENDSHAPE_INPUT) == 146 and (np.diff(BLENDSHAPE_INPUT) > 0).all()
    assert (MIRRORED[MIRRORED] == np.arange(POINTS)).all()
    assert (MIRRORED[33], MIRRORED[61], MIRRORED[13], MIRRORED[468]) == (263, 291, 13, 473)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def landmarker() -> FaceLandmarker:
    return FaceLandmarker()


def _picture(
    head: HeadModel, x: float = 0.0, z: float = 0.6, opening: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """A head straight before the camera and where its embedded landmarks are, px."""
    expression = np.zeros(len(head.expression_names))
    expression[head.expression_names.index("jawOpen")] = opening
    who = np.zeros(len(head.identity_basis))
    shift = np.array([x, 0.02, z])
    vertices = (head.vertices(who, expression) @ FACING + shift).astype(np.float32)
    places = project(head.landmark_positions(who, expression) @ FACING + shift, FOCAL, CENTRE)
    return render(vertices, head.faces, head.albedo, FOCAL, CENTRE, (SIZE, SIZE)), places


def test_landmarks_lie_where_the_head_has_them(head: HeadModel, landmarker: FaceLandmarker) -> None:
    picture, places = _picture(head)
    found = LandmarkTracker(landmarker).next(picture)
    assert found is not None and found[1] > 0.99
    error = np.linalg.norm(found[0][head.landmark_embedding.landmarks, :2] - places, axis=1)
    eyes = np.linalg.norm(found[0][33, :2] - found[0][263, :2])
    assert np.median(error) < 0.03 * eyes


def test_mirrored_pictures_give_mirrored_landmarks(head: HeadModel, landmarker: FaceLandmarker) -> None:
    picture, _ = _picture(head, x=0.03)
    found = LandmarkTracker(landmarker).next(picture)
    assert found is not None
    roi = roi_from_points(found[0])
    points, _, _ = landmarker.landmarks(picture, roi)
    flipped = Roi(SIZE - 1 - roi.x, roi.y, roi.side, -roi.angle)
    mirrored, _, _ = landmarker.landmarks(np.ascontiguousarray(picture[:, ::-1]), flipped)
    back = mirrored[MIRRORED] * (-1, 1, 1) + (SIZE - 1, 0, 0)
    assert np.abs(back - points)[:, :2].max() < 0.1


def test_a_moved_picture_moves_the_landmarks(head: HeadModel, landmarker: FaceLandmarker) -> None:
    picture, _ = _picture(head)
    found = LandmarkTracker(landmarker).next(picture)
    assert found is not None
    moved = np.roll(picture, (9, -14), axis=(0, 1))
    again = LandmarkTracker(landmarker).next(moved)
    assert again is not None
    assert np.abs(again[0][:, :2] - found[0][:, :2] - (-14, 9)).mean() < 0.5


def test_an_open_mouth_shows(head: HeadModel, landmarker: FaceLandmarker) -> None:
    openings, scores = [], []
    for opening in (0.0, 0.6):
        found = LandmarkTracker(landmarker).next(_picture(head, opening=opening)[0])
        assert found is not None
        openings.append(found[0][14, 1] - found[0][13, 1])
        scores.append(found[2][BLENDSHAPE_NAMES.index("jawOpen")])
    assert openings[1] > openings[0] + 5 and scores[1] > scores[0] + 0.1


def test_small_faces_need_tiles(head: HeadModel, landmarker: FaceLandmarker) -> None:
    picture, _ = _picture(head)
    small = cv2.resize(picture, (110, 110), interpolation=cv2.INTER_AREA)
    wide = np.full((1080, 1920, 3), 90, np.uint8)
    wide[300:410, 1500:1610] = small
    assert landmarker.detector.detect(wide) == []
    (face,) = landmarker.detector.search(wide)
    assert 1500 < face.box[0] < face.box[2] < 1610 and 300 < face.keypoints[2, 1] < 410


def test_a_small_face_that_is_meant_is_found_beside_a_large_one(
    head: HeadModel, landmarker: FaceLandmarker
) -> None:
    """As that of somebody who shows slides with a picture of a face."""
    picture, _ = _picture(head)
    wide = np.full((1080, 1920, 3), 90, np.uint8)
    wide[300:410, 1500:1610] = cv2.resize(picture, (110, 110), interpolation=cv2.INTER_AREA)
    wide[100:900, 200:1000] = cv2.resize(picture, (800, 800))
    detector = landmarker.detector
    (large,) = detector.detect(wide)
    assert large.box[0] < 1000
    found = LandmarkTracker(landmarker).next(wide, np.float32([1530, 320, 1580, 400]))
    assert found is not None and 1500 < found[0][:, 0].min() < found[0][:, 0].max() < 1610
    (small,) = detector.search(wide, besides=[large.box])
    assert small.box[0] > 1500
    assert detector.detect_near(wide, np.float32([2500, 320, 2550, 370])) == []


def test_a_clip_loses_and_finds_the_face(head: HeadModel) -> None:
    left, right = (_picture(head, x)[0] for x in (-0.05, 0.05))
    empty = np.full_like(left, 80)
    clip = [left, left, empty, right, right]
    seen: list[int] = []
    marks = track_landmarks(
        ((i / 25, picture) for i, picture in enumerate(clip)), len(clip), progress=lambda i, n: seen.append(i)
    )
    assert marks.points.shape == (5, POINTS, 3) and marks.points.dtype == np.float32
    assert marks.blendshapes.shape == (5, 52) and marks.size == (SIZE, SIZE)
    assert (marks.presence > 0.9).tolist() == [True, True, False, True, True]
    assert np.isnan(marks.points[2]).all() and not np.isnan(marks.points[[0, 1, 3, 4]]).any()
    assert marks.points[3, :, 0].mean() > marks.points[1, :, 0].mean() + 100
    assert seen == [1, 2, 3, 4, 5] and np.allclose(marks.time, np.arange(5) / 25)


def test_the_region_follows_by_time_and_not_by_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).uniform(100, 200, (POINTS, 3)).astype(np.float32)
    points[RIGHT_EYE_OUTER, :2], points[LEFT_EYE_OUTER, :2] = (120, 130), (180, 130)
    landmarker = SimpleNamespace(landmarks=lambda rgb, roi: (points, 1.0, np.zeros(52, np.float32)))
    picture, places = np.zeros((300, 300, 3), np.uint8), []
    for rate in (25, 50, 12.5):
        tracker = LandmarkTracker(cast(FaceLandmarker, landmarker))
        tracker._roi = replace(roi_from_points(points), x=300.0, side=150.0)
        for _ in range(round(0.16 * rate)):
            tracker.next(picture, step_s=1 / rate)
        places.append((tracker._roi.x, tracker._roi.side))
    assert places[0][0] < 210
    np.testing.assert_allclose(places[1:], places[:1] * 2)


def test_a_cut_forgets_the_region(head: HeadModel, landmarker: FaceLandmarker) -> None:
    left, right = (_picture(head, x, z)[0] for x, z in ((-0.06, 0.8), (0.03, 0.55)))
    fresh = LandmarkTracker(landmarker).next(right)
    assert fresh is not None
    marks = track_landmarks(iter([(0.0, left), (0.04, right)]), 2, cuts={1})
    assert np.abs(marks.points[1] - fresh[0]).max() < 1e-3


NOTHING = np.zeros((300, 600, 3), np.uint8)


class _Crowd:
    """A landmarker and its detector, before which stand faces [n, 3] px: where, and how wide.

    searched: for each look at a whole picture, whether tiles were searched too.
    """

    def __init__(self, *faces: tuple[float, float, float]) -> None:
        self.faces = np.array(faces, np.float64).reshape(-1, 3)
        self.searched: list[bool] = []
        self.regions: list[Roi] = []
        self.detector = self

    def detect(self, rgb: np.ndarray) -> list[Face]:
        self.searched.append(False)
        return [self._face(*one) for one in self.faces]

    def detect_near(self, rgb: np.ndarray, box: np.ndarray) -> list[Face]:
        return []

    def search(self, rgb: np.ndarray) -> list[Face]:
        self.searched[-1] = True
        return []

    @staticmethod
    def _face(x: float, y: float, width: float) -> Face:
        eyes = np.float32([[x - width / 4, y], [x + width / 4, y]])
        box = np.float32([x - width / 2, y - width / 2, x + width / 2, y + width / 2])
        return Face(box, np.concatenate([eyes, np.zeros((4, 2), np.float32)]), 0.9)

    def landmarks(self, rgb: np.ndarray, roi: Roi) -> tuple[np.ndarray, float, np.ndarray]:
        """Of the face nearest to the region's middle, a fifth narrower than its box; of none without one in it."""
        self.regions.append(roi)
        away = np.hypot(self.faces[:, 0] - roi.x, self.faces[:, 1] - roi.y)
        x, y, width = self.faces[away.argmin()]
        points = np.zeros((POINTS, 3), np.float32)
        points[:, :2] = (x, y) + 0.4 * width * np.random.default_rng(0).uniform(-1, 1, (POINTS, 2))
        points[[RIGHT_EYE_OUTER, LEFT_EYE_OUTER], 1] = y
        points[[RIGHT_EYE_OUTER, LEFT_EYE_OUTER], 0] = x - width / 4, x + width / 4
        return points, float(away.min() < roi.side / 2), np.zeros(52, np.float32)


def _where(found: tuple[np.ndarray, float, np.ndarray] | None) -> float:
    assert found is not None
    return float(found[0][[RIGHT_EYE_OUTER, LEFT_EYE_OUTER], 0].mean())


def test_the_largest_face_is_followed_unless_another_is_meant() -> None:
    crowd = _Crowd((100, 150, 40), (300, 150, 100), (500, 150, 60))
    tracker = LandmarkTracker(cast(FaceLandmarker, crowd))
    assert _where(tracker.next(NOTHING)) == pytest.approx(300)
    meant = np.float32([460, 110, 540, 190])
    assert _where(tracker.next(NOTHING, meant)) == pytest.approx(500)
    assert _where(tracker.next(NOTHING)) == pytest.approx(500)  # and stays where it is
    assert tracker.next(NOTHING, np.float32([180, 10, 200, 30])) is None


def test_a_face_that_is_found_is_read_again_in_the_region_of_its_landmarks() -> None:
    """That which the following frames will have."""
    crowd = _Crowd((300, 150, 100))
    tracker = LandmarkTracker(cast(FaceLandmarker, crowd))
    found = tracker.next(NOTHING)
    assert found is not None
    detected, own = roi_from_face(crowd.detect(NOTHING)[0]), roi_from_points(found[0])
    assert own.side < 0.85 * detected.side
    tracker.next(NOTHING)
    assert crowd.regions == [detected, own, own]


def test_tiles_are_searched_once_in_a_while_when_there_is_no_face(monkeypatch: pytest.MonkeyPatch) -> None:
    crowd = _Crowd()
    tracker = LandmarkTracker(cast(FaceLandmarker, crowd))
    for _ in range(2 * SEARCH_INTERVAL + 1):
        assert tracker.next(NOTHING) is None
    assert np.flatnonzero(crowd.searched).tolist() == [0, SEARCH_INTERVAL, 2 * SEARCH_INTERVAL]
    crowd.faces = np.array([[300.0, 150.0, 100.0]])
    assert tracker.next(NOTHING) is not None
    crowd.faces = np.zeros((0, 3))  # lost: tiles are searched at once
    monkeypatch.setattr(crowd, "landmarks", lambda rgb, roi: (None, 0.0, None))
    tracker.next(NOTHING)
    assert crowd.searched[-1]


def test_frames_come_as_long_after_each_other_as_their_times_say(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[float] = []
    monkeypatch.setattr("tracker.landmarker.FaceLandmarker", lambda: None)
    monkeypatch.setattr(LandmarkTracker, "next", lambda self, rgb, box, step_s: steps.append(step_s))
    track_landmarks([(time, NOTHING) for time in (1.0, 1.02, 1.12)], 3)
    assert steps == pytest.approx([0.04, 0.02, 0.1])


def test_both_readings_of_a_face_count_alike_and_depth_is_in_pixels(
    landmarker: FaceLandmarker, monkeypatch: pytest.MonkeyPatch
) -> None:
    random, roi = np.random.default_rng(0), Roi(300.0, 150.0, 80.0, 0.0)
    straight, error = random.uniform(0.2, 0.8, (POINTS, 3)), 0.004 * random.normal(size=(POINTS, 3))
    mirrored = (straight - error)[MIRRORED] * (-1, 1, 1) + (1, 0, 0)

    def reads(unit: np.ndarray, logit: float) -> object:
        return lambda picture: [np.float32(256 * unit), np.float32([logit]), None]

    monkeypatch.setattr(landmarker, "_landmarks", reads(straight + error, 3.0))
    monkeypatch.setattr(landmarker, "_mirrored", reads(mirrored, -1.0))
    points, presence, _ = landmarker.landmarks(NOTHING, roi)
    # Half of the picture's width, edge to edge, is the middle of the region.
    expected = 80 * (straight - (0.5, 0.5, 0)) + (300, 150, 0)
    np.testing.assert_allclose(points, expected, atol=1e-3)
    assert presence == pytest.approx(1 / (1 + np.exp(-1)))


@pytest.mark.parametrize(
    ("apart", "left"), [(0.0, 1.0), (0.02, 1.0), (0.03, 0.5**0.5), (0.04, 0.5), (0.1, 2.0**-4)]
)
def test_readings_of_one_face_that_lie_apart_are_doubted(apart: float, left: float) -> None:
    """As a share of the face: of the longer side of its box."""
    face = np.float32(np.random.default_rng(0).uniform(0.2, 0.6, (POINTS, 3)))
    face[:2, :2] = (0.2, 0.1), (0.4, 0.9)
    far = np.float32([0.8 * apart * 0.6, 0.8 * apart * 0.8, 5.0])  # depth does not count
    assert agreement(face + far / 2, face - far / 2) == pytest.approx(left, rel=1e-3)


def test_what_is_read_of_a_face_from_aside_is_doubted(head: HeadModel, landmarker: FaceLandmarker) -> None:
    """There the network invents a face that its mirror image does not show, and is sure of it."""

    def presence(turn_deg: float) -> float:
        turn = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
        rest = head.vertices(np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_names)))
        vertices = (rest @ turn.T @ FACING + [0, 0.02, 0.55]).astype(np.float32)
        picture = render(vertices, head.faces, head.albedo, FOCAL, CENTRE, (SIZE, SIZE))
        found = LandmarkTracker(landmarker).next(picture)
        return 0.0 if found is None else found[1]

    assert min(presence(turn) for turn in (-40, 0, 40)) > 0.99
    assert max(presence(turn) for turn in (-85, -60, 60, 85)) < 0.9
