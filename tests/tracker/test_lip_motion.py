"""Widths between painted lips whose edges are read with errors that last, and how far the lips' pattern moves."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from tracker.lip_lines import SAMPLES
from tracker.lip_motion import STRETCH, along_lines, steadied

FRAMES = 100
ONE_RUN = np.zeros(FRAMES, np.int64)
TIME = np.arange(FRAMES) / 25


def patterned(width: np.ndarray) -> np.ndarray:
    """[n, 9, S, 3] u8: two lips of one smooth pattern each, width [n, 9] mm apart, and something else between them.

    The pattern moves less than the edges by the stretch of lips.
    """
    rng = np.random.default_rng(0)
    place = np.arange(-40, 40, 0.1)
    pattern = 130 + 300 * gaussian_filter1d(rng.normal(size=(2, 3, len(place))), 12)
    out = np.empty((*width.shape, len(SAMPLES), 3))
    for lip, sign in ((0, -1), (1, 1)):
        edge, moved = sign * width / 2, sign * width / 2 / STRETCH
        at = SAMPLES - moved[..., None]
        seen = np.stack([np.interp(at, place, pattern[lip, channel]) for channel in range(3)], axis=-1)
        beyond = sign * (SAMPLES - edge[..., None]) > 0
        out[beyond] = seen[beyond]
        out[(np.sign(SAMPLES) == sign) & ~beyond] = 40
    return np.clip(out + rng.normal(size=out.shape) * 3, 0, 255).astype(np.uint8)


def steady(width: np.ndarray, colours: np.ndarray, run: np.ndarray, time: np.ndarray) -> np.ndarray:
    """[n, 9] mm, of widths [n, 9] mm read about the lines' middles and the colours along these."""
    edges = np.stack([-width / 2, width / 2], axis=-1)
    return steadied(edges, [along_lines(edges, colours, run, time)], run, time)


@pytest.fixture(scope="module")
def openings() -> tuple[np.ndarray, np.ndarray]:
    """True widths and those read [n, 9] mm, whose errors last for some frames."""
    return spoken(1)


def spoken(rate: int) -> tuple[np.ndarray, np.ndarray]:
    """True widths and those read [n, 9] mm of the same seconds, at so many times 25 frames a second."""
    rng = np.random.default_rng(2)
    true = np.repeat(4 + 3 * np.sin(np.arange(FRAMES * rate) / rate / 5)[:, None], 9, axis=1)
    error = gaussian_filter1d(rng.normal(size=true.shape), 1.5 * rate, axis=0)
    return true, true + 0.5 * error / error.std()


def test_the_lips_motion_takes_a_third_of_a_reading_error(openings: tuple[np.ndarray, np.ndarray]):
    true, read = openings
    widths = steady(read, patterned(true), ONE_RUN, TIME)
    assert (widths - true).std() < 0.67 * (read - true).std()


@pytest.mark.parametrize("rate", [2, 4])
def test_at_a_higher_rate_errors_of_the_same_time_are_taken_as_far(rate: int):
    true, read = spoken(rate)
    time = np.arange(len(true)) / (25 * rate)
    widths = steady(read, patterned(true), np.zeros(len(true), np.int64), time)
    assert (widths - true).std() < 0.67 * (read - true).std()


def test_right_readings_stay(openings: tuple[np.ndarray, np.ndarray]):
    true, _ = openings
    np.testing.assert_allclose(steady(true, patterned(true), ONE_RUN, TIME), true, atol=0.25)


def test_light_that_changes_is_no_motion(openings: tuple[np.ndarray, np.ndarray]):
    true, _ = openings
    flicker = np.where(np.arange(FRAMES) % 4 < 2, 1.0, 0.6)[:, None, None, None]
    dim = (patterned(true) * flicker).astype(np.uint8)
    np.testing.assert_allclose(steady(true, dim, ONE_RUN, TIME), true, atol=0.25)


def test_a_closure_of_one_frame_is_not_smoothed_away():
    true = np.full((FRAMES, 9), 5.0)
    true[50] = 0
    widths = steady(true, patterned(true), ONE_RUN, TIME)
    assert widths[50].max() < 0.1
    assert widths[[48, 49, 51, 52]].min() > 4.7


def test_a_shut_mouth_is_believed_where_motion_says_otherwise():
    true = np.full((FRAMES, 9), 5.0)
    read = true.copy()
    read[40:60] = 0
    assert steady(read, patterned(true), ONE_RUN, TIME)[45:55].max() < 0.3


def test_lips_are_not_followed_across_a_cut_nor_under_a_hand(openings: tuple[np.ndarray, np.ndarray]):
    true, read = openings
    colours = patterned(true)
    run = np.where(np.arange(FRAMES) < 60, 0, 1)
    both = steady(read, colours, run, TIME)
    for part in (slice(0, 60), slice(60, FRAMES)):
        np.testing.assert_allclose(both[part], steady(read[part], colours[part], run[part], TIME[part]))
    covered = np.where((np.arange(FRAMES) >= 40) & (np.arange(FRAMES) < 50), -1, 0)
    np.testing.assert_allclose(steady(read, colours, covered, TIME)[40:50], read[40:50])


def test_times_that_are_broken_take_no_memory():
    true = np.full((FRAMES, 9), 3.0)
    widths = steady(true, patterned(true), ONE_RUN, np.arange(FRAMES) * 1e-9)
    np.testing.assert_allclose(widths, true, atol=0.1)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_clip_of_few_frames(count: int):
    true = np.full((count, 9), 3.0)
    np.testing.assert_allclose(steady(true, patterned(true), ONE_RUN[:count], TIME[:count]), true, atol=0.1)


def test_edges_that_cross_are_shut():
    crossed = np.full((3, 9), -0.5)
    assert steady(crossed, patterned(np.zeros((3, 9))), ONE_RUN[:3], TIME[:3]).max() < 0.05


def test_the_same_motion_told_twice_is_believed_no_more(openings: tuple[np.ndarray, np.ndarray]):
    true, read = openings
    edges = np.stack([-read / 2, read / 2], axis=-1)
    motion = along_lines(edges, patterned(true), ONE_RUN, TIME)
    once, twice = (steadied(edges, [motion] * times, ONE_RUN, TIME) for times in (1, 2))
    np.testing.assert_allclose(twice, once)
