"""The shipped base model and the shipped head: what the tracker can say, the motion can hold."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.checkpoint import Checkpoint
from personalize.subject_data import BASE_CHECKPOINT
from tools.widen_base import widened
from tracker.head import load_head
from tracker.modes import LIP_SHAPES

HEAD = load_head()


@pytest.fixture(scope="module")
def base() -> Checkpoint:
    return Checkpoint.load(BASE_CHECKPOINT)


def test_the_motion_basis_holds_every_shape_of_the_head(base: Checkpoint):
    basis = base.basis.reshape(len(base.basis), -1).astype(np.float64)
    np.testing.assert_allclose(basis @ basis.T, np.eye(len(basis)), atol=1e-6)
    shapes = HEAD.expression_basis.reshape(len(HEAD.expression_basis), -1)
    lost = shapes - (shapes @ basis.T) @ basis
    # Without their own modes the lips' profiles lose a third to a half of themselves: .5 to 1 mm of an open mouth.
    assert np.abs(lost).max() < 1e-5


def test_a_base_that_holds_all_stays_as_it_is(base: Checkpoint):
    assert widened(base, HEAD) is base


def test_a_widened_base_says_the_same_and_leaves_the_new_at_rest(base: Checkpoint):
    old = len(base.basis)
    bump = np.zeros((1, *HEAD.template.shape), np.float32)
    bump[0, HEAD.regions["scalp"], 1] = 0.01
    names = (*HEAD.expression_names, "bump")
    shapes = np.concatenate([HEAD.expression_basis, bump])
    wide = widened(base, replace(HEAD, expression_basis=shapes, expression_names=names))
    assert len(wide.basis) == old + 1 and len(LIP_SHAPES) + 52 == old
    np.testing.assert_array_equal(wide.basis[:old], base.basis)
    flat = wide.basis.reshape(old + 1, -1).astype(np.float64)
    np.testing.assert_allclose((bump.reshape(-1) @ flat.T) @ flat, bump.reshape(-1), atol=1e-6)
    generator = torch.Generator().manual_seed(0)
    noisy = torch.randn(30, 2, old + 1, generator=generator)
    audio = torch.randn(30, 2, base.config.audio_width, generator=generator)
    results = []
    for checkpoint, motion in ((base, noisy[..., :old]), (wide, noisy)):
        step, style = torch.tensor([100, 300]), torch.tensor([0, 3])
        with torch.no_grad():
            network = checkpoint.model()
            results.append(network(motion, step, network.condition(audio), style))
    torch.testing.assert_close(results[1][..., :old], results[0])
    assert not results[1][..., old:].any()
