"""`personalize train` on small generated data: the whole protocol, its table, and going on after an interruption."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from cli.train import _print, train
from model.checkpoint import Checkpoint
from model.dataset import Sequence
from model.metrics import score
from model.motion import Motion
from model.motion_basis import motion_basis
from model.speech import load_encoder
from model.synthesis import synthesize
from model.trainer import TrainingDivergedError
from model.training_config import TrainingConfig
from personalize import protocol
from personalize.corpus import Corpus
from personalize.errors import UserError
from personalize.files import sha256_file
from personalize.mouth import mouth_regions
from personalize.protocol import METRICS, SYSTEMS, Reference, first_seconds, with_noise
from personalize.reporter import Reporter
from personalize.sound import read_audio, write_wav
from personalize.training import _motion_sequence, read_faces
from personalize.vocaset import TEST, TRAIN, VAL
from tests.model import talker
from tests.personalize.vocaset_factory import FLAME, FakeVocaset

SENTENCES = {TRAIN[0]: [1, 21], TRAIN[1]: [2, 22], VAL[0]: [21], TEST[0]: [1, 2, 3, 4, 5, 19, 21]}


@pytest.fixture(scope="module")
def fake() -> FakeVocaset:
    return FakeVocaset(SENTENCES)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two samples in twenty steps, not ten in five hundred."""
    monkeypatch.setattr(protocol, "SAMPLES", 2)
    monkeypatch.setattr(protocol, "synthesize", partial(synthesize, rule="ddim", steps=20))


