"""VOCAset in both layouts: the same motion and sound come out, at true times; what does not fit is refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import correlate

from personalize.errors import UserError
from personalize.vocaset import (
    ADAPT_TRAIN,
    ADAPT_VAL,
    ALL,
    TEST,
    TRAIN,
    UNSHARED,
    VAL,
    SequenceFiles,
    TrainingFiles,
    Vocaset,
    open_vocaset,
)
from tests.personalize.vocaset_factory import FLAME, RATE, FakeVocaset

# The two gaps of the real set: sentence 24 of one training subject, 32 of one test subject.
MISSING = {TRAIN[4]: [23, 25], TEST[0]: [31, 33]}


@pytest.fixture(scope="module")
def fake() -> FakeVocaset:
    return FakeVocaset(MISSING, FLAME, frames=20)


@pytest.fixture(scope="module", params=["training", "sequences"])
def data(
    fake: FakeVocaset, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Vocaset:
    folder = tmp_path_factory.mktemp("data") / "vocaset"
    write = fake.write_training_files if request.param == "training" else fake.write_sequence_files
    return open_vocaset(write(folder))


def small(tmp_path: Path, layout: str = "training") -> Path:
    fake = FakeVocaset({TRAIN[0]: [1]}, frames=10)
    write = fake.write_training_files if layout == "training" else fake.write_sequence_files
    return write(tmp_path / "vocaset")


def test_the_published_split() -> None:
    assert TRAIN[4] == "FaceTalk_170811_03274_TA" and TEST[0] == "FaceTalk_170809_00138_TA"
    assert (len(TRAIN), len(VAL), len(TEST)) == (8, 2, 2) and len({*TRAIN, *VAL, *TEST}) == 12
    assert (len(ALL), len(ADAPT_TRAIN), len(ADAPT_VAL), len(UNSHARED)) == (40, 18, 2, 20)
    assert sorted([*ADAPT_TRAIN, *ADAPT_VAL, *UNSHARED]) == list(ALL)


def test_subjects_and_sentences_with_gaps(data: Vocaset) -> None:
    assert data.vertex_count == 5023
    assert {name: data.sentences(name) for name in MISSING} == MISSING
    assert data.sentences(VAL[0]) == []


def test_every_second_frame_is_taken_as_it_is(data: Vocaset, fake: FakeVocaset) -> None:
    for (name, number), take in fake.takes.items():
        template = fake.templates[name].astype(np.float32)
        assert np.array_equal(data.displacements(name, number), take.vertices[::2] - template)
        assert data.displacements(name, number).dtype == np.float32


def test_sound_is_16_khz_at_its_own_level(data: Vocaset, fake: FakeVocaset) -> None:
    take = fake.takes[TRAIN[4], 23]
    audio = data.audio(TRAIN[4], 23)
    assert audio.dtype == np.float32 and len(audio) == pytest.approx(len(take.audio) / RATE * 16_000, abs=2)
    assert audio.std() == pytest.approx(take.audio.std(), rel=0.02)
    at = np.arange(len(audio)) / 16_000
    truth = np.interp(at, np.arange(len(take.audio)) / RATE, take.audio)
    lag = correlate(audio, truth, "full").argmax() - (len(truth) - 1)
    assert abs(lag) <= 1 and np.corrcoef(audio, truth)[0, 1] > 0.99


def test_masks_lie_beside_one_layout(tmp_path: Path) -> None:
    fake = FakeVocaset({TRAIN[0]: [1]}, frames=10)
    assert open_vocaset(fake.write_training_files(tmp_path / "a")).masks == {}
    lips = open_vocaset(fake.write_sequence_files(tmp_path / "b")).masks["lips"]
    assert lips.dtype == np.int32 and 0 < len(lips) < len(fake.mean)


def test_a_frame_missing_in_the_index_is_interpolated(tmp_path: Path) -> None:
    fake = FakeVocaset({TRAIN[0]: [1]}, frames=21)
    folder = fake.write_training_files(tmp_path / "vocaset")
    rows = {100 + frame: frame for frame in range(21) if frame != 4}  # counted from 100, frame 4 is lost
    fake.pickle(folder / "subj_seq_to_idx.pkl", {TRAIN[0]: {"sentence01": rows}})
    found = open_vocaset(folder).displacements(TRAIN[0], 1)
    vertices = fake.takes[TRAIN[0], 1].vertices - fake.templates[TRAIN[0]].astype(np.float32)
    assert len(found) == 11 and np.array_equal(found[3:], vertices[6::2])
    assert np.allclose(found[2], (vertices[3] + vertices[5]) / 2, atol=1e-7)


def test_a_sentence_needs_motion_and_sound(tmp_path: Path) -> None:
    fake = FakeVocaset({TRAIN[0]: [1, 2]}, frames=10)
    folder = fake.write_sequence_files(tmp_path / "vocaset")
    (folder / "wav" / f"{TRAIN[0]}_sentence02.wav").unlink()
    assert open_vocaset(folder).sentences(TRAIN[0]) == [1]
    folder = fake.write_training_files(tmp_path / "other")
    sound = {"audio": [0, 16384, -16384] * 3000, "sample_rate": 16_000}  # plain numbers are sound as well
    fake.pickle(folder / "raw_audio_fixed.pkl", {TRAIN[0]: {"sentence01": sound}})
    data = open_vocaset(folder)
    assert data.sentences(TRAIN[0]) == [1]
    assert data.audio(TRAIN[0], 1)[:3].tolist() == [0, 0.5, -0.5]


def test_layouts_are_told_apart_and_other_folders_refused(tmp_path: Path) -> None:
    assert isinstance(open_vocaset(small(tmp_path)), TrainingFiles)
    (tmp_path / "second").mkdir()
    assert isinstance(open_vocaset(small(tmp_path / "second", "sequences")), SequenceFiles)
    with pytest.raises(UserError, match="there is no folder"):
        open_vocaset(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"is not VOCAset: it needs data_verts\.npy"):
        open_vocaset(tmp_path / "empty")


def test_vertices_of_a_sentences_file_that_are_not_finite_are_named(tmp_path: Path) -> None:
    fake = FakeVocaset({TRAIN[0]: [1]}, frames=10)
    folder = fake.write_sequence_files(tmp_path / "vocaset")
    file = folder / "vertices_npy" / f"{TRAIN[0]}_sentence01.npy"
    vertices = np.load(file)
    vertices[4, 5] = np.inf
    for wrong in (vertices, vertices[:0]):
        np.save(file, wrong)
        with pytest.raises(
            UserError, match=r"sentence01\.npy: holds no vertices, or some that are not finite"
        ):
            open_vocaset(folder).displacements(TRAIN[0], 1)


def overwritten(folder: Path, name: str, value: Any) -> Path:
    if name.endswith(".npy"):
        np.save(folder / name, value)
    else:
        FakeVocaset.pickle(folder / name, value)
    return folder


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("templates.pkl", {}, "no templates"),
        ("templates.pkl", {"a": np.zeros((5, 2))}, r"\[D, 3\]"),
        ("templates.pkl", {"a": np.full((5, 3), np.nan)}, "finite"),
        ("templates.pkl", {"a": np.zeros((5, 3)), "b": np.zeros((6, 3))}, "different numbers"),
        ("data_verts.npy", np.zeros((10, 7, 3)), "fit templates.pkl"),
        ("data_verts.npy", np.zeros((10, 182, 3), int), "floats"),
        ("data_verts.npy", np.full((10, 182, 3), np.nan, np.float32), r"data_verts\.npy: holds no"),
        ("subj_seq_to_idx.pkl", {TRAIN[0]: [1]}, "subject: {sequence"),
        ("subj_seq_to_idx.pkl", {TRAIN[0]: {"sentence01": {0: 10_000}}}, "do not fit"),
        ("subj_seq_to_idx.pkl", {TRAIN[0]: {"sentence01": {0: -1}}}, "do not fit"),
        ("subj_seq_to_idx.pkl", {TRAIN[0]: {"sentence01": {0: 0, 1 << 40: 1}}}, "frames missing"),
        ("subj_seq_to_idx.pkl", {TRAIN[0]: {"sentence01": "rows"}}, "do not fit"),
        ("raw_audio_fixed.pkl", {TRAIN[0]: {"sentence01": {"audio": [1, 2]}}}, "sample_rate"),
        (
            "raw_audio_fixed.pkl",
            {TRAIN[0]: {"sentence01": {"audio": [1, 2], "sample_rate": 10**9}}},
            "sample rate",
        ),
        ("FLAME_masks.pkl", {"lips": [0, 10_000]}, "list of vertices"),
    ],
)
def test_files_that_do_not_fit_are_named(tmp_path: Path, name: str, value: Any, says: str) -> None:
    folder = overwritten(small(tmp_path), name, value)
    with pytest.raises(UserError, match=says) as caught:
        data = open_vocaset(folder)
        data.displacements(TRAIN[0], 1)
        data.audio(TRAIN[0], 1)
        assert data.masks
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_an_array_of_objects_is_not_unpickled(tmp_path: Path) -> None:
    folder = overwritten(small(tmp_path), "data_verts.npy", np.array([{}, 1], object))
    with pytest.raises(UserError, match=r"not a readable \.npy"):
        open_vocaset(folder)
