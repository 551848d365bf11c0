"""A lens against OpenCV's own projection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracker.lens import Lens
from tracker.track import Landmarks

FOCAL, PRINCIPAL = 500.0, (319.5, 239.5)
MATRIX = np.array([[FOCAL, 0, PRINCIPAL[0]], [0, FOCAL, PRINCIPAL[1]], [0, 0, 1]])


def seen(points: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """[n, 2] px, where a lens shows what a pinhole would show at `points`."""
    rays = np.concatenate([(points - PRINCIPAL) / FOCAL, np.ones((len(points), 1))], axis=1)
    k1, k2, k3 = (*distortion, 0.0, 0.0)[:3]
    bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), MATRIX, np.array([k1, k2, 0, 0, k3]))
    return bent.reshape(-1, 2)


@pytest.mark.parametrize("distortion", [(-0.2,), (-0.2, 0.05), (0.1, 0.0, -0.02)])
def test_points_come_back_to_where_a_pinhole_shows_them(distortion: tuple[float, ...]) -> None:
    straight = np.random.default_rng(0).uniform((60, 60), (580, 420), (40, 2))
    bent = seen(straight, distortion)
    assert np.abs(bent - straight).max() > 2
    back = Lens(FOCAL, PRINCIPAL, distortion).points(bent.reshape(8, 5, 2), np.arange(8))
    np.testing.assert_allclose(back, straight.reshape(8, 5, 2), atol=0.02)


def test_points_at_the_rim_of_a_wide_lens_come_back_as_well() -> None:
    straight = np.array([[-250.0, 60.0], [900.0, 440.0]])
    bent = seen(straight, (-0.25, 0.07))
    np.testing.assert_allclose(
        Lens(FOCAL, PRINCIPAL, (-0.25, 0.07)).points(bent, np.arange(2)), straight, atol=0.01
    )


@pytest.mark.parametrize("times", [0.85, 1.0, 1.5])
@pytest.mark.parametrize("distortion", [(), (-0.25,)])
def test_a_picture_moves_as_its_points_do(distortion: tuple[float, ...], times: float) -> None:
    zoom = np.array([[1.0, 0, 0], [times, 280, 220]], np.float32)
    lens = Lens(FOCAL, PRINCIPAL, distortion, zoom)
    for dot in [(120.0, 100.0), (500.0, 400.0)]:
        picture = np.zeros((480, 640, 3), np.uint8)
        cv2.circle(picture, (int(dot[0]), int(dot[1])), 6, (255, 255, 255), -1)
        for frame in range(2):
            mass = lens.picture(picture, frame)[..., 0].astype(np.float64)
            rows, columns = np.mgrid[:480, :640]
            centre = np.array([(columns * mass).sum(), (rows * mass).sum()]) / mass.sum()
            (straight,) = lens.points(np.array([dot]), np.array([frame]))
            np.testing.assert_allclose(centre, straight, atol=0.4)


def test_an_enlarged_picture_comes_back_to_its_size_about_its_place() -> None:
    """Landmarks' depth too; other frames stay as they are."""
    zoom = np.array([[1, 0, 0], [1.5, 100, 200]], np.float32)
    points = np.random.default_rng(0).uniform(50, 400, (2, 478, 3)).astype(np.float32)
    clip = Landmarks(np.arange(2) / 25, points, np.ones(2), np.zeros((2, 52)), (), (640, 480))
    straight = clip.through(Lens(FOCAL, PRINCIPAL, (), zoom)).points
    np.testing.assert_array_equal(straight[0], points[0])
    back = 1.5 * (straight[1] - (100, 200, 0)) + (100, 200, 0)
    np.testing.assert_allclose(back, points[1], atol=1e-3)
    assert Lens(FOCAL, PRINCIPAL, (), zoom).times(np.array([1, 0])).tolist() == [1.5, 1.0]


def test_where_an_enlarged_picture_ends() -> None:
    """What is made smaller is less than the whole, and what is made larger no more."""
    zoom = np.array([[1, 0, 0], [2, 100, 200], [0.5, 319.5, 239.5]], np.float32)
    ends = Lens(FOCAL, PRINCIPAL, (), zoom).ends((640, 480), np.array([2, 1, 0]))
    whole = [[0, 0], [639, 479]]
    np.testing.assert_allclose(ends, [whole, [[50, 100], [369.5, 339.5]], whole])


def test_a_picture_ends_where_the_lens_saw_nothing_more() -> None:
    """Beyond, the straight picture goes on as its edge is."""
    picture = np.full((480, 640, 3), 200, np.uint8)
    pincushion, barrel = (Lens(FOCAL, PRINCIPAL, (k1,)) for k1 in (0.1, -0.1))
    ((left, top), (right, bottom)) = pincushion.ends((640, 480), np.array([0]))[0]
    seen_at = seen(np.array([[left, y] for y in (top, 120.0, 239.5)]), (0.1,))
    assert 10 < left < 60 and top > 0 and seen_at[:, 0].min() == pytest.approx(0, abs=0.5)
    assert (right, bottom) == pytest.approx((639 - left, 479 - top), abs=0.01)
    assert (pincushion.picture(picture, 0) == 200).all()
    np.testing.assert_array_equal(barrel.ends((640, 480), np.array([0]))[0], [[0, 0], [639, 479]])


def test_what_is_too_fine_for_the_smaller_picture_is_taken_out() -> None:
    stripes = np.zeros((60, 80, 3), np.uint8)
    stripes[:, ::2] = 255
    zoom = np.array([[1.6, 40, 30]], np.float32)
    smaller = Lens(FOCAL, PRINCIPAL, (), zoom).picture(stripes, 0)[20:40, 25:55, 0]
    unblurred = Lens(FOCAL, PRINCIPAL, (), zoom / 1.6).picture(stripes, 0)[20:40, 25:55, 0]
    assert smaller.std() < 0.25 * unblurred.std() and smaller.mean() == pytest.approx(127, abs=4)


def test_a_pinhole_changes_nothing() -> None:
    lens = Lens(FOCAL, PRINCIPAL, ())
    picture, points = np.full((4, 5, 3), 7, np.uint8), np.array([[1.25, np.nan]], np.float32)
    assert lens.picture(picture, 0) is picture
    np.testing.assert_array_equal(lens.points(points, np.zeros(1, int)), points)
    enlarged = Lens(FOCAL, PRINCIPAL, (), np.array([[1, 0, 0], [2, 1, 1]], np.float32))
    assert enlarged.picture(picture, 0) is picture and enlarged.picture(picture, 1) is not picture
