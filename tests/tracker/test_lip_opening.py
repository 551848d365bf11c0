"""Openings read from painted mouths whose landmarks err as the landmarker does."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from tracker.lip_lines import SAMPLES, fineness
from tracker.lip_opening import TRUSTED, LipColours, _colour_axes, _lit_edge, lip_edges

FRAMES, LIP_MM = 80, 7.0
ALL = np.arange(FRAMES)
UPPER, LOWER, TOOTH, DARK, SKIN = (
    (150, 80, 80),
    (180, 100, 95),
    (215, 210, 195),
    (45, 20, 20),
    (205, 165, 145),
)


def painted(
    width: np.ndarray,
    inside: tuple[tuple[int, int, int], ...] = (TOOTH, DARK),
    gain: float = 1.0,
    soft_mm: float = 0.8,
    power: float = 1.0,
) -> np.ndarray:
    """[n, 9, S, 3] u8: upper lip, teeth above darkness, lower lip along lines whose openings are width [n, 9] mm.

    soft_mm: over which one passes into the next. power: of the grey levels that mix there, 2 for light.
    """
    rng = np.random.default_rng(1)
    edge = np.stack([-width / 2 - LIP_MM, -width / 2, 0 * width, width / 2, width / 2 + LIP_MM], axis=-1)
    colours = np.array([SKIN, UPPER, inside[0], inside[-1], LOWER, SKIN], np.float64) ** power
    # Each sample sees a little of its neighbours: edges are soft.
    share = np.clip((SAMPLES - edge[..., None]) / soft_mm + 0.5, 0, 1)
    steps = np.diff(colours, axis=0)
    picture = (colours[0] + np.einsum("nqes,ec->nqsc", share, steps)) ** (1 / power)
    return np.clip(gain * picture + rng.normal(size=picture.shape) * 4, 0, 255).astype(np.uint8)


def marked(width: np.ndarray) -> np.ndarray:
    """[n, 9, 4] mm: where landmarks would see the edges of lips that are width [n, 9] apart."""
    return np.stack([-width / 2 - LIP_MM, -width / 2, width / 2, width / 2 + LIP_MM], axis=-1)


def lip_widths(colours: np.ndarray, marks: np.ndarray, sound: np.ndarray) -> np.ndarray | None:
    """[n, 9] mm between the edges."""
    edges, _ = lip_edges(colours, marks, sound)
    return None if edges is None else np.maximum(edges[..., 1] - edges[..., 0], 0)


@pytest.fixture(scope="module")
def openings() -> tuple[np.ndarray, np.ndarray]:
    """True and landmarks' openings [n, 9] mm; half of the frames are shut."""
    rng = np.random.default_rng(0)
    true = np.repeat(np.maximum(8 * np.sin(np.arange(FRAMES) / 4), 0)[:, None], 9, axis=1)
    error = np.convolve(rng.normal(size=FRAMES + 4), np.full(5, 0.45), "valid")
    return true, np.maximum(1.1 * true + 0.4 + error[:, None] * (true > 0), 0.3)


def test_colours_halve_the_landmarks_error(openings: tuple[np.ndarray, np.ndarray]):
    true, seen = openings
    widths = lip_widths(painted(true), marked(seen), ALL)
    assert (widths - true).std() < 0.5 * (seen - true).std()
    assert np.corrcoef(widths.ravel(), true.ravel())[0, 1] > 0.99


@pytest.mark.parametrize(("above", "found"), [(0.02, 3.1), (0.2, 2.6)])
def test_the_lower_lip_begins_where_half_of_its_light_is_seen(above: float, found: float):
    light = above + (0.4 - above) * np.clip(SAMPLES - 3.1 + 0.5, 0, 1)
    assert _lit_edge(light, SAMPLES, 2.6) == pytest.approx(found, abs=0.1)


def test_a_dark_mouth_is_not_read_narrower_than_its_light_tells():
    true = np.tile(np.linspace(4, 9, FRAMES)[:, None], 9)
    soft = painted(true, inside=(DARK, DARK), soft_mm=2.0, power=2.0)
    # Of what the logarithm takes off, a third of a millimetre at either lip, the upper one's is left.
    assert -0.45 < (lip_widths(soft, marked(true), ALL) - true).mean() < 0


@pytest.mark.parametrize("down", [-1.5, 1.5])
def test_a_mouth_seen_too_high_or_too_low_is_as_wide(openings: tuple[np.ndarray, np.ndarray], down: float):
    true, seen = openings
    moved = marked(seen) + np.array([0, down, down, 0])
    np.testing.assert_allclose(
        lip_widths(painted(true), moved, ALL), lip_widths(painted(true), marked(seen), ALL), atol=0.4
    )


def test_shut_lips_stay_shut(openings: tuple[np.ndarray, np.ndarray]):
    true, seen = openings
    widths = lip_widths(painted(true), marked(seen), ALL)
    assert widths[true == 0].max() < seen[true == 0].min() + 0.2


