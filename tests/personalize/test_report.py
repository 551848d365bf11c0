"""What the report says."""

from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

from personalize.evaluation import charts
from personalize.evaluation.report import _sound_offset


@pytest.mark.parametrize(
    ("found_s", "sure", "says"),
    [
        (0.0, False, "0 ms (not sure, left as it is)"),  # of silence
        (0.012, False, "12 ms late (small, left as it is)"),
        (-0.06, False, "60 ms early (small, left as it is)"),
        (0.07, False, "70 ms late (not sure, left as it is)"),
        (0.2, True, "200 ms late (corrected)"),
    ],
)
def test_a_small_offset_of_the_sound_is_told_from_an_unsure_one(
    found_s: float, sure: bool, says: str
) -> None:
    assert _sound_offset({"av_offset_estimate_s": found_s, "av_offset_sure": sure}) == says


def test_single_frames_that_are_left_out_are_shaded(monkeypatch: pytest.MonkeyPatch) -> None:
    shaded: list[tuple[float, float]] = []
    limits: list[float] = []
    bars = Axes.broken_barh

    def shade(axes: Axes, spans: list[tuple[float, float]], *where: Any, **look: Any) -> None:
        shaded.extend(spans)
        bars(axes, spans, *where, **look)

    monkeypatch.setattr(Axes, "broken_barh", shade)
    monkeypatch.setattr(charts, "_svg", lambda figure: limits.extend(figure.axes[0].get_xlim()) or "")
    charts.timeline(np.arange(8) / 25, np.ones(8), np.array([0, 1, 1, 0, 1, 1, 0, 0], bool))
    np.testing.assert_allclose(shaded, [(0, 0.04), (0.12, 0.04), (0.24, 0.08)], atol=1e-9)
    assert limits == pytest.approx([0, 0.32])
