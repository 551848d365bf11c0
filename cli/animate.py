"""`personalize animate speech.wav --subject RUN|CHECKPOINT`: new speech, the subject's own way of speaking."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from personalize.settings import LARGEST_SEED


def animate(
    speech: Annotated[Path, typer.Argument(help="Sound or video file with the speech, any voice.")],
    subject: Annotated[Path, typer.Option(help="Run folder, or a checkpoint.safetensors.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Output folder; SPEECH's name + .animation in the working folder if not given."),
    ] = None,
    samples: Annotated[int, typer.Option(min=1, max=100, help="How many different performances.")] = 1,
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
    encoder: Annotated[
        str | None,
        typer.Option(help="Folder or hub name of the speech encoder that the checkpoint was trained with."),
    ] = None,
) -> None:
    """Animate the subject's face with SPEECH: motion.npz and an mp4 with sound for each sample."""
    from personalize.animation import animate_speech
    from personalize.reporter import Reporter

    for path in animate_speech(speech, subject, out, samples, guidance, seed, encoder, Reporter()):
        typer.echo(path)
