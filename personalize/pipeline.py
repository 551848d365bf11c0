"""The ordered list of stages: reading it is understanding the product."""

from __future__ import annotations

from pathlib import Path

from model.errors import ModelError
from model.training_config import available_device
from personalize.container import probe
from personalize.errors import UserError
from personalize.heads import run_head
from personalize.overlay import check_modes
from personalize.reporter import Reporter
from personalize.run import RunFolder
from personalize.settings import Settings, check_distortion, check_focal
from personalize.stage import Context, Stage, check_names, run_stages
from personalize.stages import (
    CameraStage,
    Evaluate,
    Finetune,
    Ingest,
    Judge,
    LandmarkStage,
    Overlay,
    ReadTracked,
    Refine,
    Registration,
    TrackStage,
)
from personalize.subject_data import load_base
from personalize.tracked_files import read_tracked
from tracker.track import TrackError

STAGES: tuple[Stage, ...] = (
    Ingest(),  # video -> times, usable frames, sound, split
    LandmarkStage(),  # 478 points and 52 scores a frame
    CameraStage(),  # focal length and rigid head poses
    TrackStage(),  # identity, expression, pose: jointly over the clip
    Refine(),  # photometric refinement
    Judge(),  # confidence, and which frames are used
    Overlay(),  # overlay.mp4, to check by eye
    Registration(),  # Track -> Motion at 30 fps
    Finetune(),  # Motion + speech -> checkpoint.safetensors
    Evaluate(),  # metrics, a clip beside the reference, report.html
)
# With another tracker's result in the place of ours.
TRACKED_STAGES: tuple[Stage, ...] = (STAGES[0], STAGES[1], ReadTracked(), *STAGES[5:])
PRODUCTS = ("checkpoint.safetensors", "overlay.mp4", "report.html")


def personalize_video(
    video: Path,
    out: Path | None,
    settings: Settings,
    *,
    first: str | None = None,
    until: str | None = None,
    force: str | None = None,
    report: Reporter | None = None,
) -> dict[str, Path]:
    """Bring the run folder of `video` up to date; returns the products that are, by name.

    out: the run folder, by default the video's name + `.personalize` in the working folder.
    Raises UserError for whatever the user can mend.
    """
    stages = STAGES if settings.tracked is None else TRACKED_STAGES
    check_names(stages, first, until, force)
    media = probe(video)
    check_focal(settings.focal_px, (media.width, media.height))
    check_distortion(settings.focal_px, settings.distortion, (media.width, media.height))
    check_modes(settings.overlay)
    if settings.tracked is not None and settings.focal_px is not None:
        raise UserError("--focal, --distortion: the result given with --tracked has its own; leave them out")
    try:
        # Asked now, not after the tracking.
        available_device(settings.device)
        load_base(settings)
        head = run_head(settings)
        if settings.tracked is not None:
            read_tracked(Path(settings.tracked), head)
    except ModelError as error:
        raise UserError(str(error)) from error
    folder = out or Path(f"{video.stem}.personalize")
    report = report or Reporter()
    # Asked before the lock so that a folder which is not ours is left as it is, and again once nobody else writes.
    run = RunFolder.create(folder, video)
    with run.locked():
        run = run.reread()
        report.log_to(folder / "log.txt")
        run.begin(settings)
        try:
            done = run_stages(stages, Context(run, settings, report), first=first, until=until, force=force)
        except (TrackError, ModelError) as error:
            raise UserError(f"{video}: {error}") from error
    made = {name for stage in done for name in stage.products}
    return {"run": folder} | {Path(name).stem: folder / name for name in PRODUCTS if name in made}
