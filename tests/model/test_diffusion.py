"""Schedules, the x0 parametrizations, and the three reverse rules."""

from __future__ import annotations

import math

import pytest
import torch

from model.diffusion import RULES, Diffusion, Rule
from model.errors import ModelError


def test_cosine_schedule_constants() -> None:
    """abar_t = cos^2((t/T + .008) / 1.008 * pi/2), normalized at 0; T = 500."""
    alphas = Diffusion("cosine").alphas
    pinned = {0: 0.9999126, 124: 0.8470122, 249: 0.4938436, 374: 0.1442721}
    for t, value in pinned.items():
        by_hand = math.cos(((t + 1) / 500 + 0.008) / 1.008 * math.pi / 2) ** 2
        assert float(alphas[t]) == pytest.approx(
            by_hand / math.cos(0.008 / 1.008 * math.pi / 2) ** 2, rel=1e-9
        )
        assert float(alphas[t]) == pytest.approx(value, abs=1e-6)
    # beta of the last step is clipped at .999.
    assert float(alphas[499] / alphas[498]) == pytest.approx(0.001)


def test_linear_schedule_constants() -> None:
    alphas = Diffusion("linear").alphas
    assert float(alphas[0]) == pytest.approx(1 - 2e-4)
    assert float(alphas[499] / alphas[498]) == pytest.approx(1 - 0.04)
    assert float(alphas[499]) < 1e-4


def test_noising_keeps_unit_variance() -> None:
    diffusion, generator = Diffusion(), torch.Generator().manual_seed(0)
    x0, noise = torch.randn(2, 1000, 500, 1, generator=generator)
    x_t = diffusion.add_noise(x0, torch.arange(500), noise)
    assert torch.allclose(x_t.var(dim=0), torch.ones(500, 1), atol=0.2)


def test_skip_algebra() -> None:
    """With x_t = a x0 + s eps, x0hat = x0 exactly where F = s x0 - a eps; plain is the output itself."""
    x0, noise = torch.randn(2, 8, 500, 3, generator=torch.Generator().manual_seed(0))
    t = torch.arange(500)
    skip, plain = Diffusion(parametrization="skip"), Diffusion(parametrization="plain")
    x_t = skip.add_noise(x0, t, noise)
    a, s = (skip.alphas.sqrt()[:, None].float(), (1 - skip.alphas).sqrt()[:, None].float())
    torch.testing.assert_close(skip.x0(s * x0 - a * noise, x_t, t), x0, atol=1e-5, rtol=0)
    assert plain.x0(noise, x_t, t) is noise


def test_skip_is_the_best_linear_guess_for_data_of_any_spread() -> None:
    spread = torch.tensor([0.1, 0.5, 1.0])
    diffusion, generator = Diffusion(spread=spread), torch.Generator().manual_seed(0)
    x0 = spread * torch.randn(20_000, 3, generator=generator)
    noise = torch.randn(x0.shape, generator=generator)
    for t in (20, 250, 450):
        x_t = diffusion.add_noise(x0, torch.tensor(t), noise)
        guess = diffusion.x0(torch.zeros_like(x_t), x_t, torch.tensor(t))
        slope = (x0 * x_t).mean(0) / (x_t**2).mean(0)
        torch.testing.assert_close(guess[0] / x_t[0], slope, atol=0.02, rtol=0)
        gain = diffusion.x0(torch.ones_like(x_t), torch.zeros_like(x_t), torch.tensor(t))[0]
        torch.testing.assert_close((x0 - guess).std(0), gain, atol=0, rtol=0.03)


@pytest.mark.parametrize(("rule", "steps"), [("posterior", 500), ("renoise", 25), ("ddim", 50)])
def test_a_perfect_prediction_is_reached_in_the_rules_usual_steps(rule: Rule, steps: int) -> None:
    target, seen = torch.full((4, 2, 3), 0.7), []

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        seen.append(t)
        return target

    found = Diffusion().sample(predict, (4, 2, 3), torch.Generator().manual_seed(0), rule)
    assert torch.equal(found, target)
    assert len(seen) == steps and (seen[0], seen[-1]) == (499, 0) and sorted(seen, reverse=True) == seen


def test_renoise_does_not_run_away_with_a_guess_that_is_a_little_too_large() -> None:
    """A perfect prediction of N(0, 1), a tenth too large, as networks trained briefly or guided make it."""
    diffusion = Diffusion()
    x = diffusion.sample(
        lambda x, t: 1.1 * diffusion.alphas[t].sqrt().float() * x,
        (1000, 1),
        torch.Generator().manual_seed(0),
        "renoise",
    )
    assert 0.3 < float(x.std()) < 2


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("steps", [500, 100])
def test_reverse_chains_keep_the_distribution_of_a_gaussian(rule: Rule, steps: int) -> None:
    """For x0 ~ N(0, 1) the best x0hat is sqrt(abar) x_t; posterior and ddim then return N(0, 1).

    The paper's rule renews all noise at every step and with it what x_t knew: half of the variance remains.
    """
    diffusion = Diffusion()
    x = diffusion.sample(
        lambda x, t: diffusion.alphas[t].sqrt().float() * x,
        (4000, 1),
        torch.Generator().manual_seed(0),
        rule,
        steps,
    )
    assert float(x.var()) == pytest.approx(0.5 if rule == "renoise" else 1.0, abs=0.08)


def test_posterior_equals_the_textbook_formula() -> None:
    diffusion, t = Diffusion(), 250
    x_t, x0 = torch.randn(2, 6, 1, 2, generator=torch.Generator().manual_seed(0))
    noise = torch.randn(x_t.shape, generator=torch.Generator().manual_seed(5))
    found = diffusion.reverse(x_t, x0, t, t - 1, "posterior", torch.Generator().manual_seed(5))
    now, before = float(diffusion.alphas[t]), float(diffusion.alphas[t - 1])
    beta = 1 - now / before
    mean = math.sqrt(before) * beta / (1 - now) * x0 + math.sqrt(1 - beta) * (1 - before) / (1 - now) * x_t
    torch.testing.assert_close(found, mean + math.sqrt((1 - before) / (1 - now) * beta) * noise)


@pytest.mark.parametrize("steps", [0, 501])
def test_impossible_settings_are_refused(steps: int) -> None:
    generator = torch.Generator()
    with pytest.raises(ModelError, match=f"{steps} sampling steps"):
        Diffusion().sample(lambda x, t: x, (4, 1), generator, "ddim", steps)
    with pytest.raises(ModelError, match="posterior, renoise, ddim"):
        Diffusion().sample(lambda x, t: x, (4, 1), generator, "euler")  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="cosine, linear"):
        Diffusion("sigmoid")  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="skip, plain"):
        Diffusion(parametrization="eps")  # type: ignore[arg-type]
