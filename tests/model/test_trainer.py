"""Training: it learns, repeats itself, goes on after a kill as if nothing had happened, and says when it diverges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import distributed

from model.checkpoint import Checkpoint
from model.dataset import Batch, Crops
from model.errors import ModelError
from model.metrics import score
from model.objective import Draws, GraphedGradient, Objective, SharedGradient, coefficient_weights
from model.synthesis import synthesize
from model.trainer import LOG_FILE, STATE_FILE, Trainer, TrainingDivergedError
from model.training_config import TrainingConfig, available_device, settled
from tests.model import talker

TINY = TrainingConfig(
    iterations=24, batch=4, frames=12, candidates=3, log_every=5, threads=1, precision="float32"
)

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def start() -> tuple[Checkpoint, list]:
    sequences = [talker.sequence(120, 0), talker.sequence(90, 1, style=1)]
    return talker.checkpoint(sequences, styles=2), sequences


def weights(path: Path) -> dict[str, torch.Tensor]:
    loaded = Checkpoint.load(path)
    return {f"n.{k}": v for k, v in loaded.network.items()} | {f"e.{k}": v for k, v in loaded.ema.items()}


def assert_equal(first: Path, second: Path) -> None:
    ours, theirs = weights(first), weights(second)
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


class Killed(Exception):  # noqa: N818
    """Stands for a kill."""


@pytest.mark.parametrize(
    ("step", "threads", "device"),
    [(5, 1, "cpu"), (15, 2, "cpu"), pytest.param(15, 1, "cuda", marks=needs_cuda)],
)
def test_a_killed_training_goes_on_bit_for_bit(tmp_path: Path, step: int, threads: int, device: str) -> None:
    checkpoint, sequences = start()
    config = replace(TINY, threads=threads, device=device)

    def kill(done: int, total: int) -> None:
        if done == step:
            raise Killed

    every_step = replace(config, save_seconds=0.0)
    whole = Trainer(checkpoint, sequences, tmp_path / "whole", config).train()
    with pytest.raises(Killed):
        Trainer(checkpoint, sequences, tmp_path / "killed", every_step).train(kill)
    continued = Trainer(checkpoint, sequences, tmp_path / "killed", config)
    assert continued.step == step - 1  # the save after step `step` was not reached
    again = continued.train()
    assert [path.name for path in again] == [f"candidate_{n:08d}.safetensors" for n in (8, 16, 24)]
    for first, second in zip(whole, again, strict=True):
        assert_equal(first, second)
    logs = [(tmp_path / name / LOG_FILE).read_text() for name in ("whole", "killed")]
    assert logs[0] == logs[1] and logs[0].count("\n") == 6


def test_a_finished_training_is_not_done_again(tmp_path: Path) -> None:
    checkpoint, sequences = start()
    paths = Trainer(checkpoint, sequences, tmp_path, TINY).train()
    before = [path.read_bytes() for path in paths]
    assert Trainer(checkpoint, sequences, tmp_path, TINY).train() == paths
    assert [path.read_bytes() for path in paths] == before


def test_the_seed_decides(tmp_path: Path) -> None:
    checkpoint, sequences = start()
    last = [
        Trainer(checkpoint, sequences, tmp_path / name, replace(TINY, seed=seed)).train()[-1]
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    ]
    assert_equal(last[0], last[1])
    assert not torch.equal(weights(last[0])["n.decoder.weight"], weights(last[2])["n.decoder.weight"])


def test_it_starts_from_a_checkpoint_file_as_from_memory(tmp_path: Path) -> None:
    """A file keeps no order of its tensors, and the average must still follow each its own."""
    checkpoint, sequences = start()
    checkpoint.save(tmp_path / "base")
    first = Trainer(checkpoint, sequences, tmp_path / "memory", TINY).train()[-1]
    second = Trainer(Checkpoint.load(tmp_path / "base"), sequences, tmp_path / "file", TINY).train()[-1]
    assert_equal(first, second)


def test_a_card_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert available_device("cuda:1").index == 1 and available_device("cuda").type == "cuda"
    with pytest.raises(ModelError, match="'cuda:2' is not there; use cpu or cuda"):
        available_device("cuda:2")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ModelError, match=r"'cuda' is not there; use cpu$"):
        available_device("cuda")


def test_a_state_of_another_training_is_refused(tmp_path: Path) -> None:
    checkpoint, sequences = start()
    Trainer(checkpoint, sequences, tmp_path, TINY).train()
    with pytest.raises(ModelError, match="other settings, data or start"):
        Trainer(checkpoint, sequences, tmp_path, replace(TINY, learning_rate=3e-4))
    with pytest.raises(ModelError, match="other settings, data or start"):
        Trainer(checkpoint, sequences[:1], tmp_path, TINY)
    moved = [replace(one, coefficients=one.coefficients * np.float32(1.01)) for one in sequences]
    with pytest.raises(ModelError, match="other settings, data or start"):
        Trainer(checkpoint, moved, tmp_path, TINY)
    with pytest.raises(ModelError, match="other settings, data or start"):
        Trainer(talker.shaken(checkpoint), sequences, tmp_path, TINY)
    with pytest.raises(ModelError, match="other settings, data or start"):
        Trainer(talker.checkpoint(sequences, architecture="transformer"), sequences, tmp_path, TINY)
    Trainer(checkpoint, sequences, tmp_path, replace(TINY, threads=2, log_every=7))  # changes no result
    Trainer(checkpoint, sequences, tmp_path, replace(TINY, device="cpu:0"))  # one of several
    (tmp_path / STATE_FILE).write_bytes(b"half")
    with pytest.raises(ModelError, match="not a readable"):
        Trainer(checkpoint, sequences, tmp_path, TINY)


def test_divergence_names_the_iteration_and_keeps_what_was_good(tmp_path: Path) -> None:
    checkpoint, sequences = start()
    config = replace(TINY, learning_rate=10.0, candidates=24)
    with pytest.raises(TrainingDivergedError, match=r"diverged at iteration (5|10|15|20|24) "):
        Trainer(checkpoint, sequences, tmp_path, config).train()
    assert (tmp_path / "candidate_00000001.safetensors").exists()


def test_three_times_what_noise_costs_is_divergence(tmp_path: Path) -> None:
    """The figure of docs/method.md."""
    trainer = Trainer(*start(), tmp_path, TINY)
    trainer._losses = [torch.tensor(62.9)]
    assert trainer._checked_loss() == pytest.approx(62.9)
    for loss in (63.1, float("nan")):
        trainer._losses = [torch.tensor(loss)]
        with pytest.raises(TrainingDivergedError):
            trainer._checked_loss()


def test_the_number_of_threads_comes_back(tmp_path: Path) -> None:
    before = torch.get_num_threads()
    Trainer(*start(), tmp_path, replace(TINY, threads=2, iterations=1, candidates=1)).train()
    assert torch.get_num_threads() == before


@pytest.mark.parametrize(
    ("parametrization", "architecture"),
    [("skip", "conv"), ("plain", "conv"), ("skip", "attention"), ("skip", "transformer")],
)
def test_what_it_learns_beats_the_mean_on_unseen_motion(
    tmp_path: Path, parametrization: str, architecture: str
) -> None:
    train, unseen = talker.sequence(900, 0), talker.sequence(300, 1)
    # Each of the talker's few features matters: none is dropped.
    config = TrainingConfig(
        iterations=300,
        batch=16,
        frames=16,
        learning_rate=3e-3,
        ema=0.98,
        feature_dropout=0.0,
        candidates=1,
        threads=1,
    )
    untrained = talker.checkpoint([train], parametrization, architecture=architecture)
    path = Trainer(untrained, [train], tmp_path, config).train()[-1]
    learned = Checkpoint.load(path)
    drawn = synthesize(learned, unseen.features, guidance=1.0, rule="ddim", steps=25, samples=2)
    mean = np.broadcast_to(train.coefficients.mean(0), (1, *unseen.coefficients.shape))
    ours, baseline = score(drawn, unseen, learned), score(mean, unseen, learned)
    for name in ("lip_sync", "l2_lip", "l2_face"):
        assert ours[name] < 0.9 * baseline[name], name
    assert ours["lip_gap_r"] > 0.7 and 0.6 < ours["spread"] < 1.3 and ours["velocity"] < 2.0


def train_as_one_of_two(rank: int, folder: Path) -> None:
    distributed.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    Trainer(*start(), folder / "two", TINY).train()
    distributed.destroy_process_group()


def test_two_processes_learn_what_one_does(tmp_path: Path) -> None:
    one = Trainer(*start(), tmp_path / "one", TINY).train()
    torch.multiprocessing.spawn(train_as_one_of_two, (tmp_path,), nprocs=2)
    for path in one:
        ours, theirs = weights(path), weights(tmp_path / "two" / path.name)
        for name, value in ours.items():
            # Adam divides by the gradient's size, so rounding moves weights whose gradient is almost zero.
            torch.testing.assert_close(value, theirs[name], atol=1e-3, rtol=1e-3)
    logs = [(tmp_path / name / LOG_FILE).read_text().split() for name in ("one", "two")]
    assert len(logs[0]) == len(logs[1])


@pytest.mark.parametrize("power", [0.5, 2.0])
def test_a_coefficient_weighs_the_same_however_it_is_scaled(power: float) -> None:
    sd, residual = torch.tensor([0.08, 0.007, 0.005]), torch.tensor([0.01, -0.002, 0.003])
    losses = []
    for spread in (torch.ones(3), torch.tensor([1.0, 0.47, 0.8])):
        weights = coefficient_weights(sd / spread, spread, power)
        assert torch.isclose((weights * spread**2).sum(), torch.tensor(1.0))  # predicting the mean
        losses.append(float((weights * (residual / (sd / spread)) ** 2).sum()))
    assert losses[1] == pytest.approx(losses[0], rel=1e-5)
    still = coefficient_weights(sd, torch.tensor([1.0, 1.0, 0.0]), power)
    assert torch.isfinite(still).all() and still[2] < 20 * still[0]


@pytest.mark.parametrize("threads", [2, 3])
def test_shares_of_a_batch_have_the_gradient_of_the_whole(threads: int) -> None:
    checkpoint, sequences = start()
    config = replace(TINY, batch=7, feature_dropout=0.3)
    generator = torch.Generator().manual_seed(0)
    batch = Crops(sequences, checkpoint.standardization, 12).draw(7, generator)
    draws = Draws.of(batch, 500, config, generator)
    weights = torch.linspace(0.1, 1, talker.K)
    objective = Objective(checkpoint.model(), checkpoint.diffusion(), weights, config).double()
    objective.requires_grad_(True)
    batch = Batch(batch.motion.double(), batch.audio.double(), batch.style)
    draws = Draws(draws.t, draws.noise.double(), draws.keep.double(), draws.channels.double())
    torch.nn.init.normal_(objective.network.decoder.weight)
    whole = objective(batch, draws)
    expected = torch.autograd.grad(whole, list(objective.parameters()))
    loss = SharedGradient(objective, threads)(batch, draws)
    torch.testing.assert_close(loss, whole.detach())
    for parameter, gradient in zip(objective.parameters(), expected):
        torch.testing.assert_close(parameter.grad, gradient)


def test_draws_zero_as_many_channels_and_conditions_as_asked() -> None:
    checkpoint, sequences = start()
    config = TrainingConfig(unconditional=0.25, feature_dropout=0.5)
    generator = torch.Generator().manual_seed(0)
    batch = Crops(sequences, checkpoint.standardization, 12).draw(2000, generator)
    draws = Draws.of(batch, 500, config, generator)
    assert abs(float(draws.keep.mean()) - 0.75) < 0.03
    assert set(draws.channels.unique().tolist()) == {0.0, 2.0}
    assert abs(float(draws.channels.mean()) - 1) < 0.03
    assert draws.t.min() >= 0 and draws.t.max() < 500
    half = draws.part(slice(1, None, 2))
    assert torch.equal(half.noise, draws.noise[:, 1::2]) and torch.equal(half.t, draws.t[1::2])


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_two_threads_repeat_to_the_byte(tmp_path: Path, precision: str) -> None:
    config = replace(TINY, iterations=120, candidates=1, batch=16, threads=2, precision=precision)
    first, second = (Trainer(*start(), tmp_path / name, config).train()[0] for name in ("one", "two"))
    assert_equal(first, second)


def test_bfloat16_follows_float32(tmp_path: Path) -> None:
    losses = []
    for precision in ("float32", "bfloat16"):
        config = replace(TINY, iterations=60, precision=precision, log_every=60)
        Trainer(*start(), tmp_path / precision, config).train()
        losses.append(float((tmp_path / precision / LOG_FILE).read_text().split(",")[-1]))
    assert losses[0] != losses[1] and abs(losses[1] / losses[0] - 1) < 0.02


def test_weight_decay_shrinks_what_the_data_do_not_ask_for(tmp_path: Path) -> None:
    norms = []
    for decay in (0.0, 20.0):
        config = replace(TINY, weight_decay=decay)
        path = Trainer(*start(), tmp_path / str(decay), config).train()[-1]
        norms.append(float(Checkpoint.load(path).network["middle.weight"].norm()))
    assert norms[1] < 0.8 * norms[0]


def test_what_the_machine_decides_is_settled_once() -> None:
    config = settled(TrainingConfig())
    assert config.precision in ("float32", "bfloat16") and config.threads == 2
    assert settled(config) == config
    assert settled(TrainingConfig(precision="float32", threads=4)).threads == 4


@needs_cuda
@pytest.mark.parametrize("architecture", ["conv", "attention", "transformer"])
def test_cuda_learns_what_the_processor_does(tmp_path: Path, architecture: str) -> None:
    checkpoint, sequences = start()
    checkpoint = talker.checkpoint(sequences, styles=2, architecture=architecture)
    here = Trainer(checkpoint, sequences, tmp_path / "cpu", TINY).train()[-1]
    there = Trainer(checkpoint, sequences, tmp_path / "cuda", replace(TINY, device="cuda")).train()[-1]
    ours, theirs = weights(here), weights(there)
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], atol=1e-2, rtol=1e-2)


@needs_cuda
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_recorded_gradient_is_the_gradient(precision: str) -> None:
    checkpoint, sequences = start()
    config = TrainingConfig(precision=precision)
    device = torch.device("cuda")
    objective = Objective(
        checkpoint.model(), checkpoint.diffusion().to(device), torch.full((talker.K,), 0.1), config
    ).to(device)
    objective.requires_grad_(True)
    gradient, generator = GraphedGradient(objective), torch.Generator().manual_seed(0)
    crops = Crops(sequences, checkpoint.standardization, 12, device)
    for _ in range(3):
        batch = crops.draw(16, generator)
        draws = Draws.of(batch, 500, config, generator).to(device)
        loss = gradient(batch, draws)
        whole = objective(batch, draws)
        torch.testing.assert_close(loss, whole.detach())
        for parameter, value in zip(
            objective.parameters(), torch.autograd.grad(whole, list(objective.parameters()))
        ):
            torch.testing.assert_close(parameter.grad, value)


@pytest.mark.parametrize("kind", ["base", "subject"])
def test_decay_leads_a_subject_back_toward_where_its_motion_started(tmp_path: Path, kind: str) -> None:
    """A decay of the whole distance in each step: what is left is where it leads to, and one step of Adam."""
    checkpoint, sequences = start()
    checkpoint = replace(talker.shaken(checkpoint), kind=kind)
    step = 1e-3
    config = replace(TINY, iterations=3, candidates=1, learning_rate=step, weight_decay=1 / step)
    trainer = Trainer(checkpoint, sequences, tmp_path, config)
    trainer.train()
    for name, value in trainer.checkpoint().network.items():
        anchored = kind == "subject" and "audio" not in name
        back = anchored * config.anchor * checkpoint.network[name]
        assert (value - back).abs().max() <= 1.1 * step
