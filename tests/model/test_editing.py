"""Edits: what is kept returns, the rest is what the model makes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.checkpoint import Checkpoint
from model.editing import Kept, edit, seam_of, with_frames
from model.errors import ModelError
from model.motion import Motion
from model.network import HALO
from model.synthesis import Keep, synthesize
from tests.model import talker

N, FAST = 60, 5


@pytest.fixture(scope="module")
def toy() -> Checkpoint:
    return talker.shaken(talker.checkpoint([talker.sequence(200, 0)]))


def motion_of(toy: Checkpoint, seed: int = 5, basis_seed: int = 0) -> Motion:
    """Centimetres of motion on a template of its own, in the toy's basis (seed 0) or in one it does not hold."""
    template = np.random.default_rng(seed).standard_normal((talker.D, 3)).astype(np.float32)
    coefficients = talker.sequence(N, seed).coefficients
    return Motion(
        30.0, 2.5, template, toy.faces, talker.basis(basis_seed), coefficients, np.ones(N, bool), {"a": 1}
    )


def features(seed: int = 1) -> np.ndarray:
    return talker.sequence(N, seed).features


def spans(*frames: int | slice) -> np.ndarray:
    mask = np.zeros(N, bool)
    for frame in frames:
        mask[frame] = True
    return mask


@pytest.mark.parametrize("basis_seed", [0, 3])
def test_kept_frames_return_to_a_micrometre(toy: Checkpoint, basis_seed: int) -> None:
    motion = motion_of(toy, basis_seed=basis_seed)
    kept = Kept(motion, spans(slice(0, 6), 30, slice(-6, None)))
    for edited in edit(toy, features(), kept, samples=2, steps=FAST):
        found, truth = edited.displacements(), motion.displacements()
        np.testing.assert_allclose(found[kept.frames], truth[kept.frames], atol=1e-6)
        assert np.abs(found - truth)[~kept.frames].max() > 1e-3
        assert edited.valid.all() and edited.start_s == 2.5 and edited.template is motion.template
    if basis_seed == 0:
        assert np.array_equal(edited.basis, toy.basis)
        assert np.array_equal(edited.coefficients[kept.frames], motion.coefficients[kept.frames])


@pytest.mark.parametrize("basis_seed", [0, 3])
def test_kept_vertices_return_to_a_micrometre(toy: Checkpoint, basis_seed: int) -> None:
    motion = motion_of(toy, basis_seed=basis_seed)
    share = np.zeros(talker.D, np.float32)
    share[:7], share[7] = 1, 0.5
    kept = Kept(motion, spans(slice(0, 6)), share)
    edited = edit(toy, features(), kept, steps=FAST)[0]
    found, truth = edited.displacements(), motion.displacements()
    np.testing.assert_allclose(found[:, :7], truth[:, :7], atol=1e-6)
    np.testing.assert_allclose(found[:6], truth[:6], atol=1e-6)
    assert np.abs(found - truth)[6:, 8:].max() > 1e-3
    # The free vertices are what one prediction of the model gives: a face of the basis.
    free = toy.basis[:, 8:].reshape(talker.K, -1)
    made = found[6:, 8:].reshape(N - 6, -1)
    solution = np.linalg.lstsq(free.T, made.T, rcond=None)[0]
    np.testing.assert_allclose(solution.T @ free, made, atol=1e-6)
    flat = edited.basis.reshape(len(edited.basis), -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(flat)), atol=1e-5)


def test_an_edited_file_can_be_edited_again(toy: Checkpoint, tmp_path: Path) -> None:
    share = np.zeros(talker.D, np.float32)
    share[:7] = 1
    once = edit(toy, features(), Kept(motion_of(toy), spans(), share), steps=FAST)[0]
    once.save(tmp_path / "motion.npz")
    read = Motion.load(tmp_path / "motion.npz")
    twice = edit(toy, features(2), Kept(read, spans(slice(0, 9)), share), steps=FAST)[0]
    np.testing.assert_allclose(twice.displacements()[:9], once.displacements()[:9], atol=1e-6)
    np.testing.assert_allclose(twice.displacements()[:, :7], once.displacements()[:, :7], atol=1e-6)
    assert len(once.basis) == len(twice.basis) == 2 * talker.K  # no growth from edit to edit


