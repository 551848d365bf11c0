"""Shots whose picture is enlarged, from landmarks to the refined track."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.tracker.test_fit import CAMERA, HEAD, SIZE, Talker
from tests.tracker.test_refine import CAMERA as FILM_CAMERA
from tests.tracker.test_refine import NO_BUNDLE, Film, filmed, freckled
from tracker import zoom as subject
from tracker.refine import refine_track
from tracker.track import F32, Landmarks
from tracker.zoom import ENLARGED

SHOTS = np.repeat([0, 1, 2, 3], [50, 20, 40, 30])
MIDDLE = (np.array(SIZE) - 1) / 2


@pytest.fixture(scope="module")
def talker() -> Talker:
    return Talker(len(SHOTS))


def enlarged(landmarks: Landmarks, times: np.ndarray, about: np.ndarray = MIDDLE) -> Landmarks:
    """Landmarks of pictures that are enlarged by times [T]."""
    points, scale = landmarks.points.copy(), times[:, None, None]
    points[..., :2] = about + scale * (points[..., :2] - about)
    points[..., 2:] *= scale
    return replace(landmarks, points=points)


def zoom_of_frames(landmarks: Landmarks, segment: np.ndarray, seen: np.ndarray | None = None) -> F32:
    seen = np.ones(len(segment), bool) if seen is None else seen
    return subject.zoom_of_frames(landmarks, seen, segment, HEAD)


def test_shots_that_are_enlarged_are_told_from_people_who_lean_forward(talker: Talker) -> None:
    times = np.array([1.0, 1.3, 1.1, 0.8])[SHOTS]
    points = enlarged(talker.landmarks, times).points
    points[::7] = np.nan  # no face
    zoom = zoom_of_frames(replace(talker.landmarks, points=points), SHOTS)
    np.testing.assert_allclose(zoom[SHOTS == 1, 0], 1.3, rtol=0.04)
    np.testing.assert_allclose(zoom[SHOTS == 3, 0], 0.8, rtol=0.04)
    np.testing.assert_array_equal(zoom[(SHOTS == 0) | (SHOTS == 2), 0], 1)
    np.testing.assert_array_equal(zoom[(SHOTS == 1) | (SHOTS == 3), 1:], np.broadcast_to(MIDDLE, (50, 2)))
    slightly = zoom_of_frames(enlarged(talker.landmarks, np.exp(0.7 * ENLARGED * (SHOTS == 1))), SHOTS)
    nobody = zoom_of_frames(replace(talker.landmarks, points=points * np.nan), SHOTS)
    assert len(slightly) == len(nobody) == 0


def test_how_large_other_people_are_does_not_count(talker: Talker) -> None:
    """Somebody who is seen in 50 frames, among smaller people."""
    mine = SHOTS == 0
    others = enlarged(talker.landmarks, np.where(mine, 1.0, 0.7))
    assert not len(zoom_of_frames(others, SHOTS, mine))
    between = (np.arange(len(SHOTS)) >= 20) & (np.arange(len(SHOTS)) < 30)
    beside = enlarged(talker.landmarks, np.where(between, 0.5, 1.0))
    assert not len(zoom_of_frames(beside, np.zeros_like(SHOTS), ~between))


def test_pictures_that_grow_within_a_shot_are_told_if_they_grow_quickly() -> None:
    still = Talker(140, turn=Rotation.from_rotvec(np.zeros((140, 3))))
    one_shot, uneven = np.zeros(140, np.int32), np.arange(140) / 25 + 0.01 * (np.arange(140) % 3)
    quickly = np.interp(np.arange(140), [76, 84, 110, 111], [1, 1.3, 1.3, 1.06])  # and a cut that nobody told
    for time in (still.landmarks.time, uneven):
        zoom = zoom_of_frames(replace(enlarged(still.landmarks, quickly), time=time), one_shot)
        np.testing.assert_allclose(zoom[:117, 0], quickly[:117], rtol=0.04)
        assert (zoom[:66, 0] == 1).all() and (zoom[120:, 0] == 1).all()  # somebody who leans forward
    slowly = np.linspace(1, 1.35, 140)
    assert not len(zoom_of_frames(enlarged(still.landmarks, slowly), one_shot))
    at_a_cut = enlarged(still.landmarks, np.where(np.arange(140) < 70, 1.0, 1.1))
    assert not len(zoom_of_frames(at_a_cut, (np.arange(140) >= 70).astype(np.int32)))


def test_a_head_that_turns_far_aside_is_not_enlarged(talker: Talker) -> None:
    """Its size is read wrongly."""
    aside = slice(60, 68)
    points = talker.landmarks.points.copy()
    middle = points[aside].mean(1, keepdims=True)
    far = Rotation.from_euler("y", 75, degrees=True).as_matrix()
    points[aside] = 1.25 * (points[aside] - middle) @ far + middle
    assert not len(zoom_of_frames(replace(talker.landmarks, points=points), np.zeros_like(SHOTS)))


def test_a_face_that_would_come_to_lie_beyond_the_edge_stays_where_it_is(talker: Talker) -> None:
    face, aside = HEAD.landmark_embedding.landmarks, talker.landmarks.points.copy()
    aside[SHOTS == 1, :, 0] -= aside[SHOTS == 1][:, face, 0].min() - 20
    moved = replace(talker.landmarks, points=aside)
    smaller = enlarged(moved, np.where(SHOTS == 1, 0.6, 1.0), np.array([20.0, 300.0]))
    zoom = zoom_of_frames(smaller, SHOTS)
    assert zoom[60, 0] == pytest.approx(0.6, rel=0.04)
    faces = smaller.points[SHOTS == 1][:, face, :2]
    np.testing.assert_allclose(zoom[60, 1:], (faces.min((0, 1)) + faces.max((0, 1))) / 2, atol=0.1)
    larger = zoom_of_frames(enlarged(moved, np.where(SHOTS == 1, 1.4, 1.0)), SHOTS)
    np.testing.assert_allclose(larger[60, 1:], MIDDLE)


def test_an_enlarged_shot_is_fitted_as_it_was_filmed(talker: Talker) -> None:
    times = np.where(SHOTS == 1, 1.3, 1.0)
    zoom = np.column_stack([times, np.broadcast_to(MIDDLE, (len(SHOTS), 2))]).astype(np.float32)
    plain = talker.fit()
    track = talker.fit(landmarks=enlarged(talker.landmarks, times), camera=replace(CAMERA, zoom=zoom))
    np.testing.assert_array_equal(track.zoom, zoom)
    for name, most in (
        ("rotation", 1e-3),
        ("translation", 1e-4),
        ("lip_gap_mm", 0.03),
        ("reprojection_px", 0.01),
    ):
        np.testing.assert_allclose(getattr(track, name), getattr(plain, name), atol=most)


def test_pictures_of_an_enlarged_shot_are_refined_as_they_were_filmed() -> None:
    film = filmed(freckled())
    film.track.valid[:4] = False  # frames are not rows
    times = np.where(np.arange(len(film.pictures)) < 10, 1.25, 1.0)
    about = np.array([159.5, 159.5])
    zoom: F32 = np.column_stack([times, np.broadcast_to(about, (len(times), 2))]).astype(np.float32)
    shown = enlarged(film.landmarks, times, about)

    def larger(picture: np.ndarray, scale: float) -> np.ndarray:
        warp = np.array([[scale, 0, about[0] * (1 - scale)], [0, scale, about[1] * (1 - scale)]])
        return cv2.warpAffine(picture, warp, picture.shape[1::-1], flags=cv2.INTER_CUBIC)

    pictures = [larger(picture, scale) for picture, scale in zip(film.pictures, times)]
    plain, zoomed = (
        refined(film, film.landmarks, film.pictures, None),
        refined(film, shown, pictures, zoom),
    )
    assert (zoomed.deviation[4:, 0] < 1.3 * plain.deviation[4:, 0]).all()
    assert np.abs(zoomed.track.lip_gap_mm - plain.track.lip_gap_mm).max() < 0.5
    assert np.abs(zoomed.track.rotation - plain.track.rotation).max() < np.radians(0.6)
    as_shown = refined(film, film.landmarks, pictures, None)
    assert np.nanmedian(as_shown.deviation[:10, 0]) > 1.5 * np.nanmedian(zoomed.deviation[:10, 0])


def refined(film: Film, landmarks: Landmarks, pictures: list, zoom: F32 | None):
    camera = FILM_CAMERA if zoom is None else replace(FILM_CAMERA, zoom=zoom)
    segment = (np.arange(len(pictures)) >= 10).astype(np.int32)
    frames = [(n / 25, picture) for n, picture in enumerate(pictures)]
    return refine_track(film.track, landmarks, camera, NO_BUNDLE, HEAD, segment, lambda: iter(frames))
