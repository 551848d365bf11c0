"""The `personalize` command: finds the subcommand, turns errors into exit codes."""

from __future__ import annotations

import errno
import io
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable
from types import FrameType
from typing import Annotated

# Threads are set on purpose, per stage: left alone, OpenMP and BLAS both take every core and wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Training takes two threads. They must sleep while they wait: spinning costs 100 times the time on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# What takes long to import is imported by the command that needs it: help comes at once, and an interruption in those
# seconds finds `main` there to tell of it.
import typer

from cli.animate import animate
from cli.demo import demo
from cli.edit import edit
from cli.run import run
from cli.train import train
from personalize.errors import UserError

COMMANDS: dict[str, Callable[..., None]] = {
    "run": run,
    "animate": animate,
    "edit": edit,
    "train": train,
    "demo": demo,
}
BEGIN_ANEW = ("animate", "edit")  # after an interruption; the others continue
INPUT_ERROR, BUG, INTERRUPTED = 2, 1, 130
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # the disk, the user's share of it, the largest file
# A place that the user named and that cannot be read or written.
CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG)

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    help="Turn a talking-head video into a personal, editable 3D facial animation model.",
    epilog="""\b
Examples:
  personalize talk.mp4    (short for personalize run talk.mp4; its options: personalize run --help)
  personalize animate speech.wav --subject talk.personalize
  personalize edit speech.animation/motion.npz --audio speech.wav --keep :1.5,8.2: --subject talk.personalize
  personalize demo

A video whose name is a command's is given as ./name.""",
)
for name, command in COMMANDS.items():
    app.command(name)(command)


def _print_version(value: bool) -> None:
    if value:
        from personalize.run import tool_version

        typer.echo(f"personalize {tool_version()}")
        raise typer.Exit()


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options that stand before any command."""


def with_default_command(arguments: list[str]) -> list[str]:
    """`personalize VIDEO …` is `personalize run VIDEO …`."""
    if not arguments or arguments[0] in COMMANDS or arguments[0] in ("--help", "--version"):
        return arguments
    return ["run", *arguments]


def _interruptions() -> list[int]:
    """Filled when the user interrupts: a compiled module that is just imported may make another error of it."""
    told: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        told.append(number)
        signal.default_int_handler(number, frame)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
    return told


def main() -> None:
    """Entry point. Exit codes: 0 done, 2 the user's input, 130 interrupted, 1 a bug."""
    arguments = with_default_command(sys.argv[1:]) or ["--help"]
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names of files that are no text are printed as they are.
        sys.stdout.reconfigure(errors="surrogateescape")
    # That it finds no place for its fonts is nobody's concern.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    interruptions = _interruptions()
    try:
        code = app(arguments, standalone_mode=False)
    except UserError as error:
        code = INTERRUPTED if interruptions else INPUT_ERROR
        if code == INPUT_ERROR:
            typer.echo(f"personalize: {error}".replace("\n", " "), err=True)  # a file may be named so
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except Exception as error:
        if interruptions:
            code = INTERRUPTED
        elif isinstance(error, OSError) and error.errno in FULL:
            typer.echo(
                "personalize: no space is left to write the results; free some and run the same command again",
                err=True,
            )
            code = INPUT_ERROR
        elif isinstance(error, OSError) and error.errno in CLOSED and error.filename:
            typer.echo(
                f"personalize: {error.filename}: cannot be read or written ({error.strerror}); check its "
                "permissions and its name, or choose another --out",
                err=True,
            )
            code = INPUT_ERROR
        # Typer's own complaints about options carry an exit code; anything else is a bug of ours.
        elif hasattr(error, "format_message"):
            typer.echo(f"personalize: {error.format_message()} (see --help)", err=True)
            code = INPUT_ERROR
        else:
            traceback.print_exc()
            typer.echo(
                "personalize: this is a bug; please report it with the lines above and log.txt", err=True
            )
            code = BUG
    if code == INTERRUPTED:  # typer's own exit code for it, too
        outcome = ": it begins anew" if arguments[0] in BEGIN_ANEW else " to continue"
        typer.echo(f"personalize: interrupted; run the same command again{outcome}", err=True)
    sys.exit(code or 0)


if __name__ == "__main__":
    main()
