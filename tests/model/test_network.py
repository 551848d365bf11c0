"""The network: what an output frame sees, and that the basis form is the vertex model."""

from __future__ import annotations

import pytest
import torch

from model.denoiser import NetworkConfig
from model.diffusion import Diffusion, Parametrization
from model.network import HALO, Network
from model.objective import coefficient_weights, objective
from tests.model import talker

K, W, V = talker.K, talker.W, 3 * talker.D


def network(coefficients: int = K) -> Network:
    """Random weights everywhere, f64."""
    torch.manual_seed(0)
    result = Network(NetworkConfig(coefficients, W, 2)).double()
    for parameter in result.parameters():
        torch.nn.init.normal_(parameter, std=0.15)
    return result


def evaluate(net: Network, x: torch.Tensor, audio: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        return net(x[:, None], torch.tensor(7), net.condition(audio[:, None]), torch.tensor(1))[:, 0]


def inputs(frames: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return tuple(torch.randn(frames, width, generator=generator).double() for width in (K, W))  # type: ignore[return-value]


def test_an_even_shift_of_the_input_shifts_the_output() -> None:
    net, (x, audio) = network(), inputs(60)
    whole = evaluate(net, x, audio)
    for shift in (2, 6):
        moved = evaluate(net, x[shift:], audio[shift:])
        torch.testing.assert_close(moved[HALO:], whole[shift + HALO :], atol=1e-10, rtol=0)


def test_the_halo_is_what_an_output_frame_sees() -> None:
    """Changing input 30 moves no output farther away than HALO, and it does move its neighbourhood."""
    net, (x, audio) = network(), inputs(60)
    for changed in (x, audio):
        before = evaluate(net, x, audio)
        changed[30] += 1
        moved = torch.nonzero((evaluate(net, x, audio) - before).abs().amax(dim=1)).flatten()
        assert moved.min() >= 30 - HALO and moved.max() <= 30 + HALO and len(moved) > 8


def test_a_zeroed_audio_condition_adds_nothing() -> None:
    net, audio = network(), inputs(20)[1]
    condition = net.condition(audio[:, None], keep=torch.zeros(1).double())
    assert all(bool((part == 0).all()) for part in condition.parts)
    both = net.condition(audio[:, None]).with_unconditional()
    for with_and_without, without in zip(both.parts, condition.parts, strict=True):
        assert torch.equal(with_and_without[:, 1], without)


def test_batch_elements_do_not_see_each_other() -> None:
    net, (x, audio) = network(), inputs(20)
    batch = torch.stack([x, x.flip(0)], dim=1)
    audios = torch.stack([audio, audio.flip(0)], dim=1)
    with torch.no_grad():
        found = net(batch, torch.tensor([7, 7]), net.condition(audios), torch.tensor([1, 1]))
    torch.testing.assert_close(found[:, 0], evaluate(net, x, audio))


@pytest.mark.parametrize("parametrization", ["plain", "skip"])
def test_the_vertex_model_is_the_basis_form(parametrization: Parametrization) -> None:
    """With encoder E = E_B B and decoder W = B' W_B the vertex network has the same loss and
    gradients, noise outside the basis' span included. Under `skip` the skipped x_t is projected onto the span.
    """
    small, large = network(), network(V)
    basis = torch.from_numpy(talker.basis().reshape(K, V)).double()
    basis = torch.linalg.qr(basis.T)[0].T  # orthonormal in f64
    state = {name: value.detach() for name, value in small.state_dict().items()}
    large.load_state_dict(
        state
        | {
            "encoder.weight": state["encoder.weight"] @ basis,
            "decoder.weight": basis.T @ state["decoder.weight"],
            "decoder.bias": basis.T @ state["decoder.bias"],
        }
    )
    generator = torch.Generator().manual_seed(3)
    x0 = torch.randn(30, 4, K, generator=generator).double()
    noise = torch.randn(30, 4, V, generator=generator).double()
    audio = torch.randn(30, 4, W, generator=generator).double()
    keep = torch.tensor([1.0, 0.0, 1.0, 1.0]).double()
    t, style = torch.tensor([3, 200, 350, 499]), torch.tensor([0, 1, 0, 1])
    scale = 0.02 * 0.6 ** torch.arange(K).double()
    diffusion = Diffusion(parametrization=parametrization)

    x_t = diffusion.add_noise(x0, t, noise @ basis.T)
    predicted = diffusion.x0(small(x_t, t, small.condition(audio, keep), style), x_t, t)
    loss = objective(x0, predicted, coefficient_weights(scale, torch.ones_like(scale), 2.0), velocity=10.0)

    vertices_t = diffusion.add_noise(x0 @ basis, t, noise)
    skipped = vertices_t @ basis.T @ basis
    predicted = diffusion.x0(large(vertices_t, t, large.condition(audio, keep), style), skipped, t)
    # In metres: each mode at its own size, then the paper's formula as it stands, over the motion's variance.
    residual = ((x0 @ basis - predicted) @ basis.T * scale) @ basis
    change = residual[1:] - residual[:-1]
    vertex_loss = residual.square().sum(-1).mean() + 10.0 * change.square().sum(-1).mean()
    vertex_loss = vertex_loss / scale.square().sum()

    torch.testing.assert_close(vertex_loss, loss, atol=0, rtol=1e-9)
    loss.backward()
    vertex_loss.backward()
    gradients = {name: value.grad for name, value in large.named_parameters()}
    for name, parameter in small.named_parameters():
        found = gradients[name]
        assert found is not None and parameter.grad is not None
        if name == "encoder.weight":
            found = found @ basis.T
        elif name.startswith("decoder"):
            found = basis @ found
        torch.testing.assert_close(found, parameter.grad, atol=1e-9, rtol=1e-6)
