"""Every other shot of a film is enlarged, at the times that it had, and the film is gone afterwards."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.enlarged import LARGER, LARGER_S, PLAIN_S, enlarged
from personalize.pictures import FrameReader
from tests.personalize.video_factory import write_video


def test_every_other_shot_is_larger(tmp_path: Path) -> None:
    rgb = np.zeros((160, 240, 3), np.uint8)
    rgb[70:91, 150:171] = 255
    turn = PLAIN_S + LARGER_S
    times = [0.0, PLAIN_S - 0.1, PLAIN_S + 0.04, turn - 0.04, turn + 0.04]
    video = write_video(tmp_path / "v.mp4", [rgb] * 5, times)
    with enlarged(video) as film:
        shown = list(FrameReader(film))
    assert not film.exists()
    assert [time for time, _ in shown] == pytest.approx(times, abs=1e-3)
    middle, place = np.array([79.5, 119.5]), np.array([80.0, 160.0])
    for (_, picture), times_larger in zip(shown, (1, 1, LARGER, LARGER, 1)):
        found = np.argwhere(picture[..., 0] > 127)
        np.testing.assert_allclose(found.mean(0), middle + times_larger * (place - middle), atol=1)
        assert np.ptp(found[:, 0]) == pytest.approx(20 * times_larger, abs=2)
