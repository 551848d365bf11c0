"""What a stage is, and how stages are run: keys by content, atomic folders, resume.

A stage's key is the hash of its version, the settings it reads, and the contents of its inputs and assets. Same key and
intact outputs: the stage is skipped. Anything else: it is made again in `.<folder>.partial/`, which becomes the stage's
folder by a rename. Files a stage makes for the top of the run folder (`checkpoint.safetensors`, `overlay.mp4`,
`report.html`) are written into the partial folder too and moved up at the same moment.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from personalize.errors import UserError
from personalize.files import sha256_file, sha256_json, write_text
from personalize.reporter import Reporter
from personalize.run import RunFolder
from personalize.settings import Settings

VIDEO = "video"


@dataclass(frozen=True)
class Context:
    """What a stage works with: the run folder's finished files, the settings, and where to report."""

    run: RunFolder
    settings: Settings
    report: Reporter


class Stage(ABC):
    """One step of the pipeline: typed inputs on disk -> outputs on disk.

    name: as the user says it. folder: in the run folder. version: bumped when the result changes.
    reads: names of the settings used.
    needs: files of the run folder used, relative to it; `video` is the video itself.
    makes: files made, relative to the stage's folder. products: files moved to the top of the run folder.
    resumes: the partial folder of an interrupted run with the same key is continued.
    """

    name: ClassVar[str]
    version: ClassVar[int]
    reads: ClassVar[tuple[str, ...]] = ()
    needs: ClassVar[tuple[str, ...]] = ()
    makes: ClassVar[tuple[str, ...]] = ()
    products: ClassVar[tuple[str, ...]] = ()
    resumes: ClassVar[bool] = False
    folder: ClassVar[str] = ""

    def __init_subclass__(cls) -> None:
        cls.folder = cls.__dict__.get("folder", cls.name)

    def assets(self, settings: Settings) -> dict[str, str]:
        """Name -> content hash of the package's or the user's assets this stage depends on."""
        return {}

    @abstractmethod
    def make(self, context: Context, folder: Path) -> None:
        """Write every file of `makes` and `products` into `folder`."""

    def warnings(self, run: RunFolder) -> Sequence[str]:
        """What the user should act on, of a result that is already there."""
        return ()

    def key(self, context: Context) -> str:
        """Content hash of all that decides this stage's result."""
        run = context.run
        inputs = {
            name: run.video_sha256 if name == VIDEO else sha256_file(run.path / name) for name in self.needs
        }
        settings = dataclasses.asdict(context.settings)
        return sha256_json(
            {
                "stage": self.name,
                "version": self.version,
                "settings": {name: settings[name] for name in self.reads},
                "inputs": inputs,
                "assets": self.assets(context.settings),
            }
        )


def output_paths(stage: Stage) -> list[str]:
    """All outputs of a stage, relative to the run folder."""
    return [f"{stage.folder}/{name}" for name in stage.makes] + list(stage.products)


def is_cached(stage: Stage, key: str, run: RunFolder) -> bool:
    """Whether the recorded entry has this key and every output still has the recorded content."""
    entry = run.stages.get(stage.name)
    if entry is None or entry["key"] != key or set(entry["outputs"]) != set(output_paths(stage)):
        return False
    return all(
        (run.path / name).is_file() and sha256_file(run.path / name) == digest
        for name, digest in entry["outputs"].items()
    )


def run_stage(stage: Stage, context: Context, *, force: bool = False) -> bool:
    """Bring one stage up to date. Returns True when it was made, False when it was cached."""
    run, report = context.run, context.report
    key = stage.key(context)
    if not force and is_cached(stage, key, run):
        report.cached(stage.name)
        for text in stage.warnings(run):
            report.warn(text)
        return False
    started = time.monotonic()
    with report.stage(stage.name):
        partial = _open_partial(stage, key, run.path, force)
        stage.make(context, partial)
        _publish(stage, partial, run.path)
    run.record(stage.name, _entry(stage, key, time.monotonic() - started, run.path))
    return True


def run_stages(
    stages: Sequence[Stage],
    context: Context,
    *,
    first: str | None = None,
    until: str | None = None,
    force: str | None = None,
) -> Sequence[Stage]:
    """Run stages in order. `first` remakes that stage and all after it, `force` that one; `until` stops after it.

    Returns those that are up to date now. Raises UserError for a stage name that does not exist, or that comes after
    `until`.
    """
    check_names(stages, first, until, force)
    names = [stage.name for stage in stages]
    from_index = names.index(first) if first else len(stages)
    wanted = stages[: names.index(until) + 1] if until else stages
    for index, stage in enumerate(wanted):
        run_stage(stage, context, force=index >= from_index or stage.name == force)
    return wanted


def check_names(stages: Sequence[Stage], first: str | None, until: str | None, force: str | None) -> None:
    """Raise UserError for the name of a stage that does not exist."""
    names = [stage.name for stage in stages]
    for option, value in (("--from", first), ("--until", until), ("--force", force)):
        if value is not None and value not in names:
            raise UserError(f"{option} {value}: no such stage; choose one of {', '.join(names)}")
    for option, value in (("--from", first), ("--force", force)):
        if value is not None and until is not None and names.index(value) > names.index(until):
            raise UserError(
                f"{option} {value}: this stage comes after --until {until}, and would not be made; leave one of "
                "the two out, or name a later --until"
            )


def _open_partial(stage: Stage, key: str, root: Path, force: bool) -> Path:
    """The folder to work in: empty, or what an interrupted run of the same key left.

    A forced run begins anew once: interrupted, it is continued, by the same command too.
    """
    partial = root / f".{stage.folder}.partial"
    key_file = partial / "key"
    begun = key_file.read_text() if key_file.is_file() else ""
    forced = f"{key} forced"
    if not (stage.resumes and begun in ([forced] if force else [key, forced])):
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        write_text(key_file, forced if force else key)
    return partial


def _publish(stage: Stage, partial: Path, root: Path) -> None:
    """Turn the partial folder into the finished one. A crash in between leaves hashes that do not match: remade."""
    (partial / "key").unlink()
    for name in stage.makes + stage.products:
        assert (partial / name).is_file(), f"stage {stage.name} did not make {name}"
    for name in stage.products:
        (partial / name).replace(root / name)
    finished, old = root / stage.folder, root / f".{stage.folder}.old"
    shutil.rmtree(old, ignore_errors=True)
    if finished.exists():
        finished.rename(old)
    partial.rename(finished)
    _sync_folder(root)
    shutil.rmtree(old, ignore_errors=True)


def _sync_folder(path: Path) -> None:
    """fsync of a folder, so that its renames survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _entry(stage: Stage, key: str, seconds: float, root: Path) -> dict[str, Any]:
    outputs = {name: sha256_file(root / name) for name in output_paths(stage)}
    return {"state": "done", "key": key, "seconds": round(seconds, 3), "outputs": outputs}
