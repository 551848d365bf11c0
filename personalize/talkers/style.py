"""How one talker differs from another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Style:
    """A talker's manner; the defaults are a lively, fairly even face."""

    amplitude: float = 1.0
    """Of all mouth movement."""
    jaw: float = 1.0
    """Of the jaw against the lips: low for a talker who mumbles."""
    rounding: float = 1.0
    """Of pucker and funnel."""
    spread: float = 1.0
    """Of stretch, smile and the lips' vertical opening in vowels."""
    sharpness: float = 1.0
    """How quickly one phone's shape gives way to the next; low is slurred."""
    smile: float = 0.05
    """A smile that never leaves, 0..0.3."""
    asymmetry: float = 0.08
    """Standard deviation of the difference between left and right, as a share."""
    variation: float = 0.18
    """How differently the same phone is made each time, standard deviation as a share."""
    brows: float = 1.0
    """Liveliness of the upper face."""
    head: float = 1.0
    """Range of head movement; 1 turns about 15 degrees to either side."""
    blink_gap_s: float = 3.2
    """Mean time between blinks."""

    @classmethod
    def random(cls, seed: int) -> Style:
        """A talker drawn from a wide range of manners."""
        random = np.random.default_rng((seed, 1))

        def factor(spread: float) -> float:
            return float(np.exp(spread * np.clip(random.standard_normal(), -2, 2)))

        return cls(
            amplitude=factor(0.16),
            jaw=factor(0.16),
            rounding=factor(0.2),
            spread=factor(0.25),
            sharpness=factor(0.15),
            smile=float(max(0.0, random.normal(0.05, 0.06))),
            asymmetry=float(random.uniform(0.03, 0.14)),
            brows=factor(0.4),
            head=factor(0.2),
            blink_gap_s=float(random.uniform(2.2, 4.5)),
        )
