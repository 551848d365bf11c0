"""`personalize edit MOTION --audio … --keep 0:1.5,8.2: --keyframes 3.2,5.0`: make some of a motion anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from personalize.settings import LARGEST_SEED

TIMES = "Seconds, or percentages of the motion (10%): FROM:TO (ends may be left out) or single times, comma-separated."


def edit(
    motion: Annotated[
        Path, typer.Argument(help="motion.npz of a run (in registration/) or of an animation.")
    ],
    subject: Annotated[Path, typer.Option(help="Run folder, or a checkpoint.safetensors.")],
    audio: Annotated[
        Path | None,
        typer.Option(
            help="Sound or video file; its time 0 is the motion's. Without it: unconditional, no sound."
        ),
    ] = None,
    keep: Annotated[str, typer.Option(metavar="TIMES", help=f"Frames to keep. {TIMES}")] = "",
    keyframes: Annotated[
        str,
        typer.Option(metavar="TIMES", help="Frames that the result must pass through; times as for --keep."),
    ] = "",
    source: Annotated[
        Path | None, typer.Option("--from", help="Another motion.npz, from which the keyframes are taken.")
    ] = None,
    keep_regions: Annotated[
        str, typer.Option(metavar="NAMES", help="Parts of the face to keep, e.g. eyelids,forehead.")
    ] = "",
    remake: Annotated[
        str, typer.Option(metavar="NAMES", help="Parts of the face to make anew; all others are kept.")
    ] = "",
    blend_mm: Annotated[
        float, typer.Option(min=0, help="Width of the border around the named parts.")
    ] = 20.0,
    unconditional: Annotated[
        bool, typer.Option("--unconditional", help="Do not listen to the audio, only play it.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Output folder; MOTION's name + .edit in the working folder if not given."),
    ] = None,
    samples: Annotated[int, typer.Option(min=1, max=100, help="How many different edits.")] = 1,
    guidance: Annotated[
        float | None, typer.Option(min=0, max=2, help="Guidance scale; the checkpoint's own if not given.")
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            max=LARGEST_SEED,
            help="Seed; samples are drawn together, so another --samples changes all.",
        ),
    ] = 0,
    rule: Annotated[
        Literal["posterior", "renoise", "ddim"],
        typer.Option(help="Sampling rule of the diffusion, see docs/method.md."),
    ] = "posterior",
    encoder: Annotated[
        str | None,
        typer.Option(help="Folder or hub name of the speech encoder that the checkpoint was trained with."),
    ] = None,
) -> None:
    """Keep some of MOTION and make the rest anew: motion.npz and an mp4 with the sound for each sample."""
    from personalize.editing import EditSettings, edit_motion
    from personalize.reporter import Reporter

    settings = EditSettings(
        keep=keep,
        keyframes=keyframes,
        source=source,
        keep_regions=_names(keep_regions, "--keep-regions"),
        remake=_names(remake, "--remake"),
        blend_mm=blend_mm,
        unconditional=unconditional,
        samples=samples,
        guidance=guidance,
        seed=seed,
        rule=rule,
        encoder=encoder,
    )
    for path in edit_motion(motion, subject, audio, out, settings, Reporter()):
        typer.echo(path)


def _names(text: str, option: str) -> tuple[str, ...]:
    from personalize.errors import UserError

    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if text and not names:
        raise UserError(f"{option} {text!r}: names no part of the face; give names such as lips,eyelids")
    return names
