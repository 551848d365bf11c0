"""`personalize edit` on the base model: files, clocks, what is kept, and one line for each mistake."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from model.checkpoint import Checkpoint
from model.errors import ModelError
from model.motion import Motion
from model.speech import load_encoder
from model.synthesis import synthesize
from personalize import animation, editing
from personalize.editing import EditSettings, edit_motion
from personalize.errors import UserError
from personalize.files import sha256_file
from personalize.pictures import FrameReader
from personalize.reporter import Reporter
from personalize.sound import FILM_RATE, read_audio, write_wav
from personalize.subject_data import BASE_CHECKPOINT, speech_features
from personalize.talkers.film import ASSETS

FRAMES, START_S = 45, 0.5


@pytest.fixture(autouse=True)
def small_films(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(animation, "FILM_SIZE", (96, 96))


@pytest.fixture(scope="module")
def speech(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "speech.wav"
    sound, _ = read_audio(ASSETS / "demo_speech.flac")
    write_wav(path, sound[: 3 * 16000])
    return path


@pytest.fixture(scope="module")
def base() -> Checkpoint:
    return Checkpoint.load(BASE_CHECKPOINT)


def motion_of(base: Checkpoint, speech: Path, seed: int) -> Motion:
    """An earlier synthesis that starts at START_S."""
    features = speech_features(speech, START_S + np.arange(FRAMES) / 30, load_encoder())
    coefficients = synthesize(base, features, rule="ddim", steps=10, seed=seed)[0]
    everywhere = np.ones(FRAMES, bool)
    return Motion(30.0, START_S, base.template, base.faces, base.basis, coefficients, everywhere)


@pytest.fixture(scope="module")
def motion(base: Checkpoint, speech: Path) -> Path:
    motion_of(base, speech, 1).save(speech.with_name("motion.npz"))
    return speech.with_name("motion.npz")


def run(motion: Path, audio: Path | None, out: Path, **settings: object) -> list[Path]:
    chosen = EditSettings(rule="ddim", **settings)  # type: ignore[arg-type]
    return list(edit_motion(motion, BASE_CHECKPOINT, audio, out, chosen, Reporter()))


def test_frames_and_regions_are_kept_and_films_have_sound(
    base: Checkpoint, motion: Path, speech: Path, tmp_path: Path
) -> None:
    kept = {"keep": ":0.7,1.8:", "keep_regions": ("eyelids",)}
    paths = run(motion, speech, tmp_path / "out", samples=2, seed=3, **kept)
    names = [path.relative_to(tmp_path / "out").as_posix() for path in paths]
    assert names == ["0/motion.npz", "0/animation.mp4", "1/motion.npz", "1/animation.mp4"]
    truth = Motion.load(motion).displacements()
    made = [Motion.load(path) for path in paths[::2]]
    for edited in made:
        found = edited.displacements()
        np.testing.assert_allclose(found[:6], truth[:6], atol=1e-6)
        np.testing.assert_allclose(found[39:], truth[39:], atol=1e-6)
        lids, lips = base.regions["eyelids"], base.regions["lips"]
        np.testing.assert_allclose(found[:, lids], truth[:, lids], atol=1e-6)
        assert np.abs(found - truth)[6:39, lips].max() > 1e-4
        assert edited.start_s == START_S and edited.topology == base.topology
    assert not np.allclose(made[0].displacements()[20], made[1].displacements()[20], atol=1e-4)
    facts = made[1].provenance
    assert facts["synthetic"] and facts["source"] == "speech.wav"
    assert (facts["sample"], facts["samples"]) == (1, 2)
    assert facts["edit"]["keep"] == ":0.7,1.8:" and facts["edit"]["kept_frames"] == 12
    assert facts["edit"]["keep_regions"] == ["eyelids"] and facts["guidance"] == base.guidance
    assert sum(1 for _ in FrameReader(paths[1])) == FRAMES
    # The film begins with the motion, half a second into the sound.
    film, film_start = read_audio(paths[1], 16000)
    sound, _ = read_audio(speech, 16000)
    place = round((START_S + film_start) * 16000)
    assert np.corrcoef(film[4000:20000], sound[place + 4000 : place + 20000])[0, 1] > 0.9


def test_without_audio_the_edit_is_unconditional_and_silent(
    motion: Path, speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And needs no speech encoder."""
    monkeypatch.setattr(animation, "load_encoder", Mock(side_effect=ModelError("no such encoder")))
    silent = run(motion, None, tmp_path / "silent", keep=":10%,90%:")
    played = run(motion, speech, tmp_path / "played", keep=":10%,90%:", unconditional=True)
    a, b = (Motion.load(paths[0]) for paths in (silent, played))
    assert np.array_equal(a.coefficients, b.coefficients)
    assert a.provenance["guidance"] == b.provenance["guidance"] == 0.0
    assert len(read_audio(silent[1])[0]) == 0 and len(read_audio(played[1])[0]) > 0


def test_keyframes_of_another_motion_lie_on_its_own_clock(
    base: Checkpoint, motion: Path, speech: Path, tmp_path: Path
) -> None:
    other = dataclasses.replace(motion_of(base, speech, 2), start_s=START_S - 0.2)
    other.save(tmp_path / "other.npz")
    path = run(motion, speech, tmp_path / "out", keyframes="0.9,1.2:1.3", source=tmp_path / "other.npz")[0]
    found, theirs = Motion.load(path).displacements(), other.displacements()
    rows = np.array([12, 21, 22, 23])
    np.testing.assert_allclose(found[rows], theirs[rows + 6], atol=1e-6)


