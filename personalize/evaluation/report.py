"""report.html: self-contained, opens offline."""

from __future__ import annotations

import base64
import csv
import time
from pathlib import Path
from typing import Any

import cv2
from jinja2 import Environment, PackageLoader, StrictUndefined

from personalize.av_sync import SMALLEST_S
from personalize.evaluation import charts
from personalize.evaluation.evaluate import SYSTEMS, Evaluation
from personalize.files import write_text
from personalize.overlay import PREVIEW_S
from personalize.quality import LeftOut, cover_warnings, left_out, lip_warnings, read_reasons
from personalize.run import RunFolder, read_camera, read_refined, read_track, tool_version
from personalize.settings import Settings
from tracker.overlay import MODES

# Metric of metrics.json -> name and meaning in the table.
COLUMNS = {
    "lip_sync": "error of the lip opening after time warping, mm",
    "lip_max": "largest lip-vertex error of a frame, mm",
    "l2_lip": "mean lip-vertex error, mm",
    "l2_face": "mean face-vertex error, mm",
    "lip_gap_r": "correlation of the lip opening (higher is better)",
    "closure": "share of lip closures reached (higher is better)",
    "div_e": "difference between samples, mm (higher: more varied)",
}
LISTED = 12  # spans left out that the report tells of


def write_report(run: RunFolder, evaluation: Evaluation, settings: Settings, folder: Path) -> None:
    """Write `folder`/report.html from the run's files and the evaluation."""
    track = read_track(run.path / "refine/track.npz")
    guidance = run.read_json("finetune/guidance.json")
    media = run.read_json("ingest/media.json")
    environment = Environment(
        loader=PackageLoader("personalize.evaluation", "."), autoescape=True, undefined=StrictUndefined
    )
    metrics = evaluation.metrics
    duration = float(track.time[-1])
    reasons = read_reasons(run.path / "refine/quality.csv")
    used = reasons == "ok"
    gaps, cuts = _apart(left_out(track.time, reasons))
    page = environment.get_template("report.html").render(
        video=run.video.name,
        version=tool_version(),
        when=time.strftime("%Y-%m-%d %H:%M"),
        warnings=_warnings(run, media),
        cards=_cards(metrics["systems"], duration, float(used.mean())),
        overlay=_data_url(run.path / "overlay/preview.mp4", "video/mp4"),
        modes=[{"name": mode, "meaning": MODES[mode]} for mode in settings.overlay],
        overlay_cut=round(PREVIEW_S) if duration > PREVIEW_S else 0,
        timeline=charts.timeline(track.time, track.confidence, used),
        left_out=_longest(gaps),
        left_out_more=max(0, len(gaps) - LISTED),
        cuts=len(cuts),
        cuts_s=sum(cut.end_s - cut.start_s for cut in cuts),
        contact_sheet=_photograph_url(run.path / "overlay/contact_sheet.png"),
        clip=_data_url(folder / "samples/test.mp4", "video/mp4"),
        lip_opening=charts.lip_opening(evaluation.clip_time, evaluation.reference, evaluation.samples),
        guidance=metrics["guidance"],
        seconds=metrics["seconds"],
        columns=[{"name": name, "meaning": meaning} for name, meaning in COLUMNS.items()],
        rows=[
            {"name": name, "values": [f"{metrics['systems'][name][column]:.2f}" for column in COLUMNS]}
            for name in SYSTEMS
        ],
        guidance_curve=charts.guidance_curve(guidance["sweep"], guidance["chosen"]),
        loss=charts.loss_curve(*_loss(run.path / "finetune/log.csv")),
        facts=_facts(run, media, settings.tracked),
    )
    write_text(folder / "report.html", page)


def _cards(systems: dict[str, dict[str, float]], duration: float, tracked: float) -> list[dict[str, str]]:
    ours, base = systems["personalized"], systems["base"]
    return [
        {"value": f"{duration:.0f} s", "label": "of video"},
        {"value": f"{tracked:.0%}", "label": "of frames used"},
        {"value": f"{ours['lip_sync']:.2f} mm", "label": f"lip_sync (base {base['lip_sync']:.2f})"},
        {"value": f"{ours['l2_lip']:.2f} mm", "label": f"l2_lip (base {base['l2_lip']:.2f})"},
        {"value": f"{ours['lip_gap_r']:.2f}", "label": "correlation of lip opening"},
    ]


def _apart(gaps: list[LeftOut]) -> tuple[list[LeftOut], list[LeftOut]]:
    """The spans with a row of their own, and the cuts, mostly single frames, which would fill the table."""
    return [gap for gap in gaps if gap.reason != "cut"], [gap for gap in gaps if gap.reason == "cut"]


def _longest(gaps: list[LeftOut]) -> list[LeftOut]:
    """The LISTED longest, in order of time."""
    longest = sorted(gaps, key=lambda gap: gap.start_s - gap.end_s)[:LISTED]
    return sorted(longest, key=lambda gap: gap.start_s)


def _loss(path: Path) -> tuple[list[float], list[float]]:
    with path.open(newline="", encoding="utf-8") as stream:
        rows = [(float(row["step"]), float(row["loss"])) for row in csv.DictReader(stream)]
    return [step for step, _ in rows], [loss for _, loss in rows]


def _focal(run: RunFolder, tracked: str | None) -> str:
    if tracked is not None:
        return f"{read_track(run.path / 'refine/track.npz').focal:.0f} px (as {Path(tracked).resolve().name} has it)"
    camera, _ = read_camera(run.path / "camera")
    return f"{camera.focal_px:.0f} px ± {camera.focal_sd_log * 100:.0f} % ({camera.method}; {camera.prior})"


def _warnings(run: RunFolder, media: dict[str, Any]) -> list[str]:
    """What ails the whole clip."""
    lips = lip_warnings(read_refined(run.path / "photometric"))
    return [*media["warnings"], *lips, *cover_warnings(read_reasons(run.path / "refine/quality.csv"))]


def _facts(run: RunFolder, media: dict[str, Any], tracked: str | None) -> list[dict[str, str]]:
    registration = run.read_json("registration/registration.json")
    # What was tracked before another tracker's result was given is still in the folder, and of no account.
    unused = () if tracked is None else ("camera", "track")
    took = {name: entry["seconds"] for name, entry in run.stages.items() if name not in unused}
    facts = {
        "video": f"{media['width']}x{media['height']}, {media['fps']:.2f} frames/s, {media['video_codec']}",
        "focal length": _focal(run, tracked),
        "sound offset": _sound_offset(registration),
        "stages": ", ".join(f"{name} {seconds:.0f} s" for name, seconds in took.items()),
    }
    return [{"name": name, "value": value} for name, value in facts.items()]


def _sound_offset(registration: dict[str, Any]) -> str:
    """What was found of it, and what was done about it."""
    found_s = registration["av_offset_estimate_s"]
    if registration["av_offset_sure"]:
        done = "corrected"
    else:
        done = f"{'small' if 0 < abs(found_s) <= SMALLEST_S else 'not sure'}, left as it is"  # 0: nothing was found
    side = " late" if found_s > 0 else " early" if found_s < 0 else ""
    return f"{abs(found_s) * 1000:.0f} ms{side} ({done})"


def _data_url(path: Path, kind: str) -> str:
    return _encoded(path.read_bytes(), kind)


def _photograph_url(path: Path) -> str:
    """A picture as JPEG, a tenth of the PNG's size."""
    _, jpeg = cv2.imencode(".jpg", cv2.imread(str(path)))
    return _encoded(jpeg.tobytes(), "image/jpeg")


def _encoded(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
