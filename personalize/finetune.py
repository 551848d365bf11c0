"""Fine-tuning stage: the base model learns one person's motion; checkpoint and guidance are chosen on validation."""

from __future__ import annotations

import shutil
from pathlib import Path

from model.finetuning import EARLY_TOLERANCE, choose_checkpoint, subject_of, sweep_guidance
from model.speech import load_encoder
from model.trainer import STATE_FILE, Trainer, TrainingDivergedError
from model.training_config import TrainingConfig
from personalize.errors import UserError
from personalize.files import sha256_file, write_json
from personalize.reporter import Reporter
from personalize.run import RunFolder, tool_version
from personalize.settings import Settings
from personalize.subject_data import base_path, load_base, load_subject_data

PARTS = {"train": "training", "val": "validation", "test": "test"}


def finetune_run(run: RunFolder, settings: Settings, folder: Path, report: Reporter) -> None:
    """Write checkpoint.safetensors, log.csv, guidance.json and tensorboard/ into `folder`, continuing what is there.

    Raises UserError when the clip holds too little speech with a tracked face in one of the parts of its split.
    """
    base = load_base(settings)
    data = load_subject_data(run, style=len(base.styles), encoder=load_encoder(settings.encoder))
    for part in PARTS:
        if not data.parts[part]:
            raise UserError(
                f"{run.video}: nowhere in the {PARTS[part]} part of the clip (times: ingest/split.json) is the face in "
                "use for a whole second; look at overlay.mp4 for why, and film a longer clip"
            )
    provenance = {
        "tool": "personalize",
        "version": tool_version(),
        "base": sha256_file(base_path(settings)),
        "video": run.video_sha256,
        "iterations": settings.iterations,
        "seed": settings.seed,
    }
    subject = subject_of(base, run.video.stem, data.sequences("train"), provenance)
    subject = subject.with_weights(subject.network, subject.ema, template=data.motion.template)
    work = folder / "steps"
    trainer = Trainer(
        subject,
        data.sequences("train"),
        work,
        TrainingConfig(iterations=settings.iterations, seed=settings.seed, device=settings.device),
        tensorboard=folder / "tensorboard",
    )
    try:
        candidates = trainer.train(report.progress)
    except TrainingDivergedError as error:
        raise UserError(
            f"{run.video}: {error}; look at overlay.mp4 for frames tracked wrongly, which a higher --min-confidence "
            "leaves out, or film a longer clip"
        ) from error
    report.say("choosing the checkpoint and the guidance scale on the validation split")
    best, errors = choose_checkpoint(candidates, data.sequences("val"), settings.seed, EARLY_TOLERANCE)
    sweep, chosen = sweep_guidance(best, data.sequences("val"), settings.seed, report.progress)
    best.with_weights(best.network, best.ema, guidance=chosen).save(folder / "checkpoint.safetensors")
    choice = {"lip_error_mm": dict(zip([path.stem for path in candidates], errors))}
    write_json(folder / "guidance.json", {"sweep": sweep, "chosen": chosen, "candidates": choice})
    shutil.copy(work / "log.csv", folder / "log.csv")
    _remove(work)


def _remove(work: Path) -> None:
    """A training's folder, its state first: what is left of it by a kill then begins anew.

    A finished state without its candidates would neither train nor have anything to choose from, at every start.
    """
    (work / STATE_FILE).unlink()
    shutil.rmtree(work)