def test_the_whole_protocol_on_both_layouts(
    fake: FakeVocaset, tmp_path: Path, quick: None, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = fake.write_mesh(tmp_path / "sample.ply")
    options: dict[str, Any] = {"template_mesh": mesh, "iterations": 2}
    fake.write_training_files(tmp_path / "a")
    train(tmp_path / "a.safetensors", tmp_path / "a", **options, json_=True)
    result = json.loads(capsys.readouterr().out)
    assert [row["system"] for row in result["systems"]] == [system.name for system in SYSTEMS]
    rows = {row["system"]: row for row in result["systems"]}
    assert all(np.isfinite([row[name] for name in METRICS]).all() for row in rows.values())
    assert rows["no style, s = 1"]["seconds"] == 0 and rows["adapted on 5 s"]["seconds"] == 5
    assert rows["personalized"]["seconds"] == pytest.approx(6, abs=0.2)
    assert [rows["personalized"][name] for name in METRICS] == [
        rows["adapted on 100 s"][name] for name in METRICS
    ]
    assert rows["noise at -12 dB"]["l2_face"] != rows["personalized"]["l2_face"]
    base = Checkpoint.load(tmp_path / "a.safetensors")
    assert base.styles == TRAIN[:2] and base.kind == "base" and 0.9 < result["held"] <= 1
    adapted = Checkpoint.load(
        next((tmp_path / "a.safetensors.work" / TEST[0]).glob("*_frames")) / "checkpoint.safetensors"
    )
    assert adapted.styles == (*TRAIN[:2], TEST[0])
    assert np.allclose(adapted.template, fake.templates[TEST[0]])

    fake.write_sequence_files(tmp_path / "b")
    train(tmp_path / "b.safetensors", tmp_path / "b", **options, adapt=[TEST[0]])
    shown = capsys.readouterr().out
    assert "personalized" in shown and "(1.56)" in shown and "modes hold" in shown


def test_without_a_test_subject_there_are_no_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    some = FakeVocaset({name: numbers for name, numbers in SENTENCES.items() if name not in TEST})
    mesh, folder = some.write_mesh(tmp_path / "sample.ply"), some.write_training_files(tmp_path / "a")
    train(tmp_path / "a.safetensors", folder, mesh, iterations=2, json_=True)
    said = capsys.readouterr()
    assert json.loads(said.out)["systems"] == [] and "none of the test subjects" in said.err
    assert Checkpoint.load(tmp_path / "a.safetensors").kind == "base"


def test_it_goes_on_where_it_stopped(
    fake: FakeVocaset,
    tmp_path: Path,
    quick: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder, mesh = fake.write_training_files(tmp_path / "a"), fake.write_mesh(tmp_path / "sample.obj")
    options: dict[str, Any] = {"vocaset": folder, "template_mesh": mesh, "iterations": 3, "json_": True}
    judged: list[str] = []
    judge = protocol._judge

    def interrupted(model: Checkpoint, subject: protocol.Subject, system: protocol.System, seed: int) -> Any:
        if len(judged) == 2:
            judged.append("interrupted")
            raise KeyboardInterrupt
        judged.append(system.name)
        return judge(model, subject, system, seed)

    monkeypatch.setattr(protocol, "_judge", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "base.safetensors", **options)
    before = (tmp_path / "base.safetensors").read_bytes()
    train(tmp_path / "base.safetensors", **options)
    assert len(json.loads(capsys.readouterr().out)["systems"]) == len(SYSTEMS)
    assert (tmp_path / "base.safetensors").read_bytes() == before
    names = [name for name in judged if name != "interrupted"]
    assert len(names) == len(set(names)), "nothing finished is judged twice"
    with pytest.raises(UserError, match="other settings"):
        train(tmp_path / "base.safetensors", **{**options, "iterations": 4})
    fake.pickle(folder / "templates.pkl", {n: t * 1.01 for n, t in fake.templates.items()})
    with pytest.raises(UserError, match="other settings or data"):
        train(tmp_path / "base.safetensors", **options)


def write_motions(fake: FakeVocaset, folder: Path) -> Path:
    """Two tracked people in a folder."""
    folder.mkdir()
    for name, place in (("anna", (TRAIN[0], 1)), ("bob", (TRAIN[1], 2))):
        take = fake.takes[place]
        displacements = (take.vertices - fake.templates[place[0]]).astype(np.float32)[::2]
        found = motion_basis(lambda d=displacements: [d], modes=8)
        valid = np.arange(len(displacements)) > 1
        motion = Motion(
            30.0, 0.0, fake.mean.astype(np.float32), fake.faces.astype(np.int32), found.basis,
            found.coefficients(displacements), valid,
        )  # fmt: skip
        motion.save(folder / f"{name}.npz")
        write_wav(folder / f"{name}.wav", take.audio.astype(np.float32), 22_000)
    return folder


def test_two_processes_train_one_model(fake: FakeVocaset, tmp_path: Path) -> None:
    folder = write_motions(fake, tmp_path / "motions")
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    out = ["--out", str(tmp_path / "base.safetensors"), "--iterations", "4", "--architecture", "attention"]
    command = [*torchrun, "-m", "cli.main", "train", "--motions", str(folder), *out]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("modes hold") == 1, "the first process alone prints"
    base = Checkpoint.load(tmp_path / "base.safetensors")
    assert base.styles == ("anna", "bob") and base.config.architecture == "attention"


def test_tracked_motions_train_too(
    fake: FakeVocaset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_motions(fake, tmp_path / "motions")
    train(tmp_path / "base.safetensors", motions=folder, iterations=4)
    assert "modes hold" in capsys.readouterr().out
    base = Checkpoint.load(tmp_path / "base.safetensors")
    assert base.styles == ("anna", "bob") and {"lips", "inner_lip_upper"} <= base.regions.keys()
    train(tmp_path / "base.safetensors", motions=folder, iterations=4)
    motion = Motion.load(folder / "bob.npz")
    replace(motion, coefficients=motion.coefficients[::-1]).save(folder / "bob.npz")
    with pytest.raises(UserError, match="other settings or data; give another --out, or delete this folder"):
        train(tmp_path / "base.safetensors", motions=folder, iterations=4)
    sound = (folder / "bob.wav").read_bytes()
    (folder / "bob.wav").write_bytes(b"none")
    with pytest.raises(UserError, match=r"bob\.wav"):
        train(tmp_path / "mended.safetensors", motions=folder, iterations=4)
    (folder / "bob.wav").write_bytes(sound)
    train(tmp_path / "mended.safetensors", motions=folder, iterations=4)  # nothing had been begun
    (tmp_path / "mended.safetensors.work/key").write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match="other settings or data"):
        train(tmp_path / "mended.safetensors", motions=folder, iterations=4)
    samples = read_audio(folder / "bob.wav")[0]
    for wrong, says in (
        (samples[: len(samples) // 2], "its sound ends at"),
        (0 * samples, "there is no sound"),
    ):
        write_wav(folder / "bob.wav", wrong)
        with pytest.raises(UserError, match=rf"bob\.wav: {says}"):
            train(tmp_path / "short.safetensors", motions=folder, iterations=4)
    (folder / "bob.wav").unlink()
    with pytest.raises(UserError, match=r"bob\.wav is missing"):
        train(tmp_path / "other.safetensors", motions=folder, iterations=4)


def test_what_is_learned_from_and_what_is_no_checkpoint_is_not_written_over(
    fake: FakeVocaset, tmp_path: Path
) -> None:
    folder, note = write_motions(fake, tmp_path / "motions"), tmp_path / "note.txt"
    note.write_text("mine")
    before = {path: path.read_bytes() for path in (*folder.iterdir(), note)}
    for out, says in (
        (folder / "bob.npz", "is one of the files to learn from"),
        (note, "exists and is not a checkpoint"),
    ):
        with pytest.raises(UserError, match=says):
            train(out, motions=folder, iterations=4)
    assert {path: path.read_bytes() for path in (*folder.iterdir(), note)} == before


def test_a_sentence_without_sound_is_named() -> None:
    data = Mock(folder=Path("vocaset"), displacements=Mock(return_value=np.zeros((30, 5, 3))))
    data.audio.return_value = np.zeros(100, np.float32)  # 6 ms
    with pytest.raises(UserError, match=f"vocaset: {TRAIN[0]}, sentence 7, has no sound or no motion"):
        Corpus(data, Mock(), Mock())._sequence(TRAIN[0], 7, 0)


def test_a_motions_sound_is_as_late_as_its_run_found_it(fake: FakeVocaset, tmp_path: Path) -> None:
    folder = write_motions(fake, tmp_path / "motions")
    motion, encoder = Motion.load(folder / "anna.npz"), load_encoder()
    basis = motion_basis(lambda: [motion.displacements()], modes=8)
    late = {"av_offset_s": 0.2, "av_offset_of": [sha256_file(folder / "anna.wav")]}
    others = late | {"av_offset_of": ["another file's"]}
    motions = (motion, replace(motion, provenance=late), replace(motion, provenance=others))
    found = [_motion_sequence(m, basis, folder / "anna.wav", encoder, 0).features for m in motions]
    np.testing.assert_allclose(found[1][:-6], found[0][6:], atol=1e-4)
    np.testing.assert_array_equal(found[2], found[0])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "either --vocaset"),
        ({"vocaset": Path("a"), "motions": Path("b")}, "either --vocaset"),
        ({"vocaset": Path("a")}, "VOCAset holds no faces: give .*--template-mesh"),
        ({"motions": Path("nowhere")}, "no NAME.npz"),
        (
            {"motions": Path("a"), "template_mesh": Path("m.ply")},
            "--template-mesh and --adapt go with --vocaset",
        ),
        ({"motions": Path("a"), "adapt": ["x"]}, "--template-mesh and --adapt go with --vocaset"),
        ({"motions": Path("a"), "device": "tpu"}, "--device: device 'tpu' is not known"),
        ({"vocaset": Path("nowhere"), "template_mesh": Path("m.ply")}, "there is no folder"),
    ],
)
def test_wrong_options_get_one_line(options: dict[str, Path], says: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=says):
        train(tmp_path / "base.safetensors", **options)
    assert not list(tmp_path.iterdir())


def test_wrong_subjects_and_meshes_get_one_line(fake: FakeVocaset, tmp_path: Path) -> None:
    folder, mesh = fake.write_training_files(tmp_path / "a"), fake.write_mesh(tmp_path / "sample.ply")
    out = tmp_path / "base.safetensors"
    with pytest.raises(UserError, match="is not a test subject"):
        train(out, folder, mesh, adapt=[TRAIN[0]])
    with pytest.raises(UserError, match="needs some of sentences"):
        train(out, folder, mesh, adapt=[TEST[1]])
    with pytest.raises(UserError, match="give a mesh of the data's topology"):
        train(out, folder, FakeVocaset({}, FLAME).write_mesh(tmp_path / "flame.ply"))
    with pytest.raises(UserError, match="a folder; give --out the name of a file"):
        train(tmp_path, folder, mesh)
    (tmp_path / "broken.ply").write_text("ply\nelement vertex many\n")
    with pytest.raises(UserError, match="not a readable mesh"):
        train(out, folder, tmp_path / "broken.ply")
    only_tested = FakeVocaset({TEST[0]: SENTENCES[TEST[0]]}).write_training_files(tmp_path / "b")
    with pytest.raises(UserError, match="none of the training subjects"):
        train(out, only_tested, mesh)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_faces_keep_the_order_of_the_file(fake: FakeVocaset, tmp_path: Path, suffix: str) -> None:
    faces = read_faces(fake.write_mesh(tmp_path / f"mesh{suffix}"), len(fake.mean))
    assert np.array_equal(faces, fake.faces)


def test_an_obj_with_texture_seams_keeps_its_vertices(tmp_path: Path) -> None:
    """One vertex with two texture coordinates is still one vertex."""
    path = tmp_path / "seam.obj"
    vertices = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 1 1 0"]
    textures = ["vt 0 0", "vt 1 0", "vt 0 1", "vt 1 1", "vt .5 .5"]
    path.write_text("\n".join([*vertices, *textures, "f 1/1 2/2 3/3", "f 2/5 4/4 3/3"]) + "\n")
    assert read_faces(path, 4).tolist() == [[0, 1, 2], [1, 3, 2]]


def test_the_mouth_is_found_by_its_motion(fake: FakeVocaset) -> None:
    displacements = [take.vertices - fake.templates[name] for (name, _), take in fake.takes.items()]
    motion = motion_basis(lambda: displacements)
    columns, rows = 13, 7
    upper, lower = columns // 2, columns * rows + columns // 2
    for masks in ({}, {"lips": np.array([0, upper, lower, 20], np.int32)}):
        regions = mouth_regions(fake.mean.astype(np.float32), motion, masks)
        assert (regions["inner_lip_upper"], regions["inner_lip_lower"]) == ([upper], [lower])
        assert len(regions["face"]) == len(fake.mean)
    assert regions["lips"].tolist() == [0, upper, lower, 20]
    boxed = mouth_regions(fake.mean.astype(np.float32), motion, {})["lips"]
    assert np.abs(fake.mean[boxed, 1]).max() < 0.0135 and {upper, lower} < set(boxed.tolist())
    with pytest.raises(UserError, match="units metres"):
        mouth_regions(1000 * fake.mean.astype(np.float32), motion, {})


def test_motion_off_the_basis_counts_in_the_score() -> None:
    """The score against truth in a wider basis equals the one worked out on vertices."""
    sequence = talker.sequence(40, 0)
    checkpoint = talker.checkpoint([sequence])
    rng = np.random.default_rng(0)
    other = rng.standard_normal((3, talker.D * 3))
    inside = talker.basis().reshape(talker.K, -1)
    outside = (
        np.linalg.qr((other - other @ inside.T @ inside).T)[0].T.reshape(3, talker.D, 3).astype(np.float32)
    )
    rest = 0.01 * rng.standard_normal((40, 3)).astype(np.float32)
    sample = sequence.coefficients[None] * 0.9
    found = Reference(sequence, outside, rest, np.zeros(1, np.float32)).score(sample, checkpoint)
    off = 0.1 * np.tensordot(sequence.coefficients, talker.basis(), 1) + np.tensordot(rest, outside, 1)
    assert found["l2_face"] == pytest.approx(1000 * np.linalg.norm(off, axis=2).mean(), rel=1e-4)
    assert found["l2_face"] > score(sample, sequence, checkpoint)["l2_face"]


def test_an_adaptation_that_diverges_has_no_figures(
    tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverge(*_: object) -> None:
        raise TrainingDivergedError("diverged at iteration 50")

    monkeypatch.setattr(protocol.Trainer, "train", diverge)
    train_sequences, sequence = [talker.sequence(90, 0)], talker.sequence(90, 1, style=1)
    base = talker.shaken(talker.checkpoint(train_sequences))
    judged = Reference(
        sequence,
        np.zeros((0, talker.D, 3), np.float32),
        np.zeros((90, 0), np.float32),
        np.zeros(1, np.float32),
    )
    subject = protocol.Subject("anna", base.template, load_encoder(), [sequence], [sequence], [judged])
    rows = protocol.compare_systems(
        base, train_sequences, [subject], tmp_path, TrainingConfig(iterations=60), Reporter()
    )
    assert all((row[name] is None) == (row["seconds"] > 0) for row in rows for name in METRICS)
    json.dumps(rows, allow_nan=False)
    _print({"checkpoint": "base", "modes": 6, "held": 1.0, "systems": rows})
    assert capsys.readouterr().out.count("- (") == 8 * len(METRICS)


def test_the_first_seconds_and_the_noise() -> None:
    sequences: list[Sequence] = [talker.sequence(90, seed) for seed in range(3)]
    assert [len(s.valid) for s in first_seconds(sequences, 5)] == [90, 60]
    assert [len(s.valid) for s in first_seconds(sequences, float("inf"))] == [90, 90, 90]
    assert first_seconds(sequences, 0) == []
    audio = np.sin(np.arange(100_000) / 7).astype(np.float32)
    noise = with_noise(audio, -24, seed=3) - audio
    assert 20 * np.log10(noise.std() / audio.std()) == pytest.approx(-24, abs=0.1)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.02
