"""`personalize train`: a base model from data the user owns, and the paper's tables for it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from personalize.settings import LARGEST_SEED

TABLE_WIDTH = 125
FIGURES = {
    "div_e": "Div^E",
    "lip_sync": "Lip-Sync",
    "lip_max": "Lip-max",
    "l2_lip_paper": "L2 lip",
    "l2_face": "L2 face",
}


def train(
    out: Annotated[
        Path, typer.Option(help="The base model to write; OUT.work/ beside it is for continuing.")
    ],
    vocaset: Annotated[Path | None, typer.Option(help="Folder of VOCAset, in either of its layouts.")] = None,
    template_mesh: Annotated[
        Path | None, typer.Option(help="A .ply or .obj of VOCAset's topology, e.g. FLAME_sample.ply.")
    ] = None,
    motions: Annotated[
        Path | None, typer.Option(help="Instead: folder of tracked motions, NAME.npz with NAME.wav.")
    ] = None,
    iterations: Annotated[int, typer.Option(min=1, help="Training steps of the base model.")] = 140_000,
    adapt: Annotated[
        list[str] | None,
        typer.Option(metavar="SUBJECT", help="Test subject to adapt to (may repeat); both if not given."),
    ] = None,
    encoder: Annotated[
        str | None, typer.Option(help="Speech encoder: folder or hub name; the embedded one if not given.")
    ] = None,
    architecture: Annotated[
        Literal["conv", "attention", "transformer"],
        typer.Option(help="The paper's network, or one of the two that it is compared with."),
    ] = "conv",
    device: Annotated[
        str, typer.Option(help="cpu or cuda; `torchrun -m cli.main train …` trains on several.")
    ] = "cpu",
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of every random draw.")] = 0,
    json_: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Train a base model; on VOCAset by the paper's protocol, with its Tables 1, 3b and 3c. Run again to continue."""
    from personalize.errors import UserError

    if (vocaset is None) == (motions is None):
        raise UserError("train needs data: give either --vocaset DIR or --motions DIR")
    if vocaset is not None and template_mesh is None:
        raise UserError(
            "VOCAset holds no faces: give a mesh of its topology with --template-mesh FLAME_sample.ply"
        )
    if motions is not None and (template_mesh is not None or adapt):
        raise UserError("--template-mesh and --adapt go with --vocaset; leave them out")

    from personalize.reporter import Reporter
    from personalize.training import TrainSettings, train_on_motions, train_on_vocaset

    settings = TrainSettings(iterations, seed, encoder, architecture, device)

    if vocaset is not None and template_mesh is not None:
        result = train_on_vocaset(vocaset, template_mesh, out, adapt or [], settings, Reporter())
    elif motions is not None:
        result = train_on_motions(motions, out, settings, Reporter())
    if os.environ.get("RANK", "0") != "0":
        return  # of several processes the first speaks
    if json_:
        typer.echo(json.dumps(result))
    else:
        _print(result)


def _print(result: dict[str, Any]) -> None:
    """The checkpoint, what its basis holds, and the tables, with the paper's figures in brackets."""
    typer.echo(
        f"{result['checkpoint']}\n{result['modes']} modes hold {result['held']:.3%} of the squared displacement"
    )
    if not result.get("systems"):
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(title="mm; in brackets the paper's; - where adaptation diverged")
    for title in ("table", "system", "adapted on", *FIGURES.values()):
        table.add_column(title, no_wrap=True, justify="right" if title in FIGURES.values() else "left")
    for row in result["systems"]:
        cells = [
            f"{'-' if row[name] is None else format(row[name], '.2f')} ({paper:.2f})"
            for name, paper in zip(FIGURES, row["paper"])
        ]
        table.add_row(row["table"], row["system"], f"{row['seconds']:.0f} s", *cells)
    Console(width=TABLE_WIDTH).print(table)
