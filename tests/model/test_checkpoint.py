"""The checkpoint file: round trip, and one clear line for everything that can be wrong with it."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from model.checkpoint import Checkpoint, read_tensors
from model.errors import ModelError
from model.motion import topology_hash
from tests.model import talker


@pytest.fixture
def made() -> Checkpoint:
    made = talker.shaken(talker.checkpoint([talker.sequence(100, 0)], styles=2))
    return replace(
        made, kind="subject", guidance=0.7, schedule="linear", provenance={"synthetic": True, "n": 3}
    )


@pytest.fixture
def path(made: Checkpoint, tmp_path: Path) -> Path:
    made.save(tmp_path / "checkpoint.safetensors")
    return tmp_path / "checkpoint.safetensors"


def test_round_trip(made: Checkpoint, path: Path) -> None:
    loaded = Checkpoint.load(path, topology=made.topology, encoder="test")
    for name in (
        "kind",
        "encoder",
        "styles",
        "config",
        "schedule",
        "parametrization",
        "fps",
        "guidance",
        "provenance",
    ):
        assert getattr(loaded, name) == getattr(made, name), name
    for name in ("basis", "template", "faces"):
        assert np.array_equal(getattr(loaded, name), getattr(made, name))
    for name in ("network", "ema"):
        ours, theirs = getattr(made, name), getattr(loaded, name)
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)
    for ours, theirs in (
        (made.regions, loaded.regions),
        (asdict(made.standardization), asdict(loaded.standardization)),
    ):
        assert ours.keys() == theirs.keys() and all(np.array_equal(ours[key], theirs[key]) for key in ours)


def test_two_saves_are_the_same_bytes_and_leave_nothing_beside(made: Checkpoint, path: Path) -> None:
    made.save(path.with_name("again"))
    assert path.read_bytes() == path.with_name("again").read_bytes()
    assert len(list(path.parent.iterdir())) == 2


def test_another_topology_or_encoder_says_which_is_needed(path: Path) -> None:
    other = topology_hash(talker.D + 1, talker.FACES)
    with pytest.raises(ModelError, match=f"topology.*{other[:12]} is needed"):
        Checkpoint.load(path, topology=other)
    with pytest.raises(
        ModelError, match=r"needs the speech encoder 'test' .* got 'wav2vec2': give .* --encoder"
    ):
        Checkpoint.load(path, encoder="wav2vec2")


def test_missing_truncated_and_foreign_files(path: Path) -> None:
    with pytest.raises(ModelError, match="there is no file"):
        Checkpoint.load(path.with_name("nothing"))
    content = path.read_bytes()
    foreign = (content[: len(content) // 2], content[:4], b"", b"PK\x03\x04" + bytes(100), bytes(1000))
    for index, wrong in enumerate(foreign):
        path.write_bytes(wrong)
        with pytest.raises(ModelError, match="not a readable safetensors file") as caught:
            Checkpoint.load(path)
        assert "\n" not in str(caught.value), index


def rewritten(
    path: Path, drop: str = "", metadata: dict[str, str] | None = None, **tensors: torch.Tensor
) -> None:
    """The same file with something else in it."""
    old, told = read_tensors(path)
    kept = {name: value for name, value in (old | tensors).items() if name != drop}
    save_file(kept, path, {k: v for k, v in (told | (metadata or {})).items() if k != drop})


def test_wrong_schema(path: Path) -> None:
    rewritten(path, metadata={"schema": "7"})
    with pytest.raises(ModelError, match=r"not a checkpoint of schema 1 \(it has 7"):
        Checkpoint.load(path)
    save_file({"weight": torch.zeros(3)}, path)
    with pytest.raises(ModelError, match="no schema at all"):
        Checkpoint.load(path)


@pytest.mark.parametrize(
    "missing", ["basis", "faces", "ema.full.weight", "network", "styles", "standardization.mean"]
)
def test_missing_parts(path: Path, missing: str) -> None:
    rewritten(path, drop=missing)
    with pytest.raises(ModelError, match="damaged or incomplete") as caught:
        Checkpoint.load(path)
    assert "\n" not in str(caught.value)


def test_a_file_from_before_there_was_a_spread(path: Path) -> None:
    rewritten(path, drop="standardization.spread")
    assert np.array_equal(Checkpoint.load(path).standardization.spread, np.ones(talker.K))


@pytest.mark.parametrize(
    "changes",
    [
        {"metadata": {"kind": "other"}},
        {"metadata": {"styles": '["one"]'}},
        {"metadata": {"network": '{"coefficients": 6}'}},
        {"metadata": {"provenance": "{"}},
        {"metadata": {"guidance": "much"}},
        {"basis": torch.zeros(5, talker.D, 3)},
        {"standardization.scale": torch.zeros(talker.K)},
        {"standardization.spread": torch.ones(2)},
        {"ema.decoder.bias": torch.zeros(2)},
        {"network.decoder.bias": torch.zeros(2)},
        {"ema.decoder.bias": torch.full((talker.K,), torch.nan)},
        {"metadata": {"schedule": "steep"}},
        {"metadata": {"parametrization": "v"}},
        {"metadata": {"guidance": "nan"}},
        {"metadata": {"fps": "0"}},
        {"basis": torch.full((talker.K, talker.D, 3), torch.nan)},
        {"standardization.mean": torch.full((talker.K,), torch.inf)},
        {"standardization.audio_mean": torch.zeros(3)},
        {"standardization.audio_scale": torch.zeros(talker.W)},
        {"faces": torch.full((talker.D - 2, 3), talker.D, dtype=torch.int32)},
        {"faces": torch.zeros(talker.D - 2, 3)},
        {"regions.face": torch.tensor([-1], dtype=torch.int32)},
        {"regions.lips": torch.zeros(0, dtype=torch.int32)},
        {"drop": "regions.inner_lip_upper"},
    ],
)
def test_parts_that_do_not_fit(path: Path, changes: dict) -> None:
    rewritten(path, **changes)
    with pytest.raises(ModelError, match="damaged or incomplete"):
        Checkpoint.load(path)


def test_sizes_that_no_memory_holds_are_refused_before_it_is_taken(path: Path) -> None:
    network = json.loads(read_tensors(path)[1]["network"])
    for channels in (1 << 20, 0):
        rewritten(path, metadata={"network": json.dumps(network | {"channels": channels})})
        with pytest.raises(ModelError, match="damaged or incomplete"):
            Checkpoint.load(path)


def test_a_mesh_that_is_not_the_one_it_names(path: Path) -> None:
    rewritten(path, faces=torch.zeros(4, 3, dtype=torch.int32))
    with pytest.raises(ModelError, match="not the one its topology names"):
        Checkpoint.load(path)
