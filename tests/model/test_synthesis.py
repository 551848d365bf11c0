"""Guided sampling: guidance, any length, chunks, frames that are kept, seeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from model import synthesis
from model.architectures import ARCHITECTURES
from model.checkpoint import Checkpoint
from model.errors import ModelError
from model.network import HALO
from model.synthesis import Guided, Keep, synthesize
from tests.model import talker

FAST = 6  # sampling steps


@pytest.fixture(scope="module", params=ARCHITECTURES)
def shaken(request: pytest.FixtureRequest) -> Checkpoint:
    untrained = talker.checkpoint([talker.sequence(200, 0)], styles=2, architecture=request.param)
    return talker.shaken(untrained)


def features(frames: int, seed: int = 1) -> np.ndarray:
    return talker.sequence(frames, seed).features


def test_guidance_one_is_the_conditional_model(shaken: Checkpoint) -> None:
    network, diffusion = shaken.model(), shaken.diffusion()
    audio = torch.from_numpy(features(40))
    x, step = torch.randn(40, 2, talker.K, generator=torch.Generator().manual_seed(0)), torch.tensor(100)
    conditional = diffusion.x0(network(x, step, network.condition(audio[:, None]), torch.tensor(1)), x, step)
    silent = network.condition(audio[:, None], keep=torch.zeros(1))
    unconditional = diffusion.x0(network(x, step, silent, torch.tensor(1)), x, step)

    def guided(s: float) -> torch.Tensor:
        return Guided(network, diffusion, audio, 1, s, chunk=64)(x, 100)

    torch.testing.assert_close(guided(1.0), conditional, atol=1e-5, rtol=0)
    torch.testing.assert_close(guided(0.0), unconditional, atol=1e-5, rtol=0)
    torch.testing.assert_close(
        guided(0.3), unconditional + 0.3 * (conditional - unconditional), atol=1e-5, rtol=0
    )


def test_guidance_zero_does_not_hear(shaken: Checkpoint) -> None:
    def drawn(s: float, seed: int) -> np.ndarray:
        return synthesize(shaken, features(40, seed), guidance=s, steps=FAST)

    assert np.array_equal(drawn(0.0, 1), drawn(0.0, 2))
    assert not np.allclose(drawn(0.5, 1), drawn(0.5, 2))


@pytest.mark.parametrize("rule", ["posterior", "renoise", "ddim"])
def test_chunks_equal_the_whole_bit_for_bit(
    shaken: Checkpoint, rule: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Convolutions do; attention adds up what it sees in another order, which may round otherwise."""
    audio = features(9 * 4 * HALO + 13)
    arguments = {"rule": rule, "steps": FAST, "samples": 2, "seed": 3}
    monkeypatch.setattr(synthesis, "CHUNK_ROWS", 10_000)
    whole = synthesize(shaken, audio, **arguments)  # type: ignore[arg-type]
    monkeypatch.setattr(synthesis, "CHUNK_ROWS", 4)  # chunks of 4 HALO
    chunked = synthesize(shaken, audio, **arguments)  # type: ignore[arg-type]
    tolerance = 0 if shaken.config.architecture == "conv" else 1e-6
    np.testing.assert_allclose(chunked, whole, rtol=0, atol=tolerance)


@pytest.mark.parametrize("frames", [1, 2, 3, 5, 31, 600])
def test_any_length(shaken: Checkpoint, frames: int) -> None:
    motion = synthesize(shaken, features(frames), steps=3, samples=2)
    assert motion.shape == (2, frames, talker.K) and motion.dtype == np.float32
    assert np.isfinite(motion).all()


def test_the_seed_decides(shaken: Checkpoint) -> None:
    def drawn(seed: int) -> np.ndarray:
        return synthesize(shaken, features(50), seed=seed, steps=FAST)

    assert np.array_equal(drawn(0), drawn(0))
    assert not np.allclose(drawn(0), drawn(1))


def test_styles_and_the_default_one(shaken: Checkpoint) -> None:
    def drawn(style: str | None) -> np.ndarray:
        return synthesize(shaken, features(50), style=style, steps=FAST)

    assert np.array_equal(drawn(None), drawn("person1"))
    assert not np.allclose(drawn("person0"), drawn("person1"))


def test_kept_frames_are_exact_and_the_rest_goes_on(shaken: Checkpoint) -> None:
    known = talker.sequence(41, 5).coefficients
    mask = np.zeros(41, bool)
    mask[:5], mask[20] = True, True
    kept = synthesize(shaken, features(41), steps=FAST, keep=Keep(known, mask))[0]
    np.testing.assert_allclose(kept[mask], known[mask], atol=1e-7)
    assert not np.allclose(kept[~mask], synthesize(shaken, features(41), steps=FAST)[0][~mask])


def test_single_coefficients_may_be_kept(shaken: Checkpoint) -> None:
    known = talker.sequence(41, 5).coefficients.copy()
    mask = np.zeros((41, talker.K), bool)
    mask[10:30, 2] = True
    known[~mask] = np.nan  # what is not kept need not be known
    kept = synthesize(shaken, features(41), steps=FAST, keep=Keep(known, mask))[0]
    np.testing.assert_allclose(kept[mask], known[mask], atol=1e-7)
    assert np.isfinite(kept).all()


def test_progress_is_told(shaken: Checkpoint) -> None:
    told: list[tuple[int, int]] = []
    synthesize(shaken, features(10), steps=3, progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_refusals(shaken: Checkpoint) -> None:
    with pytest.raises(ModelError, match=r"takes \[frames, 12\]"):
        synthesize(shaken, np.zeros((10, 13), np.float32))
    with pytest.raises(ModelError, match="takes"):
        synthesize(shaken, np.zeros((0, 12), np.float32))
    with pytest.raises(ModelError, match=r"'nobody'.*person0, person1"):
        synthesize(shaken, features(10), style="nobody")
    with pytest.raises(ModelError, match="at least one"):
        synthesize(shaken, features(10), samples=0)
    with pytest.raises(ModelError, match="rule 'euler'"):
        synthesize(shaken, features(10), rule="euler")  # type: ignore[arg-type]
    with pytest.raises(ModelError, match="kept motion"):
        synthesize(shaken, features(10), keep=Keep(np.zeros((9, talker.K), np.float32), np.ones(9, bool)))


def test_the_averaged_weights_are_the_ones_used(shaken: Checkpoint) -> None:
    other = replace(shaken, network={name: value * 0 for name, value in shaken.network.items()})
    assert np.array_equal(synthesize(other, features(10), steps=2), synthesize(shaken, features(10), steps=2))
