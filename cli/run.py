"""`personalize VIDEO`: from a video to a subject's checkpoint, an overlay to check, and a report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from personalize.settings import LARGEST_SEED, Settings

MOST_DISTORTION = 10.0  # that a lens has; also no infinity


def run(
    video: Annotated[Path, typer.Argument(help="Video of one person talking: anything FFmpeg reads.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Run folder; VIDEO's name + .personalize in the working folder if not given."),
    ] = None,
    iterations: Annotated[int, typer.Option(min=1, help="Fine-tuning steps.")] = Settings.iterations,
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of every random draw.")
    ] = Settings.seed,
    focal: Annotated[float | None, typer.Option(help="Focal length in pixels (not mm), if known.")] = None,
    distortion: Annotated[
        str | None,
        typer.Option(
            metavar="K1[,K2[,K3]]",
            help="The lens's radial distortion by OpenCV's model, if known; with --focal.",
        ),
    ] = None,
    base: Annotated[
        Path | None, typer.Option(help="Checkpoint to fine-tune; the embedded base model if not given.")
    ] = None,
    encoder: Annotated[
        str | None,
        typer.Option(help="Folder or hub name of the speech encoder that --base was trained with."),
    ] = None,
    device: Annotated[str, typer.Option(help="What fine-tuning runs on: cpu or cuda.")] = Settings.device,
    head: Annotated[
        Path | None, typer.Option(help="FLAME pickle to track with; the embedded head if not given.")
    ] = None,
    head_embedding: Annotated[
        Path | None, typer.Option(help="Landmark embedding of --head; the one beside it if not given.")
    ] = None,
    tracked: Annotated[
        Path | None,
        typer.Option(
            help="Result folder of metrical-tracker or VHAP to use instead of tracking; with --head."
        ),
    ] = None,
    overlay: Annotated[
        str,
        typer.Option(
            metavar="MODE[,MODE...]",
            help="What the overlay film shows beside the video: shaded, wireframe, albedo, error, landmarks.",
        ),
    ] = ",".join(Settings.overlay),
    min_confidence: Annotated[
        float, typer.Option(min=0, max=1, help="Leave frames out that are tracked with less confidence.")
    ] = Settings.min_confidence,
    until: Annotated[
        str | None,
        typer.Option(
            metavar="STAGE",
            help="Stop after this stage: ingest, landmarks, camera, track, refine, judge, overlay, registration, "
            "finetune, evaluate.",
        ),
    ] = None,
    from_: Annotated[
        str | None,
        typer.Option("--from", metavar="STAGE", help="Make this stage and all after it again."),
    ] = None,
    force: Annotated[
        str | None,
        typer.Option(
            metavar="STAGE", help="Make this stage again, and what follows only if it came out otherwise."
        ),
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Track the face in VIDEO, fine-tune the model on it, and report. Run it again to continue or to change."""
    from personalize.pipeline import personalize_video

    settings = Settings(
        iterations=iterations,
        seed=seed,
        focal_px=focal,
        distortion=coefficients(distortion, focal),
        device=device,
        base=_text(base),
        encoder=encoder,
        head=_text(head),
        head_embedding=_text(head_embedding),
        tracked=_text(tracked),
        overlay=tuple(overlay.split(",")),
        min_confidence=min_confidence,
    )
    result = personalize_video(video, out, settings, first=from_, until=until, force=force)
    if json_:
        typer.echo(json.dumps({name: str(path) for name, path in result.items()}))
    else:
        for name, path in result.items():
            typer.echo(f"{name:<11} {path}")


def coefficients(distortion: str | None, focal: float | None) -> tuple[float, ...]:
    """What --distortion says. Raises UserError where that are no one to three numbers, or they come without --focal."""
    from personalize.errors import UserError

    if distortion is None:
        return ()
    try:
        numbers = tuple(float(number) for number in distortion.split(","))
    except ValueError:
        numbers = ()
    if not 1 <= len(numbers) <= 3 or not all(abs(number) < MOST_DISTORTION for number in numbers):
        raise UserError(f"--distortion {distortion}: give one to three small numbers, as in -0.21,0.05")
    if focal is None:
        raise UserError("--distortion needs --focal: both come from one calibration")
    return numbers


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)
