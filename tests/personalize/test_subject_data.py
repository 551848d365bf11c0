"""Base model and speech encoder of a run: one belongs to the other, and the stages depend on both by content."""

from pathlib import Path

import numpy as np
import pytest

from model.errors import ModelError
from model.motion import Motion
from model.speech import load_encoder
from personalize import stages, subject_data
from personalize.pipeline import STAGES
from personalize.settings import Settings
from personalize.subject_data import BASE_CHECKPOINT, base_path, load_base, tracked
from tests.model import talker
from tests.personalize.counting_encoder import CountingEncoder


@pytest.fixture
def base(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A base model of the encoder that stands in for folder `mine`."""
    for module in (stages, subject_data):
        monkeypatch.setattr(
            module, "load_encoder", lambda source: CountingEncoder() if source else load_encoder()
        )
    path = tmp_path / "base.safetensors"
    talker.checkpoint([talker.sequence(90, 0)]).save(path)
    return path


def test_the_embedded_base_belongs_to_the_embedded_encoder() -> None:
    assert base_path(Settings()) == BASE_CHECKPOINT
    assert load_base(Settings()).kind == "base"


def test_base_and_encoder_must_belong_together(base: Path) -> None:
    assert load_base(Settings(base=str(base), encoder="mine")).encoder == "test"
    with pytest.raises(ModelError, match="needs the speech encoder 'test'"):
        load_base(Settings(base=str(base)))
    with pytest.raises(ModelError, match="needs the speech encoder 'whisper-tiny"):
        load_base(Settings(encoder="mine"))
    with pytest.raises(ModelError, match="there is no file"):
        load_base(Settings(base="nowhere.safetensors"))


def test_the_stages_that_use_them_depend_on_their_content(base: Path) -> None:
    embedded, own = Settings(), Settings(base=str(base), encoder="mine")
    changed = {stage.name for stage in STAGES if stage.assets(embedded) != stage.assets(own)}
    assert changed == {"registration", "finetune", "evaluate"}
    copy = base.with_name("copy.safetensors")
    copy.write_bytes(base.read_bytes())
    same = Settings(base=str(copy), encoder="mine")
    assert all(stage.assets(same) == stage.assets(own) for stage in STAGES)


def test_a_span_is_cut_where_nothing_was_tracked_for_long() -> None:
    flat = np.zeros((200, 3), np.float32)
    face = np.zeros((4, 3), np.float32)
    triangle, basis = np.array([[0, 1, 2]], np.int32), np.zeros((3, 4, 3), np.float32)
    motion = Motion(30.0, 0.0, face, triangle, basis, flat, np.ones(200, bool))
    motion.valid[[0, 1, 50]] = False  # a frame alone is no gap
    motion.valid[100:130] = False
    motion.valid[150:180] = False  # what stands between this and the last is no word
    assert tracked(motion, 0, 200) == [(2, 100)]
    assert tracked(motion, 60, 95) == [(60, 95)]
    motion.valid[:] = False
    assert tracked(motion, 0, 200) == []
