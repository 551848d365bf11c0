"""New speech for a checkpoint: its encoder hears the sound once, whatever is sampled from it."""

import io
import wave
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from model.errors import ModelError
from model.motion import Motion
from personalize import animation
from personalize.animation import animate_speech
from personalize.errors import UserError
from personalize.reporter import Reporter
from tests.model import talker
from tests.personalize.counting_encoder import CountingEncoder


@pytest.fixture
def encoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CountingEncoder:
    """In place of any other; films are left out, and nothing is cached yet."""
    encoder = CountingEncoder()
    monkeypatch.setattr(animation, "load_encoder", lambda source: encoder)
    monkeypatch.setattr(animation, "write_film", lambda *_: None)
    monkeypatch.setenv("PERSONALIZE_CACHE", str(tmp_path / "cache"))
    return encoder


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    sound = np.random.default_rng(0).integers(-9000, 9000, 16_000).astype("<i2")
    path = tmp_path / "speech.wav"
    with wave.open(str(path), "wb") as file:
        file.setparams((1, 2, 16_000, 0, "NONE", ""))
        file.writeframes(sound.tobytes())
    return path


@pytest.fixture
def subject(tmp_path: Path) -> Path:
    path = tmp_path / "checkpoint.safetensors"
    talker.shaken(talker.checkpoint([talker.sequence(90, 0)])).save(path)
    return path


def animate(speech: Path, subject: Path, out: Path, samples: int, encoder: str | None = None) -> list[Path]:
    report = Reporter(stream=io.StringIO())
    return list(animate_speech(speech, subject, out, samples, None, 0, encoder, report))


def test_sound_is_encoded_once_for_all_samples_and_steps_and_not_again(
    encoder: CountingEncoder, speech: Path, subject: Path, tmp_path: Path
) -> None:
    animate(speech, subject, tmp_path / "out", samples=3)
    assert encoder.calls == 1
    motions = [Motion.load(tmp_path / f"out/{index}/motion.npz") for index in range(3)]
    assert all(len(motion.valid) == 30 for motion in motions)
    assert [(m.provenance["sample"], m.provenance["samples"]) for m in motions] == [(0, 3), (1, 3), (2, 3)]
    animate(speech, subject, tmp_path / "again", samples=3)
    assert encoder.calls == 1, "the second time the features come from the cache"
    again = Motion.load(tmp_path / "again/1/motion.npz")
    assert again.coefficients.tobytes() == motions[1].coefficients.tobytes()


def test_a_checkpoint_of_another_encoder_says_which_and_how(
    encoder: CountingEncoder, speech: Path, subject: Path, tmp_path: Path
) -> None:
    encoder.name = "wav2vec2#layer=12@0123"
    with pytest.raises(UserError, match=r"needs the speech encoder 'test' .* with --encoder") as caught:
        animate(speech, subject, tmp_path / "out", samples=1)
    assert "wav2vec2#layer=12@0123" in str(caught.value) and "\n" not in str(caught.value)
    assert encoder.calls == 0 and not (tmp_path / "out").exists()


def test_an_encoder_that_fails_on_the_sound_is_the_users_to_mend(
    encoder: CountingEncoder, speech: Path, subject: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        encoder, "encode", Mock(side_effect=ModelError("its weights are damaged")), raising=False
    )
    with pytest.raises(UserError, match=r"speech\.wav: its weights are damaged"):
        animate(speech, subject, tmp_path / "out", samples=1)


def test_an_output_that_cannot_be_written_is_refused_before_anything_is_made(
    encoder: CountingEncoder, speech: Path, subject: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for out in (speech / "out", tmp_path / ("x" * 300)):
        with pytest.raises(UserError, match="cannot be written; choose another --out"):
            animate(speech, subject, out, samples=2)
    monkeypatch.setattr(animation.os, "access", lambda path, mode: path != tmp_path)
    with pytest.raises(UserError, match="cannot be written; choose another --out"):
        animate(speech, subject, tmp_path / "a/b", samples=1)
    assert encoder.calls == 0 and not (tmp_path / "a").exists()


def test_no_film_of_another_motion_stays_beside_a_new_one(
    encoder: CountingEncoder, speech: Path, subject: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    film = tmp_path / "out/animation.mp4"
    film.parent.mkdir()
    film.write_bytes(b"earlier")
    monkeypatch.setattr(animation, "write_film", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        animate(speech, subject, tmp_path / "out", samples=1)
    assert film.with_name("motion.npz").is_file() and not film.exists()
