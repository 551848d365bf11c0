"""How far a mesh lies beside the picture, where the face looks as it should but for a shift, and where it does not."""

import cv2
import numpy as np
import pytest

from benchmarks.beside import PARTS, about_usual, beside, parts
from benchmarks.real_tracks import mesh_on_picture
from tests.tracker.turning_head import SIZE, picture, shifted_landmarks, turning_track
from tracker.albedo import Rendering
from tracker.head import HeadModel, load_head
from tracker.scene import Crop, Scene, scene


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def seen(head: HeadModel) -> Scene:
    track = turning_track(head, 3)
    landmarks = shifted_landmarks(track, head, 0)
    return scene(picture(track, head, 1), Crop((0, 0), SIZE, SIZE), track, 1, landmarks, head)


@pytest.fixture(scope="module")
def rows(head: HeadModel) -> list[np.ndarray]:
    return parts(head, np.zeros(len(head.identity_basis), np.float32))


def skin(seen: Scene, seed: int) -> np.ndarray:
    """[h, w, 3] u8: freckles all over what the scene's raster covers."""
    noise = np.random.default_rng(seed).normal(size=seen.raster.triangle.shape).astype(np.float32)
    spots = cv2.GaussianBlur(noise, (0, 0), 4)
    grey = cv2.normalize(spots, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def test_each_part_has_its_own_vertices_on_its_side(head: HeadModel, rows: list[np.ndarray]) -> None:
    left, right, nose, mouth = (head.template[part].mean(0) for part in rows)
    assert left[0] > 0.02 > -0.02 > right[0]
    assert left[1] > nose[1] > mouth[1] and nose[2] > max(left[2], mouth[2])


@pytest.mark.parametrize("moved_px", [0, 2, -3])
def test_parts_are_told_to_lie_beside_a_picture_that_is_moved(
    moved_px: int, seen: Scene, rows: list[np.ndarray]
) -> None:
    expected = skin(seen, 0)
    known = np.full(expected.shape[:2], 255, np.uint8)
    found = beside(seen, Rendering(expected, known, np.roll(expected, moved_px, axis=0)), rows)
    expected_mm = np.tile([0, 1e3 * moved_px / seen.px_per_m], (len(PARTS), 1))
    np.testing.assert_allclose(found, expected_mm, atol=0.2)


def test_what_does_not_look_like_it_should_is_not_found(seen: Scene, rows: list[np.ndarray]) -> None:
    known = np.full(seen.raster.triangle.shape, 255, np.uint8)
    other = beside(seen, Rendering(skin(seen, 0), known, skin(seen, 1)), rows)
    assert np.isnan(other).all(1).sum() >= 3


def test_what_lies_beside_in_all_frames_alike_is_not_told() -> None:
    found = np.tile([[1.0, -2.0], [0.5, 0.0]], (5, 1, 1))
    found[2, 0] += (0.3, 0.4)
    found[3, 0] = found[:, 1] = np.nan
    apart = about_usual(found)
    np.testing.assert_allclose(apart[:, 0], [0, 0, 0.5, np.nan, 0])
    assert np.isnan(apart[:, 1]).all()


def test_the_largest_is_said_with_its_time() -> None:
    apart = np.full((5, len(PARTS)), 0.2)
    apart[3, 2], apart[1, 2], apart[4] = 1.5, np.nan, 9.0  # the last is out of use
    apart[:, 3] = np.nan
    lines = mesh_on_picture(apart, np.arange(5) / 25, np.arange(5) < 4)
    assert lines[2] == "beside nose 0.20, 99 % 1.47   largest 1.50 at 0.12 s   not found 1"
    assert lines[3] == "beside mouth not told   not found 4"
