"""What the report says."""

import pytest

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