def test_all_shares_at_one_are_whole_frames(toy: Checkpoint) -> None:
    motion, frames = motion_of(toy), spans(slice(0, 20))
    motion = replace(motion, valid=frames)
    whole = edit(toy, features(), Kept(motion, frames), steps=FAST)[0]
    share = np.ones(talker.D, np.float32)
    parts = edit(toy, features(), Kept(motion, spans(), share), steps=FAST)[0]
    np.testing.assert_allclose(parts.displacements(), whole.displacements(), atol=1e-6)


def test_unseen_frames_are_made_anew(toy: Checkpoint) -> None:
    motion = motion_of(toy)
    coefficients, valid = motion.coefficients.copy(), ~spans(slice(20, 30))
    coefficients[20:30] = np.nan
    unseen = replace(motion, coefficients=coefficients, valid=valid)
    edited = edit(toy, features(), Kept(unseen, valid), steps=FAST)[0]
    assert np.isfinite(edited.coefficients).all() and edited.valid.all()
    share = np.ones(talker.D, np.float32)
    assert np.isfinite(edit(toy, features(), Kept(unseen, spans(), share), steps=FAST)[0].coefficients).all()


@pytest.mark.parametrize("share", [None, 0.6])
def test_guidance_one_is_the_conditional_chain(toy: Checkpoint, share: float | None) -> None:
    motion, frames = motion_of(toy), spans(slice(0, 9), 40)
    shares = None if share is None else np.full(talker.D, share, np.float32)
    guided = edit(toy, features(), Kept(motion, frames, shares), guidance=1.0, steps=FAST, seed=4)[0]

    network, diffusion, fit = toy.model(), toy.diffusion(), toy.standardization
    condition = network.condition(fit.audio(features())[:, None])
    known = motion.coefficients

    def conditional(x: torch.Tensor, t: int) -> torch.Tensor:
        step = torch.tensor(t)
        return diffusion.x0(network(x, step, condition, torch.tensor(0)), x, step)

    def overwrite(x0: torch.Tensor) -> torch.Tensor:
        c = fit.metres(x0[:, 0])
        if share is not None:
            c = share * known + (1 - share) * c  # a share equal everywhere commutes with the basis
        return fit.motion(np.where(frames[:, None], known, c))[:, None]

    with torch.inference_mode():
        generator = torch.Generator().manual_seed(4)
        x = diffusion.sample(
            conditional, (N, 1, talker.K), generator, "posterior", FAST, overwrite, progress=None
        )
        expected = fit.metres(overwrite(x)[:, 0])
    expected = np.tensordot(expected, toy.basis, axes=1)
    np.testing.assert_allclose(guided.displacements(), expected, atol=1e-6)


def test_unconditional_edits_do_not_hear(toy: Checkpoint) -> None:
    kept = Kept(motion_of(toy), spans(slice(0, 6), slice(-6, None)))

    def made(audio: np.ndarray | None, guidance: float | None) -> np.ndarray:
        return edit(toy, audio, kept, guidance=guidance, steps=FAST)[0].coefficients

    assert np.array_equal(made(features(1), 0.0), made(features(2), 0.0))
    assert np.array_equal(made(features(1), 0.0), made(None, None))
    assert not np.allclose(made(features(1), 0.5), made(features(2), 0.5))


