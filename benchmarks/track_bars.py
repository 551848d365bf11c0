"""The numbers that the tracker is to reach, and whether a table of errors reaches them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

INSIDE, OUTSIDE = ("person", "inside"), ("own", "unseen", "further", "shared")
ALL, FILMS = (*INSIDE, *OUTSIDE), ("inside", *OUTSIDE)
TURNS_DEG = 10.0  # a head that turns less from its mean leaves the focal length undecided
GAIN = 0.3
PHOTOMETRIC = ("opening_centred_mm", "rotation_deg", "jitter_mm")
# A face that stands still has next to none of these, and would lower their means or, by nothing, be called worse.
OF_MOTION = (
    *("lip_motion_mm", "lip_in_plane_mm", "lip_neutral_mm"),
    *("opening_rmse_mm", "opening_centred_mm", "rotation_deg", "lids_mm", "gaze_deg"),
)
STILL_MM = 0.05
RAISED = 0.01  # as a share; less is a tie


@dataclass(frozen=True)
class Row:
    """Errors of one clip after one stage, by name; NaN where the clip cannot tell."""

    group: str
    clip: str
    stage: str
    errors: dict[str, float]


@dataclass(frozen=True)
class Bar:
    """A limit for the mean, or for the worst, of an error over the clips of some groups."""

    name: str
    groups: tuple[str, ...]
    error: str
    limit: float
    at_least: bool = False
    worst: bool = False

    def reached(self, rows: list[Row]) -> float:
        """The mean or worst value, NaN without one."""
        values = [figure(row, self.error) for row in rows if row.group in self.groups]
        values = [value for value in values if np.isfinite(value)]
        if not values:
            return np.nan
        return float((min if self.at_least else max)(values) if self.worst else np.mean(values))

    def holds(self, value: float) -> bool:
        """Whether a value reaches the limit."""
        return value >= self.limit if self.at_least else value <= self.limit

    def answer(self, value: float) -> str:
        """A value's yes or no."""
        return "yes" if self.holds(value) else "no"

    def by_group(self, rows: list[Row]) -> str:
        """The same of each group alone: a mean hides films behind the lower bounds of noisy landmarks."""
        values = {group: self.reached([row for row in rows if row.group == group]) for group in self.groups}
        told = (f"{group} {v:.3f} {self.answer(v)}" for group, v in values.items() if np.isfinite(v))
        return ", ".join(told)


BARS = (
    Bar("in model: face vertices after one scale, mm", INSIDE, "face_scaled_mm", 1.0),
    Bar("in model: lip motion about its mean, mm", INSIDE, "lip_motion_mm", 0.5),
    Bar("in model: lips against the neutral, mm", INSIDE, "lip_neutral_mm", 0.8),
    Bar("in model: opening r", INSIDE, "opening_r", 0.995, at_least=True),
    Bar("in model: opening RMSE, mm", INSIDE, "opening_rmse_mm", 0.4),
    Bar("in model: rotation, degrees", INSIDE, "rotation_deg", 0.7),
    Bar("in model: focal of turning heads, %", ("inside",), "turning_focal_pct", 10.0, worst=True),
    Bar("out of model: opening r", OUTSIDE, "opening_r", 0.99, at_least=True),
    Bar("out of model: opening RMSE, mm", OUTSIDE, "opening_rmse_mm", 0.5),
    Bar("out of model: opening RMSE about its mean, mm", OUTSIDE, "opening_centred_mm", 0.3),
    Bar("out of model: lip motion in the plane, mm", OUTSIDE, "lip_in_plane_mm", 0.5),
    Bar("out of model: rotation, degrees", OUTSIDE, "rotation_deg", 0.4),
    Bar("out of model: focal of turning heads, %", OUTSIDE, "turning_focal_pct", 10.0, worst=True),
    Bar("out of model: surface, mm", OUTSIDE, "surface_mm", 1.4),
    Bar("out of model: surface against the mean head's, %", OUTSIDE, "surface_pct", 85.0),
    Bar("out of model: lids about their mean, mm", OUTSIDE, "lids_mm", 0.3),
    Bar("out of model: gaze, degrees", OUTSIDE, "gaze_deg", 1.5),
    Bar("closures within one frame, share", FILMS, "closures", 0.95, at_least=True),
    Bar("still face, rms of face vertices, mm", FILMS, "still_mm", 0.1, worst=True),
    Bar("frames to recover", FILMS, "recovery_frames", 3.0, worst=True),
    Bar("covered frames have less confidence, AUC", FILMS, "confidence_auc", 0.9, at_least=True),
    # Errors are of the frames that have a fit: without a limit, leaving out the hard ones would lower them.
    Bar("frames with bare lips lost, %", ALL, "lost_pct", 1.0, worst=True),
    Bar("fitted frames with bare lips left out, %", ALL, "left_out_pct", 5.0),
    Bar("covered frames used, %", FILMS, "kept_pct", 10.0),
    Bar("time, ms a frame", FILMS, "ms", 100.0, worst=True),
)


def figure(row: Row, error: str) -> float:
    """An error of a row, or what follows from several."""
    errors = row.errors
    if error in OF_MOTION and errors["lip_motion_truth"] < STILL_MM:
        return np.nan
    if error == "turning_focal_pct":
        return abs(errors["focal_pct"]) if errors["turn_deg"] >= TURNS_DEG else np.nan
    if error == "surface_pct":
        return 100 * errors["surface_mm"] / errors["mean_surface_mm"]
    return errors.get(error, np.nan)


def last_stages(rows: list[Row]) -> list[Row]:
    """Of each clip the row of the last stage that it went through."""
    return list({row.clip: row for row in rows}.values())


def print_bars(rows: list[Row]) -> None:
    """One line a limit: wanted, reached, and whether, also by group; then what each further stage changes."""
    last = last_stages(rows)
    print(f"\n{'wanted, after the last stage, mean over clips (worst: *)':58s} {'limit':>8s} {'reached':>9s}")
    for bar in BARS:
        value = bar.reached(last)
        if np.isfinite(value):
            sign, name = ">=" if bar.at_least else "<=", bar.name + (" *" if bar.worst else "")
            print(
                f"{name:58s} {sign}{bar.limit:6.4g} {value:9.3f}  "
                f"{bar.answer(value) + ':':4s} {bar.by_group(last)}"
            )
    for error in PHOTOMETRIC:
        _print_gain(rows, error)


def _print_gain(rows: list[Row], error: str) -> None:
    """By how much the last stage lowers an error, and on which clips it raises it."""
    first = {row.clip: row for row in reversed(rows)}
    pairs = [(row, first[row.clip]) for row in last_stages(rows) if row.stage != first[row.clip].stage]
    pairs = [pair for pair in pairs if np.isfinite(figure(pair[0], error))]
    after, before = (np.array([figure(pair[k], error) for pair in pairs]) for k in (0, 1))
    if not len(pairs):
        return
    gain = 1 - after.mean() / before.mean()
    raised = [pair[0].clip for pair, a, b in zip(pairs, after, before) if a > (1 + RAISED) * b]
    print(
        f"{f'{error} lowered by {pairs[0][0].stage}, %':58s} >={100 * GAIN:6.4g} {100 * gain:9.1f}  "
        f"{'yes' if gain >= GAIN and not raised else 'no'}"
        f"{'; raised on ' + ', '.join(raised) if raised else ''}"
    )
