"""`personalize demo`: a rendered talking head with known truth through the whole pipeline, and the true errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from personalize.settings import LARGEST_SEED


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the demo.")] = Path("demo"),
    iterations: Annotated[int, typer.Option(min=1, help="Fine-tuning steps; 30000 is the full job.")] = 4000,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of every random draw.")] = 0,
    json_: Annotated[bool, typer.Option("--json", help="Print the errors as JSON.")] = False,
) -> None:
    """Render a talking head, personalize it, and print the tracker's true errors in millimetres."""
    from personalize.demo import ERROR_MEANINGS, run_demo

    errors = run_demo(out, iterations, seed)
    if json_:
        typer.echo(json.dumps(errors))
        return
    for name, value in errors.items():
        typer.echo(f"{name:<24} {value:8.3f}  {ERROR_MEANINGS[name]}")
