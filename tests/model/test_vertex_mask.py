"""Keeping single vertices in K dimensions is the vertex-space chain: compared with one written out, in float64."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from model.dataset import Standardization
from model.diffusion import RULES, Diffusion, Predict, Rule
from model.motion import Motion
from model.synthesis import Guided, Keep
from model.vertex_mask import VertexMask
from tests.model import talker

N, STEPS, SAMPLES = 40, 12, 2
# Orthonormal in float64, so that what remains is the float32 of whole frames' standardization.
BASIS = np.linalg.qr(talker.basis().reshape(talker.K, -1).T.astype(np.float64))[0].T.reshape(
    talker.K, talker.D, 3
)


@pytest.fixture(autouse=True)
def double() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def foreign_motion(seed: int = 7) -> Motion:
    """N frames of the toy's mesh that the toy's basis does not hold."""
    random = np.random.default_rng(seed)
    coefficients = 0.02 * random.standard_normal((N, talker.K)).astype(np.float32)
    template = np.zeros((talker.D, 3), np.float32)
    return Motion(30.0, 0.0, template, talker.FACES, talker.basis(seed), coefficients, np.ones(N, bool))


def vertex_chain(
    predict: Predict,
    diffusion: Diffusion,
    fit: Standardization,
    share: np.ndarray,
    known: np.ndarray,
    rule: Rule,
    seed: int,
) -> np.ndarray:
    """The whole chain over displacements [N, S, 3D] m, as the paper has it; share and known [N, 1, 3D].

    Its noise is the one of the K coefficients, and as much again outside their span.
    """
    B = torch.from_numpy(BASIS.reshape(talker.K, -1)).double()
    mean, scale = (torch.from_numpy(v).double() for v in (fit.mean, fit.scale))
    m, known = torch.from_numpy(share), torch.from_numpy(known)
    inside, outside = (torch.Generator().manual_seed(s) for s in (seed, 99))

    def noise() -> torch.Tensor:
        shape = (N, SAMPLES)
        free = 0.02 * torch.randn(*shape, 3 * talker.D, generator=outside)
        return (scale * torch.randn(*shape, talker.K, generator=inside)) @ B + free - free @ B.T @ B

    x = noise()
    times = diffusion.times(STEPS, rule)
    for t, s in zip(times, [*times[1:], -1]):
        x0 = m * known + (1 - m) * ((mean + scale * predict(x @ B.T / scale, t)) @ B) - mean @ B
        if s < 0:
            break
        now, then = (float(diffusion.alphas[step]) for step in (t, s))
        if rule == "ddim":
            x = math.sqrt(then) * x0 + math.sqrt((1 - then) / (1 - now)) * (x - math.sqrt(now) * x0)
        elif rule == "renoise":
            x = math.sqrt(then) * x0 + math.sqrt(1 - then) * noise()
        else:
            beta = 1 - now / then
            middle = math.sqrt(then) * beta * x0 + math.sqrt(1 - beta) * (1 - then) * x
            x = middle / (1 - now) + math.sqrt((1 - then) / (1 - now) * beta) * noise()
    return (x0 + mean @ B).numpy()


@pytest.mark.parametrize("parametrization", ["skip", "plain"])
@pytest.mark.parametrize("rule", RULES)
def test_masked_vertices_equal_the_vertex_space_chain(rule: Rule, parametrization: str) -> None:
    toy = talker.shaken(talker.checkpoint([talker.sequence(200, 0)], parametrization))
    fit, diffusion = toy.standardization, toy.diffusion()
    audio = torch.from_numpy(talker.sequence(N, 1).features).double()
    predict = Guided(toy.model().double(), diffusion, audio, 0, 0.7, chunk=64)
    known = foreign_motion()
    flat = known.displacements().reshape(N, 1, -1).astype(np.float64)
    share = np.random.default_rng(3).random(talker.D)
    share[:8], share[8:12] = 1, 0  # kept, free, and soft ones
    whole, partly = np.zeros(N, bool), np.zeros(N, bool)
    whole[[0, 1, 20]], partly[5:35] = True, True
    partly &= ~whole
    m = np.where(whole[:, None], 1.0, np.where(partly[:, None], np.repeat(share, 3), 0.0))[:, None]

    truth = vertex_chain(predict, diffusion, fit, m, flat, rule, seed=5)
    B = BASIS.reshape(talker.K, -1).astype(np.float64)
    keep = Keep(flat[:, 0] @ B.T, whole, VertexMask.of(BASIS, share, known, partly))
    generator = torch.Generator().manual_seed(5)
    shape = (N, SAMPLES, talker.K)
    z = diffusion.sample(predict, shape, generator, rule, STEPS, keep.overwrite(fit)).numpy()
    found = m * flat + (1 - m) * ((fit.mean + fit.scale * z) @ B)

    np.testing.assert_allclose(found, truth, atol=1e-9)
    untouched = diffusion.sample(predict, shape, torch.Generator().manual_seed(5), rule, STEPS).numpy()
    assert np.abs(z - untouched).max() > 0.01  # the mask does matter


def test_shares_of_nothing_and_of_everything() -> None:
    known, frames = foreign_motion(), np.ones(N, bool)
    x0 = torch.randn(N + 1, SAMPLES, talker.K)
    fit = talker.checkpoint([talker.sequence(200, 0)]).standardization

    def through(share: float) -> torch.Tensor:
        shares = np.full(talker.D, share)
        return VertexMask.of(BASIS, shares, known, frames).overwrite(fit)(x0)

    torch.testing.assert_close(through(0.0), x0, atol=1e-5, rtol=0)
    projected = known.displacements().reshape(N, -1) @ BASIS.reshape(talker.K, -1).T
    expected = fit.motion(projected).double()[:, None].expand(-1, SAMPLES, -1)
    torch.testing.assert_close(through(1.0)[:N], expected, atol=1e-4, rtol=0)
    assert torch.equal(through(1.0)[N:], x0[N:])
