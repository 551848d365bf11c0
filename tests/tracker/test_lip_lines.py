"""Lines across a mouth drawn by hand."""

import numpy as np

from tracker.energy import LIP_PAIRS, POSE
from tracker.landmark_indices import POINTS
from tracker.lip_lines import OUTER_PAIRS, SAMPLES, LipLines


def face() -> np.ndarray:
    """[1, 478, 2] px of an upright face at 2 px per mm, its lips 6 mm apart and 7 mm thick."""
    points = np.zeros((1, POINTS, 2))
    for column, (inner, outer) in enumerate(zip(LIP_PAIRS, OUTER_PAIRS)):
        for index, y in zip((outer[0], *inner, outer[1]), (-10.0, -3.0, 3.0, 10.0)):
            points[0, index] = 60 + 5 * column, 80 + 2 * y
    return points


def test_lines_run_down_the_face_in_millimetres():
    lines = LipLines.across(face(), np.array([2000.0]), np.zeros((1, 3 + POSE)))
    np.testing.assert_allclose(lines.marks[0], np.tile([-10.0, -3.0, 3.0, 10.0], (9, 1)), atol=1e-9)
    rows = np.tile(np.arange(160, dtype=np.uint8)[:, None, None], (1, 160, 3))
    np.testing.assert_allclose(lines.read(rows, 0)[4, :, 0], 80 + 2 * SAMPLES, atol=1)


def test_lines_beyond_the_picture_read_its_border():
    lines = LipLines.across(face() + 500, np.array([2000.0]), np.zeros((1, 3 + POSE)))
    assert (lines.read(np.full((160, 160, 3), 7, np.uint8), 0) == 7).all()


def test_opened_moves_both_lips_alike():
    lines = LipLines.across(face(), np.array([2000.0]), np.zeros((1, 3 + POSE)))
    opened = lines.opened(face(), np.full((1, 9), 8.0))
    np.testing.assert_allclose(lines.widths(opened), 8)
    (upper, lower) = np.transpose(LIP_PAIRS)
    np.testing.assert_allclose(opened[0, lower] - opened[0, upper], np.tile([0.0, 16.0], (9, 1)))
    np.testing.assert_allclose(opened[0, lower] + opened[0, upper], face()[0, lower] + face()[0, upper])


def test_a_millimetre_is_as_long_on_a_face_that_nods_and_points_down_one_that_leans():
    x = np.zeros((3, 3 + POSE))
    x[1, 3], x[2, 5] = 0.6, 0.5
    lines = LipLines.across(face().repeat(3, 0), np.array([2000.0, 2000.0, 3000.0]), x)
    np.testing.assert_allclose(lines.step[:2], [[0, 2], [0, 2]], atol=1e-9)
    np.testing.assert_allclose(lines.step[2], [-3 * np.sin(0.5), 3 * np.cos(0.5)], atol=1e-9)


def test_of_a_large_face_lines_are_means_and_not_single_pixels():
    noise = np.random.default_rng(0).integers(0, 255, (900, 900, 3), dtype=np.uint8)
    spread = []
    for scale in (2, 8):
        x = np.zeros((1, 3 + POSE))
        lines = LipLines.across(face() * scale / 2, np.array([1000.0 * scale]), x)
        spread.append(float(lines.read(noise, 0).std()))
    # The blur is .6 of a step of .4 mm: of half a pixel at least, and of two.
    assert spread[1] < 0.35 * spread[0]
