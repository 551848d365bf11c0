"""Sequences, their statistics, and crops that never cross what was not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.dataset import Crops, Sequence, Standardization
from model.errors import ModelError
from tests.model import talker


def numbered(frames: int, offset: int, style: int) -> Sequence:
    """Every coefficient and feature of a frame is its number."""
    number = np.arange(offset, offset + frames, dtype=np.float32)[:, None]
    return Sequence(number.repeat(talker.K, 1), number.repeat(talker.W, 1), np.ones(frames, bool), style)


def plain(coefficients: int, width: int) -> Standardization:
    motion, one, audio = np.zeros(coefficients), np.ones(coefficients), np.zeros(width)
    return Standardization(*(array.astype(np.float32) for array in (motion, one, one, audio, audio + 1)))


def test_crops_lie_inside_valid_runs_of_one_sequence() -> None:
    first, second = numbered(20, 0, style=0), numbered(15, 100, style=1)
    valid = first.valid.copy()
    valid[9] = False
    coefficients = first.coefficients.copy()
    coefficients[9] = np.nan
    crops = Crops(
        [replace(first, valid=valid, coefficients=coefficients), second], plain(talker.K, talker.W), 6
    )
    # 0-8: four starts, 10-19: five, 100-114: ten.
    assert len(crops) == 4 + 5 + 10
    batch = crops.draw(500, torch.Generator().manual_seed(0))
    frames = batch.motion[:, :, 0]
    assert torch.equal(frames, frames[0] + torch.arange(6.0)[:, None])
    assert torch.equal(batch.audio[:, :, 0], frames)
    assert set(frames[0].tolist()) == {0, 1, 2, 3, *range(10, 15), *range(100, 110)}
    assert torch.equal(batch.style, (frames[0] >= 100).long())


def test_standardized_motion_has_unit_variance_and_comes_back() -> None:
    sequence = talker.sequence(300, 0)
    standardization = Standardization.of([sequence])
    motion = standardization.motion(sequence.coefficients)
    torch.testing.assert_close(motion.std(dim=0, correction=0), torch.ones(talker.K), atol=1e-4, rtol=0)
    np.testing.assert_allclose(standardization.metres(motion), sequence.coefficients, atol=1e-7)


def test_a_still_coefficient_is_not_blown_up() -> None:
    sequence = talker.sequence(300, 0)
    coefficients = sequence.coefficients.copy()
    coefficients[:, -1] = 0
    scale = Standardization.of([replace(sequence, coefficients=coefficients)]).scale
    assert scale[-1] == pytest.approx(0.01 * scale.max())


def test_refusals() -> None:
    sequence = talker.sequence(40, 0)
    with pytest.raises(ModelError, match="as many frames"):
        replace(sequence, valid=np.ones(39, bool))
    with pytest.raises(ModelError, match="not finite"):
        replace(sequence, features=np.full_like(sequence.features, np.nan))
    with pytest.raises(ModelError, match="does not move"):
        Standardization.of([replace(sequence, coefficients=np.zeros_like(sequence.coefficients))])
    with pytest.raises(ModelError, match="nothing to learn"):
        Standardization.of([replace(sequence, valid=np.zeros(40, bool))])
    for valid in (np.arange(40) % 20 != 0, np.ones(40, bool)):
        with pytest.raises(ModelError, match="consecutive valid frames"):
            Crops([replace(sequence, valid=valid)], Standardization.of([sequence]), 41 if valid.all() else 30)
