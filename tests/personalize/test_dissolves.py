"""Made-up shots that fade into each other, and what else changes a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from personalize.dissolves import Dissolves
from personalize.shots import parted

FRAMES, BEGINS, ENDS = 100, 40, 55
rng = np.random.default_rng(0)
SCENES = [120 + 400 * gaussian_filter(rng.normal(size=(100, 160)), 3) for _ in range(2)]


def view(scene: int, right: float = 0.0, closer: float = 1.0) -> np.ndarray:
    """[36, 64] of a scene, so many pixels farther right and so many times closer."""
    place = np.float64([[1 / closer, 0, 48 + right], [0, 1 / closer, 32]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(SCENES[scene], place, (64, 36), flags=flags, borderMode=cv2.BORDER_REFLECT)


def found(pictures: Iterable[np.ndarray], fps: float = 25.0) -> np.ndarray:
    dissolves, noise = Dissolves(fps), np.random.default_rng(1)
    for picture in pictures:
        seen = np.clip(picture + noise.normal(size=picture.shape), 0, 255)
        dissolves.add(seen.astype(np.float32))
    return dissolves.found


@pytest.mark.parametrize("rate", [1, 2])
@pytest.mark.parametrize("moves", [0.0, 0.05])
def test_a_dissolve_is_found_and_nothing_beside_it(rate: int, moves: float) -> None:
    """Of .6 s, while both shots move on."""

    def picture(index: int) -> np.ndarray:
        time = index / rate
        share = np.clip((time - BEGINS) / (ENDS - BEGINS), 0, 1)
        return (1 - share) * view(0, moves * time) + share * view(1, -moves * time)

    fading = found(map(picture, range(FRAMES * rate)), 25.0 * rate)
    assert fading[(BEGINS + 4) * rate : (ENDS - 4) * rate].all()
    assert not fading[: (BEGINS - 2) * rate].any() and not fading[(ENDS + 3) * rate :].any()


@pytest.mark.parametrize(
    "picture",
    [
        lambda index: view(0, 2.0 * index % 40),
        lambda index: view(0, 12 * np.sin(index / 8)),
        lambda index: view(0, closer=1.3 + 0.25 * np.sin(index / 10)),
        lambda index: (1 + 0.5 * np.sin(index / 7)) * view(0),
        lambda index: view(0) * np.clip(index / 30, 0, 1),
        lambda index: view(index // 20 % 2),
        lambda index: view(0),
    ],
    ids=["pan", "sway", "zoom", "light", "from black", "cuts", "still"],
)
def test_nothing_else_is_a_dissolve(picture: Callable[[int], np.ndarray]) -> None:
    assert not found(map(picture, range(FRAMES))).any()


def test_a_short_clip_holds_none() -> None:
    assert found([view(0), view(1)]).tolist() == [False, False]


def test_a_dissolve_is_a_shot_of_its_own() -> None:
    segment, fading = np.repeat([0, 1], 10).astype(np.int32), np.zeros(20, bool)
    fading[3:6] = True
    assert parted(segment, fading).tolist() == [0] * 3 + [1] * 3 + [2] * 4 + [3] * 10
    assert parted(segment, np.zeros(20, bool)).tolist() == segment.tolist()
