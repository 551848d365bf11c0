"""How far painted lips part, by optical flow, while the head they are on moves about in the picture."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from tracker.lip_flow import LipFlow
from tracker.lip_lines import LipLines
from tracker.lip_motion import STRETCH, Motion, steadied

FRAMES, LINES = 12, 9
SIZE = np.array([320, 240])
ACROSS_MM = np.linspace(-16, 16, LINES)
WIDTHS = 4 + 3 * np.sin(np.arange(FRAMES) / 2.5)


def painted(widths: np.ndarray, px_per_mm: np.ndarray, turn: np.ndarray) -> tuple[list[np.ndarray], LipLines]:
    """[n] pictures [H, W, 3] u8 of two lips of one pattern each, widths [n] mm apart, and the lines across them.

    The head has the scale px_per_mm [n], is turned in the picture by turn [n] rad and wanders through it. The pattern
    moves less than the edges by the stretch of lips.
    """
    rng = np.random.default_rng(3)
    pattern = 130 + 600 * gaussian_filter(rng.normal(size=(2, 240, 320)), (0, 6, 6))
    down = np.stack([-np.sin(turn), np.cos(turn)], axis=1)
    across = np.stack([down[:, 1], -down[:, 0]], axis=1)
    centre = SIZE / 2 + np.stack(
        [np.linspace(-20, 20, len(widths)), np.linspace(10, -10, len(widths))], axis=1
    )
    pixels = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1)
    pictures = []
    for row, width in enumerate(widths):
        x, y = ((pixels - centre[row]) @ axis[row] / px_per_mm[row] for axis in (across, down))
        seen = np.full(x.shape, 40.0)
        for lip, sign in ((0, -1), (1, 1)):
            beyond = sign * y > width / 2
            at = np.stack([y - sign * width / 2 / STRETCH, x])[:, beyond]
            seen[beyond] = map_coordinates(pattern[lip], 4 * at + [[120], [160]], order=1, mode="reflect")
        noisy = seen + rng.normal(size=seen.shape) * 3
        pictures.append(np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2))
    step = px_per_mm[:, None] * down
    middle = centre[:, None] + ACROSS_MM[:, None] * (px_per_mm[:, None] * across)[:, None]
    return pictures, LipLines(middle, step, np.zeros((len(widths), LINES, 4)))


def apart(widths: np.ndarray) -> np.ndarray:
    """[n, 9, 2] mm, the edges of lips that are widths [n] mm apart."""
    return np.repeat(np.stack([-widths / 2, widths / 2], axis=-1)[:, None], LINES, axis=1)


def motion(widths: np.ndarray, px_per_mm: np.ndarray, turn: np.ndarray, links: tuple[int, ...]) -> Motion:
    """By the flow between painted pictures."""
    pictures, lines = painted(widths, px_per_mm, turn)
    flow = LipFlow(lines, links)
    for row, picture in enumerate(pictures):
        flow.look(picture, row)
    return flow.motion(apart(widths))


STILL = np.zeros(FRAMES)


@pytest.mark.parametrize(
    ("px_per_mm", "turn"),
    [
        (np.full(FRAMES, 2.0), STILL),
        (np.full(FRAMES, 1.2), STILL),
        (np.full(FRAMES, 5.0), STILL),
        (np.linspace(1.8, 2.4, FRAMES), np.linspace(-0.3, 0.3, FRAMES)),
    ],
    ids=["usual", "small", "large", "comes and turns"],
)
def test_lips_part_by_what_they_are_painted_apart(px_per_mm: np.ndarray, turn: np.ndarray):
    for links, change in motion(WIDTHS, px_per_mm, turn, (1, 8)).items():
        true = WIDTHS[links:] - WIDTHS[:-links]
        assert change.shape == (FRAMES - links, LINES)
        assert np.sqrt(np.mean((change - true[:, None]) ** 2)) < 0.15 * np.abs(true).max()


def test_lips_seen_backwards_close_as_they_open():
    pictures, lines = painted(WIDTHS[:4], np.full(4, 2.0), np.zeros(4))
    there, back = LipFlow(lines, [1]), LipFlow(lines, [1])
    for row in range(4):
        there.look(pictures[row], row)
        back.look(pictures[3 - row], 3 - row)
    edges = apart(WIDTHS[:4])
    np.testing.assert_allclose(back.motion(edges[::-1])[1], -there.motion(edges)[1][::-1], atol=1e-6)


def test_a_clip_too_short_for_a_link_tells_the_others_alone():
    assert list(motion(WIDTHS[:5], np.full(5, 2.0), np.zeros(5), (1, 8))) == [1]
    assert motion(WIDTHS[:1], np.full(1, 2.0), np.zeros(1), (1, 8)) == {}


def test_two_motions_that_err_apart_from_each_other_tell_widths_better_than_one():
    rng = np.random.default_rng(5)
    true = np.repeat(4 + 3 * np.sin(np.arange(100) / 5)[:, None], LINES, axis=1)
    edges = np.stack([0 * true, true + rng.normal(size=true.shape) * 0.5], axis=-1)
    told = [
        {
            links: true[links:] - true[:-links] + rng.normal(size=(100 - links, LINES)) * 0.3
            for links in (1, 8)
        }
        for _ in range(2)
    ]
    run, time = np.zeros(100, np.int64), np.arange(100) / 25
    one, two = ((steadied(edges, told[:count], run, time) - true).std() for count in (1, 2))
    assert two < 0.95 * one < 0.8 * 0.5
