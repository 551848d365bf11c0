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
from personalize.sound import read_audio, write_wav
from personalize.subject_data import BASE_CHECKPOINT, base_path, load_base, speech_features, tracked
from personalize.talkers.film import ASSETS
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
    faces = {"face_landmarker", "landmark_bias"}
    assert {stage.name for stage in STAGES if faces <= set(stage.assets(own))} == {"ingest", "landmarks"}
    copy = base.with_name("copy.safetensors")
    copy.write_bytes(base.read_bytes())
    same = Settings(base=str(copy), encoder="mine")
    assert all(stage.assets(same) == stage.assets(own) for stage in STAGES)


def test_sound_that_begins_late_is_silent_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a run, whose sound file has that silence in it."""
    speech, _ = read_audio(ASSETS / "demo_speech.flac")
    word = speech[8000:24_000]
    write_wav(tmp_path / "padded.wav", np.concatenate([np.zeros(16_000, np.float32), word]))
    padded, at = read_audio(tmp_path / "padded.wav")[0], np.arange(60) / 30
    wanted = speech_features(tmp_path / "padded.wav", at, load_encoder())
    monkeypatch.setattr(subject_data, "read_audio", lambda _: (padded[16_000:], 1.0))
    assert np.array_equal(speech_features(tmp_path / "late.mp4", at, load_encoder()), wanted)


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