def test_light_changes_nothing(openings: tuple[np.ndarray, np.ndarray]):
    true, seen = openings
    dim = np.where(np.arange(FRAMES)[:, None, None, None] % 20 < 10, painted(true), painted(true, gain=0.6))
    np.testing.assert_allclose(
        lip_widths(dim, marked(seen), ALL), lip_widths(painted(true), marked(seen), ALL), atol=0.5
    )


def test_nothing_is_told_without_a_difference(openings: tuple[np.ndarray, np.ndarray]):
    true, seen = openings
    for colours in (np.zeros_like(painted(true)), painted(true, inside=(UPPER, LOWER))):
        edges, like_lips = lip_edges(colours, marked(seen), ALL)
        assert edges is None and like_lips > 0.8


def test_a_mouth_that_never_opens_tells_nothing():
    shut = np.full((FRAMES, 9), 0.4)
    for part in (ALL, ALL[:1]):
        edges, like_lips = lip_edges(painted(0 * shut)[part], marked(shut)[part], ALL[: len(part)])
        assert edges is None and np.isnan(like_lips)


def test_colours_that_noise_makes_alike_still_tell_more_than_landmarks(
    openings: tuple[np.ndarray, np.ndarray],
):
    true, seen = openings
    clear = painted(true)
    noise = np.random.default_rng(3).normal(size=clear.shape) * 60
    edges, like_lips = lip_edges(np.clip(clear + noise, 0, 255).astype(np.uint8), marked(seen), ALL)
    assert edges is not None and 0.2 < like_lips < 0.4
    assert (edges[..., 1] - edges[..., 0] - true).std() < 0.7 * (seen - true).std()
    assert lip_edges(clear, marked(seen), ALL)[1] < 0.02


def test_what_covers_the_mouth_teaches_nothing(openings: tuple[np.ndarray, np.ndarray]):
    true, seen = openings
    bare = ALL[: FRAMES // 2]
    hand = painted(true)
    hand[FRAMES // 2 :] = (200, 150, 125)
    alone = lip_widths(painted(true)[bare], marked(seen)[bare], bare)
    np.testing.assert_allclose(lip_widths(hand, marked(seen), bare)[bare], alone)
    assert lip_widths(hand, marked(seen), ALL[:0]) is None


@pytest.mark.parametrize("noise", [0.0, 25.0])
def test_soft_pictures_are_told_from_sharp_ones_whatever_their_noise(
    openings: tuple[np.ndarray, np.ndarray], noise: float
):
    true, _ = openings
    sharp = painted(true, soft_mm=0.4)
    soft = gaussian_filter1d(sharp.astype(float), 3.0, axis=2)  # 1.2 mm
    grain = noise * np.random.default_rng(2).normal(size=sharp.shape)
    fine = [fineness(np.clip(picture + grain, 0, 255).astype(np.uint8)) for picture in (sharp, soft)]
    assert fine[1] < 0.13 < 0.3 < fine[0]


def test_a_black_picture_is_neither_soft_nor_sharp(openings: tuple[np.ndarray, np.ndarray]):
    assert np.isnan(fineness(np.zeros_like(painted(openings[0]))))


def test_colours_are_those_against_the_lips_of_the_same_frame(openings: tuple[np.ndarray, np.ndarray]):
    """So that light cancels, but for what the dark takes from contrasts."""
    true, _ = openings
    bright, dim = (_colour_axes(painted(true, gain=gain), marked(true)) for gain in (1.0, 0.5))
    lips = (np.abs(SAMPLES) > true[..., None] / 2 + 1) & (np.abs(SAMPLES) < true[..., None] / 2 + LIP_MM - 1)
    np.testing.assert_allclose(bright[lips].mean(0), dim[lips].mean(0), atol=0.02)
    assert np.abs(bright - dim)[lips].mean() < 0.1


def test_a_sample_counts_for_so_much_at_most_and_what_looks_alike_for_nothing(
    openings: tuple[np.ndarray, np.ndarray],
):
    true, seen = openings
    table = LipColours.of(painted(true), marked(seen)).table
    assert table.max() == 0 and table.min() == -TRUSTED
    assert (table.max(0) == 0).all() and (table == 0).all(0).mean() > 0.2  # colours that are never seen


def test_what_lies_beyond_the_lips_is_not_looked_at(openings: tuple[np.ndarray, np.ndarray]):
    true, seen = openings
    colours, marks = painted(true), marked(seen)
    known, beard = LipColours.of(colours, marks), colours.copy()
    beard[(marks[..., :1] > SAMPLES) | (marks[..., 3:] < SAMPLES)] = DARK
    np.testing.assert_array_equal(known.edges(beard, marks), known.edges(colours, marks))
