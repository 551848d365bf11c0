"""Faces followed through a clip, told apart, and the person among them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import cast
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from personalize.people import (
    OTHER_PERSON,
    FaceFollower,
    Tracklet,
    apart,
    differences,
    main_person,
    sharpness,
    sureness_of_turns,
)
from tests.personalize.people_factory import tracklet
from tracker.face_detector import Face
from tracker.landmark_bias import landmark_bias
from tracker.landmarker import FaceLandmarker, Roi


def test_the_person_most_in_the_picture_is_kept_over_cuts() -> None:
    mine = [tracklet(1, range(0, 50)), tracklet(1, range(100, 160), seed=1)]
    other = [tracklet(2, range(50, 100))]
    kept, left = main_person([*other, *mine])
    assert {id(t) for t in kept} == {id(t) for t in mine} and left == other


def test_one_of_two_people_seen_together_is_kept() -> None:
    together = [tracklet(1, range(0, 50)), tracklet(2, range(0, 50), width=80)]
    kept, left = main_person(together)
    assert kept == [together[1]] and left == [together[0]]


def test_somebody_who_is_there_in_every_shot_outweighs_larger_people_who_come_and_go() -> None:
    """As before a film that they watch."""
    shots = [range(40 * shot, 40 * shot + 40) for shot in range(8)]
    mine = [tracklet(1, shot, seed=shot.start) for shot in shots]
    halves = [half for shot in shots for half in (shot[:20], shot[20:])]
    others = [tracklet(2 + half.start // 40, half, width=150) for half in halves]
    kept, left = main_person([*others, *mine])
    assert {id(t) for t in kept} == {id(t) for t in mine} and {id(t) for t in left} == {id(t) for t in others}


def test_what_the_landmarker_never_took_for_a_face_is_nobody() -> None:
    ghost = tracklet(1, range(1, 10))
    assert not ghost.shapes
    assert main_person([ghost]) == ([], [])


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_face_is_found_most_surely_where_it_is_turned_upright(quarters: int) -> None:
    def detect(rgb: np.ndarray) -> list[Face]:
        """A face whose hair is bright and above; less sure of one whose hair is elsewhere."""
        sides = [rgb[0, 30, 0], rgb[30, 0, 0], rgb[-1, 30, 0], rgb[30, -1, 0]]
        box, points = np.zeros(4, np.float32), np.zeros((6, 2), np.float32)
        return [Face(box, points, 0.9 if np.argmax(sides) == 0 else 0.6)]

    picture = np.zeros((60, 60, 3), np.uint8)
    picture[:20] = 200
    box = np.array([20, 20, 40, 40], np.float32)
    # np.rot90 turns to the left, as the looks do.
    sure = sureness_of_turns(Mock(detector=Mock(detect=detect)), np.rot90(picture, -quarters), box)
    assert sure.argmax() == quarters and np.sort(sure)[:3].tolist() == [0.6] * 3


def test_how_much_of_a_face_is_cut_off_is_measured() -> None:
    picture = np.full((480, 640, 3), 255, np.uint8)  # before a white wall
    picture[100:300, 120:280] = 90
    picture[150:225, 120:280] = (255, 252, 120)
    face = Face(np.float32([100, 100, 299, 299]), np.zeros((6, 2), np.float32), 0.9)
    follower = FaceFollower(cast(FaceLandmarker, Detector([face])))
    follower.add(0, 0.0, picture)
    assert follower.tracklets[0].sightings[0].burnt == pytest.approx(1 / 3, abs=0.02)


class Detector:
    """A landmarker and its detector: the faces that the whole picture shows, parts of it, and tiles; no landmarks."""

    def __init__(self, whole: list[Face], near: Sequence[Face] = (), tiles: Sequence[Face] = ()) -> None:
        self.detector, self.whole, self.near, self.tiles = self, whole, list(near), list(tiles)
        self.searches: list[list[list[float]]] = []

    def detect(self, rgb: np.ndarray) -> list[Face]:
        return self.whole

    def detect_near(self, rgb: np.ndarray, box: np.ndarray) -> list[Face]:
        return self.near

    def search(self, rgb: np.ndarray, besides: list[np.ndarray]) -> list[Face]:
        self.searches.append([box.tolist() for box in besides])
        return self.tiles

    def landmarks(self, rgb: np.ndarray, roi: Roi) -> tuple[np.ndarray, float, None]:
        return np.zeros((478, 3), np.float32), 0.0, None


def follow(detector: Detector, pictures: range, follower: FaceFollower | None = None) -> FaceFollower:
    follower = follower or FaceFollower(cast(FaceLandmarker, detector))
    for index in pictures:
        follower.add(index, index / 25, np.zeros((256, 256, 3), np.uint8))
    return follower


def face(*box: float, score: float = 0.9) -> Face:
    eyes = np.float32([[0.7 * box[0] + 0.3 * box[2], box[1]], [0.3 * box[0] + 0.7 * box[2], box[1]]])
    return Face(np.float32(box), np.concatenate([eyes, np.zeros((4, 2), np.float32)]), score)


def test_small_faces_that_are_found_near_each_other_are_followed_once_each() -> None:
    both = [face(100, 100, 130, 130), face(140, 100, 170, 130)]
    followed = follow(Detector([], near=both, tiles=both), range(12)).tracklets
    assert [len(tracklet.frames) for tracklet in followed] == [12, 12]


def test_a_small_face_is_followed_while_the_whole_picture_shows_another() -> None:
    small, large = face(200, 60, 230, 90), face(20, 40, 140, 160)
    busts = [face(185, 40, 250, 105, score=0.55), face(190, 52, 240, 102, score=0.55)]
    for whole, tracklets in (*((bust, [range(12)]) for bust in busts), (large, [range(12), range(2, 12)])):
        detector = Detector([], near=[small], tiles=[small])
        follower = follow(detector, range(2))
        detector.whole = [whole]
        follow(detector, range(2, 12), follower)
        assert [followed.frames for followed in follower.tracklets] == [list(frames) for frames in tracklets]
        assert follower.tracklets[0].box.tolist() == small.box.tolist()
    assert len(detector.searches) == 1


def test_of_faces_within_each_other_the_surest_stays() -> None:
    sure, around_it = face(40, 40, 60, 60), face(0, 0, 80, 80, score=0.8)
    in_a_corner, above_it = face(56, 56, 58, 58, score=0.7), face(30, 0, 70, 49, score=0.5)
    beside = face(70, 40, 90, 60, score=0.6)
    assert apart([around_it, in_a_corner, above_it, sure, beside]) == [sure, beside, above_it]


def test_small_faces_are_searched_for_every_second_and_beside_others_every_three() -> None:
    large, small = face(20, 40, 140, 160), face(200, 60, 230, 90)
    detector = Detector([])
    follower = follow(detector, range(60))
    assert detector.searches == [[], [], []]
    detector.whole = [large]
    follow(detector, range(60, 240), follower)
    assert detector.searches[3:] == [[large.box.tolist()]] * 2
    detector.tiles = detector.near = [small]
    follow(detector, range(240, 330), follower)
    assert [followed.frames[-1] for followed in follower.tracklets] == [329, 329]


def test_a_photograph_is_nobody_unless_there_is_nobody_else() -> None:
    photograph, mine = tracklet(1, range(0, 90), width=300, moves=0.0), tracklet(2, range(20, 90), width=60)
    assert main_person([photograph, mine]) == ([mine], [photograph])
    assert main_person([photograph]) == ([photograph], [])
    coded = tracklet(1, range(0, 90), width=300, moves=1e-4)
    assert main_person([coded, mine])[0] == [mine]
    listens = tracklet(1, range(0, 90), width=300, moves=3e-3)
    assert main_person([listens, mine])[0] == [listens]
    frozen = tracklet(1, range(0, 90), width=300)
    for sighting in frozen.sightings[40:]:  # from then on the picture stands still, as in a call
        object.__setattr__(sighting, "sample", sighting.sample and frozen.sightings[30].sample)
    assert main_person([frozen, mine])[0] == [frozen]
    shortly = tracklet(1, range(0, 30), width=300, moves=0.0)  # three looks tell nothing yet
    assert main_person([shortly, mine]) == ([shortly], [mine])


def test_the_widest_face_is_no_photograph_unless_it_is_alone() -> None:
    """Nor is what may be another behind a cut."""
    photograph, speaker = face(20, 20, 120, 120), face(200, 200, 220, 220)
    shape, moving = np.random.default_rng(0).normal(size=(2, 478, 3))
    detector = Detector([photograph, speaker])

    def landmarks(rgb: np.ndarray, roi: Roi) -> tuple[np.ndarray, float, None]:
        share = 0.02 * len(follower.tracklets[1].frames) / 25 if roi.x > 150 else 0.0
        return (100 * (shape + share * moving)).astype(np.float32), 0.9, None

    detector.landmarks = landmarks  # type: ignore[method-assign]
    follower = FaceFollower(cast(FaceLandmarker, detector))
    follow(detector, range(30), follower)
    assert follower.widest is not None and follower.widest.tolist() == photograph.box.tolist()
    follow(detector, range(30, 60), follower)
    assert follower.widest.tolist() == speaker.box.tolist()
    follower.add(60, 2.4, np.zeros((256, 256, 3), np.uint8), sudden=True)
    assert follower.widest.tolist() == photograph.box.tolist()
    follow(detector, range(61, 121), follower)
    detector.whole = [photograph]
    follow(detector, range(121, 150), follower)
    assert follower.widest.tolist() == photograph.box.tolist()


def test_cuts_are_told_by_one_face_as_long_as_no_other_is_clearly_wider() -> None:
    one, alike, wide = face(20, 20, 120, 120), face(130, 20, 250, 120), face(0, 0, 256, 256)
    detector = Detector([one])
    follower = follow(detector, range(2))
    steps = (
        *(([one, alike], one), ([alike, one], one), ([alike], alike), ([one, alike], alike)),
        *(([wide], wide), ([], None), ([one], one)),
    )
    for index, (whole, foremost) in enumerate(steps, 2):
        detector.whole = whole
        follow(detector, range(index, index + 1), follower)
        told = follower.foremost
        assert (told is None) == (foremost is None)
        assert told is None or foremost is None or told.tolist() == foremost.box.tolist()
    for followed in follower.tracklets:
        followed.still = True  # photographs
    follow(detector, range(9, 10), follower)
    assert follower.foremost is None and follower.widest is not None


def test_behind_a_cut_a_face_is_looked_at_anew_however_shortly_it_is_seen() -> None:
    face = Face(np.float32([100, 100, 299, 299]), np.zeros((6, 2), np.float32), 0.9)
    points = np.random.default_rng(0).normal(200, 40, (478, 3)).astype(np.float32)
    detector = Detector([])
    detector.landmarks = lambda *_: (points, 0.9, None)  # type: ignore[method-assign]
    follower, picture = FaceFollower(cast(FaceLandmarker, detector)), np.full((480, 640, 3), 90, np.uint8)
    gone = {33, *range(36, 60)}  # the first picture behind the cut, and soon for good
    for index in range(60):
        detector.whole = [] if index in gone else [face]
        follower.add(index, index / 25, picture, sudden=index == 33)
    (followed,) = follower.tracklets
    before, behind = followed.shots((np.arange(60) >= 33).astype(np.int32))
    assert before.frames == list(range(33)) and behind.frames == [34, 35]
    assert len(before.shapes) == 3 and len(behind.shapes) == 1


@pytest.mark.parametrize(("gone", "jump_px", "tracklets"), [(10, 0, 1), (11, 0, 2), (0, 50, 1), (0, 120, 2)])
def test_a_face_that_is_soon_seen_again_nearly_where_it_was_is_the_same(
    gone: int, jump_px: float, tracklets: int
) -> None:
    """Of 200 px; ten pictures are .4 s from the last sight of it."""
    detector, picture = Detector([]), np.zeros((480, 640, 3), np.uint8)
    follower = FaceFollower(cast(FaceLandmarker, detector))
    for index in range(40):
        box = np.float32([100, 100, 300, 300]) + np.float32([jump_px, 0, jump_px, 0]) * (index >= 20)
        seen = [] if 20 <= index < 20 + gone - 1 else [Face(box, np.zeros((6, 2), np.float32), 0.9)]
        detector.whole = seen
        follower.add(index, index / 25, picture)
    assert len(follower.tracklets) == tracklets


def shot(
    frames: range, turns_deg: Sequence[float], jaw: float = 0.0, person: int = 0, hair: int = 0
) -> Tracklet:
    """Looks at the mean head with a shape and hair of its own, turned to its left by so much and a jaw so far down."""
    bias, draw = landmark_bias(), np.random.default_rng
    face = bias.mean + 0.006 * bool(person) * draw(person).standard_normal(bias.mean.shape)
    face[:, 1] -= jaw * np.clip(-0.02 - bias.mean[:, 1], 0, None)
    made = tracklet(1, frames)
    portrait = draw(hair).integers(0, 255, (14, 12)).astype(np.uint8)
    samples = []
    for turn in turns_deg:
        points = np.zeros((478, 3), np.float32)
        turned = face @ Rotation.from_euler("y", turn, degrees=True).as_matrix().T
        points[bias.landmarks] = 900 * turned * (1, -1, -1) + (320, 240, 0)
        samples.append((points, portrait))
    made.sightings = [
        replace(seen, sample=sample) for seen, sample in zip_longest(made.sightings[: len(frames)], samples)
    ]
    return made


def test_people_are_told_apart_by_the_shape_of_the_face_and_by_how_the_head_looks() -> None:
    """Either is enough; light, size, and how it is turned in the picture are not."""
    one = shot(range(0, 30), (0, 5, 10))
    paler = shot(range(40, 70), (0, 5, 10))
    tilt = np.array([[0.0, -1.3, 0.0], [1.3, 0.0, 0.0], [0.0, 0.0, 1.3]])
    paler.sightings = [
        (seen.sample and replace(seen, sample=(seen.sample[0] @ tilt, seen.sample[1] // 2 + 60))) or seen
        for seen in paler.sightings
    ]
    shape, hair = shot(range(80, 110), (0, 5), person=1), shot(range(120, 150), (0, 5), hair=1)
    both = shot(range(160, 190), (0, 5), person=1, hair=1)
    apart_from_one = differences([one, paler, shape, hair, both])[0]
    assert apart_from_one[:2].max() < 0.1 and min(apart_from_one[2:4]) > OTHER_PERSON / 2
    assert apart_from_one[4] == pytest.approx(sum(apart_from_one[2:4]), abs=0.1)
    flat = shot(range(200, 230), (0,))
    flat.sightings = [
        (seen.sample and replace(seen, sample=(seen.sample[0], np.zeros((14, 12), np.uint8)))) or seen
        for seen in flat.sightings
    ]
    assert differences([one, flat])[0, 1] > OTHER_PERSON


def test_shots_of_one_person_are_compared_where_they_are_most_alike() -> None:
    """In one the head faces the camera mostly, in the other it is turned aside mostly, and talks."""
    straight, aside = shot(range(0, 30), (0, 0, 0, 30)), shot(range(40, 70), (-30, 30, 30, 30), jaw=0.3)
    straight.sightings[3] = replace(straight.sightings[3], sample=aside.sightings[1].sample)
    assert differences([straight, aside])[0, 1] == pytest.approx(0, abs=1e-6)


def test_a_shot_is_of_the_person_whose_other_shots_it_looks_like() -> None:
    """Not of whom the longest one looks like: a mouth that opens wider and wider."""
    mine = [
        shot(range(0, 90), (0,)),
        *(shot(range(100 * k, 100 * k + 30), (0,), jaw=0.25 * k) for k in range(1, 5)),
    ]
    other = shot(range(600, 630), (0,), person=1)
    looks = differences([*mine, other])
    assert looks[0, 4] > OTHER_PERSON and looks[:5, 5].min() > OTHER_PERSON
    kept, left = main_person([other, *mine])
    assert {id(t) for t in kept} == {id(t) for t in mine} and left == [other]


def test_nobody_is_joined_to_two_faces_that_are_seen_at_once() -> None:
    """A shot that looks like either is of the one that it looks like more."""
    left_of, right_of = shot(range(0, 50), (0,)), shot(range(0, 50), (0,), jaw=0.3)
    later = shot(range(60, 200), (0,), jaw=0.1)
    assert differences([left_of, right_of, later]).max() < OTHER_PERSON
    kept, _ = main_person([right_of, left_of, later])
    assert {id(t) for t in kept} == {id(left_of), id(later)}


def test_nobody_is_joined_to_a_person_who_is_seen_beside_him_elsewhere() -> None:
    """Though he is not seen beside the shot that he looks like."""
    mine = shot(range(0, 100), (0,)), shot(range(200, 230), (0,), jaw=0.01)
    beside = shot(range(200, 230), (0,), jaw=0.2)
    assert differences([*mine, beside]).max() < OTHER_PERSON
    kept, left = main_person([*mine, beside])
    assert {id(t) for t in kept} == {id(t) for t in mine} and left == [beside]


def test_of_two_faces_alike_that_are_seen_together_one_is_the_person() -> None:
    """As in a mirror, or a picture on the wall."""
    mine = [tracklet(1, range(0, 50)), tracklet(1, range(60, 100), seed=1)]
    mirrored = tracklet(1, range(60, 90), seed=2, width=30)
    kept, left = main_person([mirrored, *mine])
    assert {id(t) for t in kept} == {id(t) for t in mine} and left == [mirrored]


def test_how_sharp_a_face_is_does_not_hang_on_its_contrast() -> None:
    grey = np.random.default_rng(0).integers(0, 255, (64, 64)).astype(np.uint8)
    assert sharpness(grey // 3 + 90) == pytest.approx(sharpness(grey), rel=0.05)
    assert sharpness(cv2.GaussianBlur(grey, (0, 0), 2.0)) < 0.2 * sharpness(grey)
