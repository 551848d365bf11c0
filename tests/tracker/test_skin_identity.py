"""The identity from grey levels: derivatives, what tells nothing of it, and that it comes nearer to the truth."""

from dataclasses import replace
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest

from tests.tracker.test_photometric import HEAD, IDENTITY, energy_and_x  # noqa: F401
from tests.tracker.test_refine import filmed, freckled
from tracker import skin_identity
from tracker.appearance import HARMONICS
from tracker.photometric import PhotometricEnergy
from tracker.similarity import similarity
from tracker.skin_identity import SubjectEnergy, nearer_to_skin

Case = tuple[SubjectEnergy, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def case(energy_and_x: tuple[PhotometricEnergy, np.ndarray]) -> Case:  # noqa: F811
    """Two frames, of which each point is believed to another degree, an identity and what the frames show."""
    rng = np.random.default_rng(3)
    skin, x = energy_and_x
    corners = HEAD.faces[skin.skin.triangles]
    moves = np.einsum("pc,kpcx->pxk", skin.skin.barycentric, HEAD.identity_basis[:, corners])
    light, weight = rng.uniform(0.5, 1.5, (2, *skin.seen.shape))
    energy = SubjectEnergy(
        skin.landmarks, skin, moves.astype(np.float32), light.astype(np.float32), weight.astype(np.float32)
    )
    return energy, rng.normal(size=len(IDENTITY)) * 0.3, x


def test_gradient_by_the_identity_matches_finite_differences(case: Case):
    energy, identity, x = case
    count, step = len(identity), 1e-3
    gradient = energy.linearize(energy.shape(identity), x, with_identity=True).gradient[:, :count].sum(0)
    for k in (0, 7, 40):
        there, back = (
            energy.value(energy.shape(identity + sign * step * np.eye(count)[k]), x).sum() for sign in (1, -1)
        )
        assert gradient[k] == pytest.approx((there - back) / (2 * step), rel=0.02, abs=0.05)


def test_what_all_frames_show_alike_tells_nothing(case: Case):
    energy, identity, x = case
    same = energy.skin.view.grey[:1].repeat(2, 0)
    window = replace(energy.skin.view.window, origin=energy.skin.view.window.origin[:1].repeat(2, 0))
    skin = replace(energy.skin, view=replace(energy.skin.view, grey=same, window=window))
    alike = replace(energy, skin=skin, light=np.ones_like(energy.light))
    shape, once = alike.shape(identity), x[:1].repeat(2, 0)
    assert alike.skin_loss(shape, once).max() < 1e-6

    def told(by: SubjectEnergy, x: np.ndarray) -> float:
        of_landmarks = by.landmarks.linearize(by.landmarks.shape(identity), x, with_identity=True)
        whole = by.linearize(by.shape(identity), x, with_identity=True)
        return float(np.abs(whole.gradient - of_landmarks.gradient).max())

    # To the rounding of what frames tell that differ.
    assert told(alike, once) < 1e-7 * told(energy, x)


def test_light_and_albedo_at_a_place_explain_what_is_seen_there(case: Case):
    energy, identity, x = case
    basis = np.zeros((*energy.light.shape, HARMONICS), np.float32)
    basis[..., 0] = 1
    bright = replace(
        energy.skin.view,
        grey=np.stack([np.full_like(energy.skin.view.grey[0], 80), energy.skin.view.grey[0] * 0 + 120]),
    )
    found = SubjectEnergy.at(replace(energy.skin, view=bright), energy.moves, basis, identity, x)
    assert (found.light[1] / found.light[0]).mean() == pytest.approx(1.5, rel=1e-3)
    assert found.skin_loss(found.shape(identity), x).max() < 0.1


def test_a_strangers_face_comes_nearer_to_the_truth():
    stranger = np.random.default_rng(1).normal(size=len(IDENTITY)).astype(np.float32)
    film = filmed(freckled(), identity=stranger)

    def error_mm(identity: np.ndarray) -> float:
        rest = np.zeros(len(HEAD.expression_names), np.float32)
        found, true = (
            HEAD.vertices(one, rest)[HEAD.regions["face"]].astype(np.float64) for one in (identity, stranger)
        )
        scale, turned, shift = similarity(found, true)
        return 1e3 * float(np.linalg.norm(scale * found @ turned.T + shift - true, axis=1).mean())

    assert error_mm(film.refine().track.identity) < 0.8 * error_mm(film.track.identity)


@pytest.mark.parametrize(
    ("own", "others", "nearer"),
    [
        ((1, 3), (3, 2), 0.0),
        ((1, 2), (4, 2), 1.0),
        ((1, 2), (2, 1), 1.0),
        ((50, 51), (50, 51), 0.717),
        ((0, 0), (0, 0), 0.0),
    ],
)
def test_poses_are_judged_by_what_either_believes_of_the_light(
    own: tuple[int, int], others: tuple[int, int], nearer: float, monkeypatch: pytest.MonkeyPatch
):
    """Each looks best in the light that it was asked for. own, others: losses of both in the light of either."""
    x, other, rows = np.zeros((4, 3)), np.ones((4, 3)), np.array([1, 3])

    def at(skin: object, moves: object, basis: object, identity: object, where: np.ndarray) -> object:
        losses = own if not where.any() else others
        return Mock(skin_loss=lambda shape, place: np.full(2, losses[int(place.any())]))

    monkeypatch.setattr(SubjectEnergy, "at", at)
    monkeypatch.setattr(skin_identity, "_movements", lambda subject: np.zeros((5, 3, 2)))
    monkeypatch.setattr(skin_identity, "replace", lambda part, **_: part)
    monkeypatch.setattr(skin_identity, "solve_frames", lambda held, shape, x, *_, **__: x)
    subject = MagicMock(identity=np.zeros(2), blurs_px=[2.0, 1.0], skin=Mock(rest=np.zeros((5, 3))))
    subject.look.return_value = np.ones((2, 5)), None
    subject.energy.select.return_value.model.upper_face = np.zeros((4, 3))
    assert nearer_to_skin(subject, {1: None, 3: None}, rows, x, other) == pytest.approx(nearer, abs=1e-3)
