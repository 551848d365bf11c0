"""Irises painted between lids, and a landmarker that follows them only in part."""

import numpy as np
import pytest

from tracker.irises import LOWER_LIDS, REACH_MM, UPPER_LIDS, EyeWindows, iris_shifts
from tracker.landmark_indices import IRIS_CENTRES, POINTS

FRAMES, PX_PER_MM = 40, 3.0
ALL = np.arange(FRAMES)
SIZE = (200, 400)
EYES = np.array([[270.0, 100.0], [130.0, 100.0]])  # px, left and right in the picture as the camera sees them
SKIN, WHITE, IRIS, LASHES = (205, 165, 145), (225, 220, 215), (70, 60, 50), (40, 30, 30)
# mm across and down, of both eyes.
LOOKS = np.stack([3 * np.sin(ALL / 3), 1.5 * np.cos(ALL / 4)], axis=1)


def landmarks(opened: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """[n, 478, 2] px of lids `opened` [n] mm above and below the eyes' middles, and of irises `seen` [n, 2, 2] mm."""
    out = np.zeros((len(opened), POINTS, 2))
    x = np.linspace(14, -14, 9)
    for eye, mirrored in ((0, 1), (1, -1)):
        for lids, up in ((UPPER_LIDS, -1), (LOWER_LIDS, 1)):
            y = up * opened[:, None] * (1 - (x / 14) ** 2)
            rim = np.stack(np.broadcast_arrays(mirrored * x, y), axis=-1)
            out[:, lids[eye]] = EYES[eye] + PX_PER_MM * rim
    out[:, IRIS_CENTRES] = EYES + PX_PER_MM * seen
    return out


def painted(opened: np.ndarray, irises: np.ndarray, lashes_mm: float = 0.0) -> list[np.ndarray]:
    """[n] pictures [H, W, 3] u8 of eyes whose irises lie at [n, 2, 2] mm, under lashes so far below the upper lid."""
    rng = np.random.default_rng(4)
    pixels = np.stack(np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0])), axis=-1)
    pictures = []
    for row in range(len(opened)):
        picture = np.broadcast_to(np.array(SKIN, float), (*SIZE, 3)).copy()
        for eye in range(2):
            x, y = np.moveaxis((pixels - EYES[eye]) / PX_PER_MM, -1, 0)
            lid = opened[row] * (1 - (x / 14) ** 2)
            inside = np.abs(y) < lid
            away = np.hypot(x - irises[row, eye, 0], y - irises[row, eye, 1])
            picture[inside] = WHITE
            picture[inside & (away < 6)] = IRIS
            picture[inside & (y < lashes_mm - lid)] = LASHES
        pictures.append(np.clip(picture + rng.normal(size=picture.shape) * 4, 0, 255).astype(np.uint8))
    return pictures


def shifts(opened: np.ndarray, irises: np.ndarray, seen: np.ndarray, lashes_mm: float = 0.0) -> np.ndarray:
    """[n, 2, 2] mm, of what is read."""
    windows = EyeWindows.of(landmarks(opened, seen), np.full(len(opened), 1e3 * PX_PER_MM))
    greys = [windows.read(picture, row) for row, picture in enumerate(painted(opened, irises, lashes_mm))]
    return iris_shifts(np.stack(greys), windows.seen, np.arange(len(opened)))


BOTH = np.repeat(LOOKS[:, None], 2, axis=1)
OPEN = np.full(FRAMES, 6.5)


@pytest.mark.parametrize("lashes_mm", [0.0, 1.5])
def test_irises_go_as_far_as_they_are_painted(lashes_mm: float):
    seen = BOTH * (0.8, 0.5)
    found = seen + shifts(OPEN, BOTH, seen, lashes_mm)
    assert (seen - BOTH).std(0).min() > 0.35
    assert (found - BOTH).std(0)[:, 0].max() < 0.15
    assert (found - BOTH).std(0)[:, 1].max() < 0.3


def test_what_landmarks_err_by_throughout_stays():
    aside = np.array([0.8, -0.6])
    np.testing.assert_allclose(np.median(shifts(OPEN, BOTH, BOTH + aside), axis=0), 0.0, atol=0.05)


def test_behind_shut_lids_nothing_is_read():
    opened = np.where(ALL % 8 == 0, 0.5, OPEN)
    found = shifts(opened, BOTH, 0.5 * BOTH)
    np.testing.assert_allclose(found[ALL % 8 == 0], 0.0, atol=0.1)
    assert np.abs(found[ALL % 8 != 0]).max() > 1
    np.testing.assert_array_equal(shifts(0 * OPEN, BOTH, BOTH), 0.0)


def test_an_eye_that_winks_follows_the_other():
    windows = EyeWindows.of(landmarks(OPEN, 0.5 * BOTH), np.full(FRAMES, 1e3 * PX_PER_MM))
    greys = np.stack([windows.read(picture, row) for row, picture in enumerate(painted(OPEN, BOTH))])
    winks = np.arange(5, FRAMES, 7)
    windows.seen[winks, 1] = False
    left, right = np.moveaxis(iris_shifts(greys, windows.seen, ALL)[winks], 1, 0)
    assert 0.4 < np.polyfit(left[:, 0], right[:, 0], 1)[0] < 0.9


def test_no_shift_is_longer_than_it_may_be():
    rng = np.random.default_rng(6)
    windows = EyeWindows.of(landmarks(OPEN, BOTH), np.full(FRAMES, 1e3 * PX_PER_MM))
    noise = rng.integers(0, 256, windows.seen.shape).astype(np.uint8)
    assert np.abs(iris_shifts(noise, windows.seen, ALL)).max() < 2 * REACH_MM


def test_irises_are_moved_along_the_eyes_of_a_head_turned_in_the_picture():
    straight = landmarks(OPEN, BOTH)
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    turned = straight @ turn
    move = np.ones((FRAMES, 2, 2)) * (1.0, 2.0)
    windows = EyeWindows.of(turned, np.full(FRAMES, 1e3 * PX_PER_MM))
    moved = windows.moved(turned, move) - turned
    np.testing.assert_allclose(moved[:, IRIS_CENTRES], PX_PER_MM * move @ turn)
    assert np.count_nonzero(moved.any((0, 2))) == 2
