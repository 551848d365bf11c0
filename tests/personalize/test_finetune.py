"""Fine-tuning's folder of steps: whenever it is killed, the next run goes on."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from model.trainer import STATE_FILE, Trainer, TrainingDivergedError
from model.training_config import TrainingConfig
from personalize import finetune
from personalize.errors import UserError
from personalize.settings import Settings
from tests.model import talker


class Killed(Exception):  # noqa: N818
    """Stands for a kill."""


def test_killed_while_its_steps_are_removed_it_trains_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TrainingConfig(iterations=2, batch=2, frames=12, candidates=1, threads=1, precision="float32")
    sequences = [talker.sequence(60, 0)]
    checkpoint = talker.checkpoint(sequences)
    candidates = Trainer(checkpoint, sequences, tmp_path, config).train()

    def dying(work: Path) -> None:
        """Removes all that shutil.rmtree may have met before the state, and no more."""
        for path in work.iterdir():
            if path.name != STATE_FILE:
                path.unlink()
        raise Killed

    monkeypatch.setattr(finetune.shutil, "rmtree", dying)
    with pytest.raises(Killed):
        finetune._remove(tmp_path)
    assert not candidates[0].exists()
    assert Trainer(checkpoint, sequences, tmp_path, config).train() == candidates


def test_a_training_that_diverges_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sequences = [talker.sequence(60, 0)]
    base = talker.checkpoint(sequences)
    motion = Mock(template=base.template)
    data = Mock(parts={part: [1] for part in finetune.PARTS}, sequences=lambda part: sequences, motion=motion)
    for name, value in (("load_base", base), ("load_subject_data", data), ("load_encoder", None)):
        monkeypatch.setattr(finetune, name, lambda *_, value=value, **__: value)
    monkeypatch.setattr(Trainer, "train", Mock(side_effect=TrainingDivergedError("training diverged")))
    run = Mock(video=Path("talk.mp4"), video_sha256="")
    with pytest.raises(
        UserError, match=r"talk\.mp4: training diverged; look at overlay\.mp4 .* --min-confidence"
    ):
        finetune.finetune_run(run, Settings(), tmp_path, Mock())
