"""Personalization: the start says what the base says; choices follow the validation figures."""

from pathlib import Path

import numpy as np
import pytest

from model.architectures import ARCHITECTURES
from model.checkpoint import Checkpoint
from model.dataset import Standardization
from model.finetuning import SWEEP, choose_checkpoint, subject_of, sweep_guidance
from model.synthesis import synthesize
from tests.model import talker


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_the_subject_starts_where_the_base_stands(architecture: str) -> None:
    """Another scale of the coefficients goes into the weights: with the same motion in metres, the same metres."""
    sequences = [talker.sequence(120, seed) for seed in range(3)]
    base = talker.shaken(talker.checkpoint(sequences, architecture=architecture))
    subject = subject_of(base, "anna", sequences, {})
    assert subject.config.architecture == architecture
    assert subject.kind == "subject" and subject.styles == ("person0", "anna")
    assert np.allclose(subject.standardization.scale, base.standardization.scale)
    features = sequences[0].features[:40]
    ours = synthesize(subject, features, samples=2, seed=1, steps=50)
    theirs = synthesize(base, features, samples=2, seed=1, steps=50)
    assert np.allclose(ours, theirs, atol=1e-6)


def test_the_scale_is_the_subjects_own() -> None:
    base = talker.checkpoint([talker.sequence(120, 0)])
    calm = talker.sequence(120, 1)
    calm = type(calm)(calm.coefficients * 0.25, calm.features, calm.valid, 1)
    subject = subject_of(base, "calm", [calm], {})
    assert np.allclose(subject.standardization.scale, Standardization.of([calm]).scale)
    assert np.array_equal(subject.standardization.audio_scale, base.standardization.audio_scale)


def test_the_candidate_that_is_nearest_on_validation_is_chosen(tmp_path: Path) -> None:
    sequences = [talker.sequence(90, 0)]
    paths = []
    for index, size in enumerate((0.5, 0.0, 0.9)):
        checkpoint = talker.shaken(talker.checkpoint(sequences), seed=index)
        scaled = {name: value * size for name, value in checkpoint.ema.items()}
        paths.append(tmp_path / f"{index}.safetensors")
        checkpoint.with_weights(checkpoint.network, scaled).save(paths[-1])
    best, errors = choose_checkpoint(paths, sequences, seed=0)
    index = int(np.argmin(errors))
    assert len(errors) == 3 and min(errors) < max(errors)
    size = (0.5, 0.0, 0.9)[index]
    expected = talker.shaken(talker.checkpoint(sequences), seed=index).ema["encoder.weight"] * size
    assert np.allclose(best.ema["encoder.weight"], expected)
    first, _ = choose_checkpoint(paths, sequences, seed=0, tolerance=2 * errors[0] / min(errors))
    assert np.allclose(first.ema["encoder.weight"], Checkpoint.load(paths[0]).ema["encoder.weight"])


def test_the_sweep_has_a_row_a_scale_and_keeps_to_the_best_synchrony() -> None:
    sequences = [talker.sequence(60, 0)]
    sweep, chosen = sweep_guidance(talker.shaken(talker.checkpoint(sequences)), sequences, seed=0)
    assert [row["s"] for row in sweep] == list(SWEEP)
    assert set(sweep[0]) == {"s", "lip_sync", "lip_max", "l2_lip", "l2_face", "div_e"}
    by_scale = {row["s"]: row["lip_sync"] for row in sweep}
    assert by_scale[chosen] <= 1.05 * min(by_scale.values())
    assert all(by_scale[s] > 1.05 * min(by_scale.values()) for s in SWEEP if s < chosen)
    assert sweep[0]["div_e"] == pytest.approx(sweep[0]["div_e"])
