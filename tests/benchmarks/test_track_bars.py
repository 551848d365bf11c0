"""The limits: means and worst values over clips, the last stage's row, gains, and clips that get worse."""

import numpy as np
import pytest

from benchmarks.track_bars import BARS, Bar, Row, last_stages, print_bars


def rows() -> list[Row]:
    def errors(about: float, rotation: float, focal: float, turned: float) -> dict[str, float]:
        return {
            "opening_centred_mm": about,
            "rotation_deg": rotation,
            "jitter_mm": about,
            "focal_pct": focal,
            "turn_deg": turned,
            "lip_motion_truth": 1.5,
            "surface_mm": 1.0,
            "mean_surface_mm": 2.0,
        }

    return [
        Row("own", "a", "landmarks", errors(1.0, 1.0, -5, 20)),
        Row("own", "a", "refined", errors(0.5, 1.1, -5, 20)),
        Row("shared", "b", "landmarks", errors(1.0, 1.0, 40, 5)),
        Row("shared", "b", "refined", errors(0.7, 0.1, 40, 5)),
        Row("person", "c", "landmarks", errors(0.1, 0.1, 0, 20)),
    ]


def test_bars_look_at_the_last_stage_of_their_groups() -> None:
    last = last_stages(rows())
    assert [(row.clip, row.stage) for row in last] == [("a", "refined"), ("b", "refined"), ("c", "landmarks")]
    bar = Bar("about", ("own", "shared"), "opening_centred_mm", 0.6)
    assert bar.reached(last) == 0.6 and bar.holds(0.6) and not bar.holds(0.61)
    assert Bar("about", ("own",), "opening_centred_mm", 0.6, worst=True).reached(last) == 0.5
    assert np.isnan(Bar("none", ("own",), "still_mm", 0.1).reached(last))


def test_focal_counts_only_where_the_head_turns() -> None:
    assert Bar("focal", ("own", "shared"), "turning_focal_pct", 10, worst=True).reached(rows()) == 5


def test_a_still_face_does_not_lower_the_mean_of_motion_errors() -> None:
    still = Row("own", "d", "refined", {"opening_centred_mm": 0.0, "lip_motion_truth": 0.0})
    assert Bar("about", ("own",), "opening_centred_mm", 0.6).reached([*last_stages(rows()), still]) == 0.5


def test_frames_lost_on_one_clip_are_not_averaged_away() -> None:
    kept, lost = (
        Row("person", "kept", "landmarks", {"lost_pct": 0.0}),
        Row("own", "a", "refined", {"lost_pct": 1.4}),
    )
    (bar,) = (bar for bar in BARS if bar.error == "lost_pct")
    assert bar.reached([kept] * 9 + [lost]) == 1.4 and not bar.holds(1.4) and bar.holds(0.7)


def test_a_mean_does_not_hide_the_film_behind_lower_bounds() -> None:
    def row(group: str, clip: str, lips: float) -> Row:
        return Row(group, clip, "refined", {"lip_motion_mm": lips, "lip_motion_truth": 1.5})

    clips = [row("person", "a", 0.2), row("person", "b", 0.3), row("inside", "c", 0.7)]
    (bar,) = (bar for bar in BARS if bar.name.startswith("in model: lip motion"))
    assert bar.reached(clips) == pytest.approx(0.4) and bar.answer(bar.reached(clips)) == "yes"
    assert bar.by_group(clips) == "person 0.250 yes, inside 0.700 no"
    assert bar.by_group(clips[:2]) == "person 0.250 yes"


def test_printed_answers(capsys: pytest.CaptureFixture[str]) -> None:
    print_bars(rows())
    lines = capsys.readouterr().out.splitlines()
    answer = {line.split(",")[0].split(" lowered")[0]: line for line in lines if line.strip()}
    assert answer["out of model: surface against the mean head's"].endswith(
        "  yes: own 50.000 yes, shared 50.000 yes"
    )
    assert answer["opening_centred_mm"].endswith("yes") and " 40.0 " in answer["opening_centred_mm"]
    assert answer["rotation_deg"].endswith("no; raised on a")
    assert not any("still face" in line for line in lines)


def test_a_clip_in_which_nothing_moves_raises_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    def row(clip: str, stage: str, rotation: float, moves: float) -> Row:
        errors = {"rotation_deg": rotation, "lip_motion_truth": moves, "turn_deg": 0.0, "focal_pct": 0.0}
        errors |= {
            "opening_centred_mm": rotation,
            "jitter_mm": rotation,
            "surface_mm": 1.0,
            "mean_surface_mm": 2.0,
        }
        return Row("own", clip, stage, errors)

    clips = [row("talks", "landmarks", 1.0, 1.5), row("talks", "refined", 0.5, 1.5)]
    still = [row("still", "landmarks", 0.01, 0.0), row("still", "refined", 0.02, 0.0)]
    print_bars([*clips, *still])
    lines = capsys.readouterr().out.splitlines()
    (gain,) = (line for line in lines if line.startswith("rotation_deg lowered"))
    assert " 50.0 " in gain and gain.endswith("yes")