def test_an_even_shift_shifts_the_result(toy: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> None:
    """Audio, noise and what is kept 14 frames earlier: so is the result, where no border is in sight."""
    length, shift = 200, 14
    audio, known = talker.sequence(length, 1).features, talker.sequence(length, 5).coefficients
    noise = torch.randn(FAST + 1, length, 1, talker.K, generator=torch.Generator().manual_seed(0))
    whole, partly = np.zeros(length, bool), np.zeros(length, bool)
    whole[[70, 100, 101]], partly[110:130] = True, True
    share = np.random.default_rng(0).random(talker.D).astype(np.float32)

    def made(first: int) -> np.ndarray:
        draws = iter(noise[:, first : first + length - shift])
        monkeypatch.setattr(torch, "randn", lambda *_, **__: next(draws).clone())
        rows = slice(first, first + length - shift)
        template = np.zeros((talker.D, 3), np.float32)
        motion = Motion(30, 0, template, toy.faces, toy.basis, known[rows], (whole | partly)[rows])
        return edit(toy, audio[rows], Kept(motion, whole[rows], share), steps=FAST)[0].displacements()

    edge = HALO * FAST
    np.testing.assert_allclose(made(0)[shift:][edge:-edge], made(shift)[:-shift][edge:-edge], atol=1e-6)


@pytest.mark.parametrize("basis_seed", [0, 3])
def test_keyframes_from_another_motion(toy: Checkpoint, basis_seed: int) -> None:
    motion, other = motion_of(toy), motion_of(toy, seed=8, basis_seed=basis_seed)
    keyframes = spans(12, 13, 40)
    joined = with_frames(motion, other, keyframes, np.array([0, 1, 59]))
    edited = edit(toy, features(), Kept(joined, spans(slice(0, 6)) | keyframes), steps=FAST)[0]
    found, theirs = edited.displacements(), other.displacements()
    np.testing.assert_allclose(found[[12, 13, 40]], theirs[[0, 1, 59]], atol=1e-6)
    np.testing.assert_allclose(found[:6], motion.displacements()[:6], atol=1e-6)


def test_seam_of_an_untouched_and_of_a_torn_motion(toy: Checkpoint) -> None:
    motion, frames = motion_of(toy), spans(slice(0, 30))
    face = talker.REGIONS["face"]
    assert 0 < seam_of(motion, frames, motion, face) < 1.2
    coefficients = motion.coefficients.copy()
    coefficients[30:] += 0.05
    assert seam_of(replace(motion, coefficients=coefficients), frames, motion, face) > 3


def test_with_nothing_to_keep_parts_of_the_face_are_no_matter(toy: Checkpoint) -> None:
    share = np.zeros(talker.D, np.float32)
    share[:7] = 1
    motion = motion_of(toy)
    whole = edit(toy, features(), Kept(motion, np.ones(N, bool), share), steps=FAST)[0]
    np.testing.assert_allclose(whole.displacements(), motion.displacements(), atol=1e-6)
    unseen = replace(motion, valid=spans())
    free = edit(toy, features(), Kept(unseen, spans(), share), steps=FAST)[0]
    anew = edit(toy, features(), Kept(unseen, spans()), steps=FAST)[0]
    np.testing.assert_allclose(free.displacements(), anew.displacements(), atol=1e-6)


def test_refusals(toy: Checkpoint) -> None:
    motion = motion_of(toy)
    other_mesh = replace(motion, faces=motion.faces[1:])
    with pytest.raises(ModelError, match="mesh topology"):
        edit(toy, features(), Kept(other_mesh, spans()))
    with pytest.raises(ModelError, match="same mesh"):
        with_frames(motion, other_mesh, spans(1), np.array([1]))
    with pytest.raises(ModelError, match="25 frames a second"):
        edit(toy, features(), Kept(replace(motion, fps=25.0), spans()))
    with pytest.raises(ModelError, match="was seen"):
        edit(toy, features(), Kept(replace(motion, valid=spans()), spans(3)))
    with pytest.raises(ModelError, match="5 shares"):
        edit(toy, features(), Kept(motion, spans(), np.ones(5, np.float32)))
    with pytest.raises(ModelError, match="kept motion"):
        edit(toy, features()[1:], Kept(motion, spans()))


def test_keeping_everything_needs_no_model(toy: Checkpoint) -> None:
    motion = motion_of(toy)
    everything = np.ones(N, bool)
    drawn = synthesize(toy, features(), keep=Keep(motion.coefficients, everything), steps=FAST)
    assert np.array_equal(drawn[0], motion.coefficients)
