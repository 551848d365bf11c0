"""Scenes drawn by lot: what the tracker makes of people whom no choice of its methods has seen.

`stranger1` to `stranger6` are in the bench's table and decide nothing; whoever chooses a method or a constant does so
on others, `stranger101` and up.
"""

from __future__ import annotations

import re

import numpy as np

from benchmarks.rendered_heads import Colour, Scene
from tracker.track import F64

UNSEEN = 6
SIZES = ((640, 640), (1280, 720), (720, 1280))
DISTANCE_M = (0.35, 1.0)  # of the face: arm's length, a desk, an interview
DARK, PALE = np.array([0.50, 0.42, 0.38]), np.array([1.05, 1.03, 1.02])  # skin, factors of the painted albedo
BLACK, FAIR = np.array([0.06, 0.05, 0.05]), np.array([0.60, 0.48, 0.33])  # hair
# One as likely as another.
BEFORE_FACE = ("nothing", "nothing", "nothing", "nothing", "fringe", "fringe", "glasses", "hand")
STUBBLE, SWEEP = 0.3, 0.2  # share of people


def drawn(number: int) -> Scene:
    """The scene `stranger<number>`: each has a person, camera, light and way to move of its own."""
    random = np.random.default_rng((number, 30))
    size = SIZES[random.integers(len(SIZES))]
    face_px_per_m = random.uniform(1900, 2500)
    distance = np.exp(random.uniform(*np.log(DISTANCE_M)))
    before_face = BEFORE_FACE[random.integers(len(BEFORE_FACE))]
    return Scene(
        f"stranger{number}",
        1000 + number,
        bend_mm=random.uniform(0.8, 1.6),
        warp=random.uniform(0.15, 0.28),
        size=size,
        focal=float(distance) * face_px_per_m / max(size),
        face_px_per_m=face_px_per_m,
        head=random.uniform(0.4, 1.4),
        speech_start_s=random.uniform(0, 34),
        skin=_between(DARK, PALE, random),
        hair=_between(BLACK, FAIR, random),
        stubble=random.uniform(0.1, 0.4) * float(random.random() < STUBBLE),
        key_light=(random.uniform(-60, 60), random.uniform(10, 50)),
        key_sweep_deg=random.uniform(20, 50) * float(random.random() < SWEEP),
        ambient=random.uniform(0.25, 0.6),
        gloss=random.uniform(0.04, 0.15),
        shutter=random.uniform(0.2, 0.5),
        noise=random.uniform(2, 5),
        crf=int(random.integers(20, 28)),
        fringe=before_face == "fringe",
        glasses=before_face == "glasses",
        hand=before_face == "hand",
    )


def _between(one: F64, other: F64, random: np.random.Generator) -> Colour:
    """A colour somewhere from one to the other."""
    red, green, blue = one + random.random() * (other - one)
    return float(red), float(green), float(blue)


def number_of(name: str) -> int | None:
    """7 of `stranger7`; None of another name."""
    told = re.fullmatch(r"stranger(\d+)", name)
    return None if told is None else int(told[1])


def strangers(names: set[str]) -> list[tuple[str, Scene]]:
    """Group and scene of the strangers among the names of clips; without any names the unseen ones."""
    unseen = range(1, UNSEEN + 1)
    numbers = {number for name in names if (number := number_of(name)) is not None} if names else unseen
    return [("unseen" if number in unseen else "further", drawn(number)) for number in sorted(numbers)]
