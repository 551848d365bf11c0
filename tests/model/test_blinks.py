"""Blinks: found where they are, taken out of the motion whole, and given back as often but at any moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.blinks import USUAL_BLINKS, USUAL_FRAMES, at_random, blink_spans, independent_blinks
from model.checkpoint import Checkpoint
from model.dataset import Crops, Sequence
from model.metrics import EYELIDS, eyelid_opening_mm
from tests.model import talker

OPEN_MM = 10.0
CLOSING = np.array(
    [0, 0.2, 0.7, 1.0, 0.8, 0.5, 0.2, 0.05, 0]
)  # share of a blink, as real ones go: shut fast, open slowly
AT = (40, 120, 200)


def eyes() -> tuple[Checkpoint, np.ndarray]:
    """A mesh whose vertices 6-9 are upper and lower lids of two eyes, and mode 0 [K] m that shuts them by 1 mm."""
    basis = talker.basis()
    lids = np.arange(6, 10)
    basis[:, lids] = 0
    basis[0] = 0
    basis[0, [6, 8], 1] = -np.sqrt(0.5)
    basis[1:] = np.linalg.qr(basis[1:].reshape(talker.K - 1, -1).T)[0].T.reshape(talker.K - 1, talker.D, 3)
    template = np.full((talker.D, 3), 0.1, np.float32)
    template[lids] = [[0.03, y, 0] for y in (OPEN_MM / 1000, 0, OPEN_MM / 1000, 0)]
    rims = {name: np.array([6 + i]) for i, name in enumerate(name for pair in EYELIDS for name in pair)}
    made = talker.checkpoint([talker.sequence(60, 0)], styles=2)
    checkpoint = replace(made, basis=basis, template=template, regions=made.regions | rims)
    return checkpoint, np.eye(talker.K, dtype=np.float32)[0] * 0.001 * np.sqrt(2)


def blinking(frames: int = 300, style: int = 0) -> Sequence:
    _, shut = eyes()
    sequence = talker.sequence(frames, 3, style)
    sequence.coefficients[:, 0] = 0
    for first in AT:
        sequence.coefficients[first : first + len(CLOSING)] += 0.9 * OPEN_MM * CLOSING[:, None] * shut
    return sequence


def opening(checkpoint: Checkpoint, coefficients: np.ndarray) -> np.ndarray:
    return eyelid_opening_mm(checkpoint.template, checkpoint.basis, checkpoint.regions, coefficients)


def test_opening_of_the_eyes_by_hand() -> None:
    """Lids 10 mm apart at rest; one eye's upper lid comes down by 4 mm: the mean of both eyes is 8."""
    checkpoint, shut = eyes()
    assert opening(checkpoint, 0 * shut) == pytest.approx(OPEN_MM)
    assert opening(checkpoint, np.stack([3 * shut, OPEN_MM * shut])) == pytest.approx([7.0, 0.0], abs=1e-4)
    one = checkpoint.template.copy()
    one[6, 1] -= 0.004
    assert opening(replace(checkpoint, template=one), 0 * shut) == pytest.approx(8.0)


def test_a_blink_is_found_from_its_first_frame_to_its_last() -> None:
    curve, valid = np.full(400, OPEN_MM), np.ones(400, bool)
    for first in (30, 100, 395):  # the last one does not end
        part = curve[first : first + len(CLOSING)]
        part -= 9 * CLOSING[: len(part)]
    curve[150:180] = 4  # looks down
    curve[200:205] -= 2  # narrows its eyes
    curve[300:303] -= 9  # into a cut
    valid[303:306] = False
    spans = blink_spans(curve.astype(np.float32), valid)
    assert [(s.start, s.stop) for s in spans] == [(30, 39), (100, 109)]
    assert blink_spans(curve.astype(np.float32), np.zeros(400, bool)) == []


def test_what_is_left_has_open_eyes_and_all_else() -> None:
    checkpoint, _ = eyes()
    sequence = blinking()
    before = sequence.coefficients.copy()
    (left,), drawn = independent_blinks(checkpoint, [sequence], 0)
    assert drawn is not None and drawn.shape[0] == 2 and not drawn[1].any()
    assert opening(checkpoint, before).min() < 1.1
    assert opening(checkpoint, left.coefficients).min() > 0.9 * OPEN_MM
    np.testing.assert_allclose(left.coefficients[:, 1:], before[:, 1:], atol=1e-7)
    np.testing.assert_array_equal(sequence.coefficients, before)
    np.testing.assert_allclose(drawn[0, :, 1:], 0, atol=1e-7)
    depth = 1000 * drawn[0, :, 0].max() / np.sqrt(2)
    assert depth == pytest.approx(0.9 * OPEN_MM, rel=0.05)


def test_as_often_and_at_other_moments() -> None:
    checkpoint, _ = eyes()
    counts, rate = [], (len(AT) + USUAL_BLINKS) / (300 + USUAL_FRAMES)
    for seed in range(8):
        _, drawn = independent_blinks(checkpoint, [blinking()], seed)
        shut = drawn[0, :, 0] > 0.5 * drawn[0].max()
        counts.append(int((shut[1:] & ~shut[:-1]).sum()))
    assert np.mean(counts) == pytest.approx(len(drawn[0]) * rate, rel=0.05)
    assert len(set(counts)) > 1
    often = at_random([np.ones((9, 1), np.float32)], 3.0, 1000, np.random.default_rng(0))
    assert 0.5 < often.mean() < 1  # more often than they fit: no endless loop


def test_each_style_has_its_own() -> None:
    checkpoint, _ = eyes()
    sequences = [blinking(style=1), talker.sequence(60, 0)]
    sequences[1].coefficients[:, 0] = 0
    opened, drawn = independent_blinks(checkpoint, sequences, 0)
    crops = Crops(opened, checkpoint.standardization, 30, blinks=drawn)
    plain = Crops(opened, checkpoint.standardization, 30)
    generator, again = torch.Generator().manual_seed(0), torch.Generator().manual_seed(0)
    ours, theirs = crops.draw(500, generator), plain.draw(500, again)
    assert torch.equal(ours.style, theirs.style) and torch.equal(ours.audio, theirs.audio)
    changed = (ours.motion != theirs.motion).any(0).any(-1)
    assert not changed[ours.style == 0].any()
    assert 0.2 < changed[ours.style == 1].float().mean() < 0.8


def test_nothing_to_be_found() -> None:
    checkpoint, _ = eyes()
    still = talker.sequence(60, 0)
    still.coefficients[:, 0] = 0
    assert independent_blinks(checkpoint, [still], 0)[1] is None
    lidless = replace(checkpoint, regions=talker.REGIONS)
    (same,), drawn = independent_blinks(lidless, [blinking()], 0)
    assert drawn is None
    np.testing.assert_array_equal(same.coefficients, blinking().coefficients)


def test_nothing_goes_into_what_hardly_moves() -> None:
    checkpoint, _ = eyes()
    spread = np.ones(talker.K, np.float32)
    spread[0] = 0.1
    hardly = replace(checkpoint, standardization=replace(checkpoint.standardization, spread=spread))
    _, drawn = independent_blinks(hardly, [blinking()], 0)
    assert drawn is None or not drawn[..., 0].any()