def test_the_sound_of_a_run_lies_where_registration_put_it(
    motion: Path, speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run's measured delay moves the features, in an edit of the edit too, but not those of another's sound."""
    own = {"synthetic": False, "av_offset_s": 0.08, "av_offset_of": ["the video's", sha256_file(speech)]}
    dataclasses.replace(Motion.load(motion), provenance=own).save(tmp_path / "motion.npz")
    other = tmp_path / "other.wav"
    write_wav(other, read_audio(speech)[0][::-1])
    heard = []
    monkeypatch.setattr(
        editing,
        "speech_features",
        lambda path, at, encoder: heard.append(at) or speech_features(path, at, encoder),
    )
    once = run(tmp_path / "motion.npz", speech, tmp_path / "once", keep=":0.7")[0]
    silent = run(once, None, tmp_path / "silent", keep=":0.7")[0]
    run(silent, speech, tmp_path / "twice", keep=":0.7")
    replaced = run(tmp_path / "motion.npz", other, tmp_path / "other", keep=":0.7")[0]
    run(motion, speech, tmp_path / "plain", keep=":0.7")
    assert [round(at[0], 4) for at in heard] == [0.58, 0.58, 0.5, 0.5]
    run(replaced, speech, tmp_path / "back", keep=":0.7")
    assert round(heard[-1][0], 4) == 0.58


def test_mistakes_get_one_line_and_write_nothing(
    base: Checkpoint, motion: Path, speech: Path, tmp_path: Path
) -> None:
    short, silent, click = (tmp_path / f"{name}.wav" for name in ("short", "silent", "click"))
    write_wav(click, np.ones(100, np.float32), FILM_RATE)
    write_wav(short, read_audio(speech)[0][:16000])
    write_wav(silent, np.zeros(48000, np.float32))
    read = Motion.load(motion)
    gap = read.valid.copy()
    gap[10:20] = False
    for name, changed in {
        "mesh": dataclasses.replace(read, faces=read.faces[1:]),
        "gap": dataclasses.replace(read, valid=gap),
        "slow": dataclasses.replace(read, fps=25.0),
        "early": dataclasses.replace(read, start_s=0.0),
        "endless": dataclasses.replace(read, fps=1e-6, start_s=-1e8),
    }.items():
        changed.save(tmp_path / f"{name}.npz")
    before = sorted(tmp_path.iterdir())

    def refused(says: str, path: Path = motion, audio: Path | None = speech, **settings: object) -> None:
        with pytest.raises(UserError, match=says) as caught:
            run(path, audio, tmp_path / "out", **settings)
        assert "\n" not in str(caught.value)

    refused("--keep: 9 is outside the motion", keep="9:")
    refused("--keyframes: 0.1 is outside", keyframes="0.1")
    refused("'nose' is not a region", keep_regions=("nose",))
    refused("one of them", keep_regions=("lips",), remake=("eyes",))
    refused(r"short.wav: its sound ends at 1.00 s, the motion at 1.97 s", audio=short)
    refused("silent.wav: there is no sound", audio=silent)
    refused("click.wav: only 2 ms of sound", audio=click)
    refused("mesh topology", path=tmp_path / "mesh.npz")
    refused("25 frames a second", path=tmp_path / "slow.npz")
    refused("1e-06 frames a second", path=tmp_path / "endless.npz")
    refused("--blend-mm inf", keep_regions=("lips",), blend_mm=np.inf)
    refused("same mesh", keyframes="0.9", source=tmp_path / "mesh.npz")
    refused("no face was seen at 0.90 s", path=tmp_path / "gap.npz", keyframes="0.9")
    refused("1.93 s is outside .*early.npz", keyframes="1.93", source=tmp_path / "early.npz")
    refused("with --keyframes", source=tmp_path / "early.npz")
    refused("there is no file", path=tmp_path / "none.npz")
    refused("not a readable motion file", path=speech)
    refused("--guidance", audio=None, guidance=0.5)
    assert sorted(tmp_path.iterdir()) == before


def test_nothing_that_is_read_is_written_over(
    motion: Path, speech: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(editing, "edit", lambda *_, **__: pytest.fail("it was refused too late"))
    earlier = tmp_path / "out/1/motion.npz"
    earlier.parent.mkdir(parents=True)
    earlier.write_bytes(motion.read_bytes())
    film = earlier.with_name("animation.mp4")
    film.write_bytes(speech.read_bytes())
    for read in (
        {"motion": earlier, "audio": speech},
        {"motion": motion, "audio": speech, "keyframes": "0.9", "source": earlier},
        {"motion": motion, "audio": film},
    ):
        with pytest.raises(
            UserError, match=r"out/1: holds the .* that this command reads; choose another --out"
        ):
            run(out=tmp_path / "out", samples=2, **read)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"holds the motion\.npz that this command reads"):
        run(earlier, speech, earlier.parent)
    with pytest.raises(UserError, match="cannot be written; choose another --out"):
        run(motion, speech, speech / "out")
