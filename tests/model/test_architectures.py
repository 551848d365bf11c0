"""The ablation's networks: attention against dense references, what they see and hear, their checkpoints."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from model import attention as blocks
from model.architectures import ARCHITECTURES, build_network
from model.attention import HEADS
from model.attention_network import REACH, SpeechAttention
from model.checkpoint import Checkpoint, read_tensors, serialize
from model.denoiser import Architecture, Denoiser, NetworkConfig
from model.errors import ModelError
from model.transformer_network import SelfAttention
from tests.model import talker

K, W, C = talker.K, talker.W, 16


def network(architecture: Architecture) -> Denoiser:
    """Random weights everywhere, f64."""
    torch.manual_seed(0)
    result = build_network(NetworkConfig(K, W, 2, architecture=architecture)).double()
    for parameter in result.parameters():
        torch.nn.init.normal_(parameter, std=0.15)
    return result


def noise(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)).double()


@torch.no_grad()
def evaluate(net: Denoiser, x: Tensor, audio: Tensor, keep: Tensor | None = None) -> Tensor:
    condition = net.condition(audio[:, None], keep)
    return net(x[:, None], torch.tensor(7), condition, torch.tensor(1))[:, 0]


@torch.no_grad()
def test_speech_attention_is_dense_attention_with_a_band_as_its_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    attention = SpeechAttention(C).double()
    torch.nn.init.normal_(attention.offset)
    h, memory = noise(20, 3, C), noise(20, 3, 2 * C, seed=2)

    def heads(x: Tensor) -> Tensor:
        return x.reshape(20, 3, HEADS, -1).permute(1, 2, 0, 3)

    distance = torch.arange(20) - torch.arange(20)[:, None]
    bias = attention.offset[:, distance.clamp(-REACH, REACH) + REACH]
    bias = bias.masked_fill(distance.abs() > REACH, -torch.inf)
    query = attention.query(attention.norm(h))
    dense = F.scaled_dot_product_attention(
        *map(heads, (query, memory[..., :C], memory[..., C:])), attn_mask=bias
    )
    expected = h + attention.output(dense.permute(2, 0, 1, 3).reshape(h.shape))
    torch.testing.assert_close(attention(h, memory), expected)
    monkeypatch.setattr(blocks, "BLOCK", 5)
    torch.testing.assert_close(attention(h, memory), expected)


@torch.no_grad()
def test_self_attention_is_softmax_with_a_bias_that_falls_with_time(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    attention = SelfAttention(C).double()
    h = noise(23, 2, 3, C)
    found = attention(h)
    size = C // HEADS
    query, (key, value) = attention.query(h), attention.memory(h).split(C, dim=-1)
    distance = (torch.arange(23) - torch.arange(23)[:, None]).abs().double()
    outputs = []
    for head, slope in enumerate((1 / 4, 1 / 16, 1 / 64, 1 / 256)):
        q, k, v = (part[..., head * size : (head + 1) * size] for part in (query, key, value))
        scores = torch.einsum("nabc,mabc->abnm", q, k) / size**0.5 - slope * distance
        outputs.append(torch.einsum("abnm,mabc->nabc", scores.softmax(-1), v))
    torch.testing.assert_close(found, attention.output(torch.cat(outputs, dim=-1)))
    monkeypatch.setattr(blocks, "BLOCK", 5)
    torch.testing.assert_close(attention(h), found)


def test_attention_sees_as_far_as_its_halo_and_an_even_shift_shifts_it() -> None:
    net, x, audio = network("attention"), noise(80, K), noise(80, W, seed=2)
    assert net.halo is not None
    whole = evaluate(net, x, audio)
    heard = audio.clone()
    heard[40] += 1
    moved = torch.nonzero((evaluate(net, x, heard) - whole).abs().amax(dim=1)).flatten()
    assert net.halo - 1 <= int((moved - 40).abs().max()) <= net.halo  # even, and not more than it must be
    shifted = evaluate(net, x[6:], audio[6:])
    torch.testing.assert_close(shifted[net.halo :], whole[6 + net.halo :], atol=1e-10, rtol=0)


def test_the_transformer_sees_every_frame() -> None:
    net, x, audio = network("transformer"), noise(60, K), noise(60, W, seed=2)
    whole = evaluate(net, x, audio)
    audio[30] += 1
    assert net.halo is None and bool(((evaluate(net, x, audio) - whole).abs().amax(dim=1) > 0).all())


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_a_zeroed_audio_condition_does_not_hear(architecture: Architecture) -> None:
    net, x, audio = network(architecture), noise(20, K), noise(20, W, seed=2)
    silent = torch.zeros(1).double()
    assert torch.equal(evaluate(net, x, audio, silent), evaluate(net, x, -audio, silent))
    both = net.condition(audio[:, None]).with_unconditional()
    with torch.no_grad():
        output = net(x[:, None, None], torch.tensor(7), both, torch.tensor(1))
    torch.testing.assert_close(output[:, 0, 0], evaluate(net, x, audio))
    torch.testing.assert_close(output[:, 1, 0], evaluate(net, x, audio, silent))


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_batch_elements_do_not_see_each_other(architecture: Architecture) -> None:
    net, x, audio = network(architecture), noise(20, 2, K), noise(20, 2, W, seed=2)
    with torch.no_grad():
        found = net(x, torch.tensor([7, 7]), net.condition(audio), torch.tensor([1, 1]))
    torch.testing.assert_close(found[:, 1], evaluate(net, x[:, 1], audio[:, 1]))


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_parameter_learns(architecture: Architecture) -> None:
    net, x, audio = network(architecture), noise(20, 3, K), noise(20, 3, W, seed=2)
    net(
        x, torch.tensor([1, 50, 400]), net.condition(audio), torch.tensor([0, 1, 0])
    ).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None and bool((parameter.grad != 0).any()), name


def saved(architecture: Architecture, path: Path) -> Checkpoint:
    made = talker.shaken(talker.checkpoint([talker.sequence(100, 0)], architecture=architecture))
    made.save(path)
    return made


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_a_checkpoint_comes_back(architecture: Architecture, tmp_path: Path) -> None:
    made = saved(architecture, tmp_path / "made")
    loaded = Checkpoint.load(tmp_path / "made")
    assert loaded.config == made.config and loaded.config.architecture == architecture
    assert loaded.ema.keys() == made.ema.keys()
    assert all(torch.equal(loaded.ema[name], value) for name, value in made.ema.items())


def test_a_file_names_its_architecture_and_one_without_is_the_papers(tmp_path: Path) -> None:
    made = saved("conv", tmp_path / "made")
    tensors, metadata = read_tensors(tmp_path / "made")
    sizes = json.loads(metadata["network"])

    def rewritten(sizes: dict) -> Path:
        path = tmp_path / "rewritten"
        path.write_bytes(serialize(tensors, metadata | {"network": json.dumps(sizes)}))
        return path

    older = {name: size for name, size in sizes.items() if name != "architecture"}
    assert Checkpoint.load(rewritten(older)).config == made.config
    with pytest.raises(ModelError, match=r"damaged or incomplete.*Missing key"):
        Checkpoint.load(rewritten(sizes | {"architecture": "transformer"}))
    with pytest.raises(
        ModelError, match=r"rewritten .*'recurrent' is not known; use one of conv, attention, trans"
    ):
        Checkpoint.load(rewritten(sizes | {"architecture": "recurrent"}))
