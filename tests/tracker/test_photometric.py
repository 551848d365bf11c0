"""The photometric energy's derivatives, and reading pictures between pixels."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.flame_factory import FakeFlame
from tests.tracker.test_flame import arrays, surface
from tests.tracker.test_view import whole
from tests.tracker.turning_head import first_hits
from tracker.appearance import (
    FACING,
    HARMONICS,
    appearance,
    frame_light,
    harmonics,
    seen_skin,
    shaded,
    skin_of,
)
from tracker.energy import POSE, Energy, Weights, landmark_model
from tracker.flame import flame_head
from tracker.halving import halved
from tracker.head import load_head
from tracker.modes import LIP_SHAPES
from tracker.photometric import PhotometricEnergy
from tracker.skin_fit import LEAST_NOISE, Photometry, Subject, grey_noise
from tracker.view import View, Window

HEAD = load_head()
MODEL = landmark_model(HEAD, Weights())
IDENTITY = np.zeros(len(HEAD.identity_basis), np.float32)
FOCAL, SIZE = 900.0, (400, 400)


def saddle(size: tuple[int, int], twist: float) -> np.ndarray:
    """A picture [h, w] that bilinear interpolation reproduces, without a kink between pixels."""
    y, x = np.mgrid[: size[1], : size[0]].astype(np.float32) / 100
    return 40 + 30 * x + 20 * y + twist * x * y


@pytest.fixture(scope="module")
def energy_and_x() -> tuple[PhotometricEnergy, np.ndarray]:
    rng = np.random.default_rng(0)
    frames = 2
    x = np.zeros((frames, MODEL.expressions + POSE))
    named = ~np.isin(HEAD.expression_names, LIP_SHAPES)  # the lips' profile stays ARKit's
    x[:, :-POSE][:, named] = rng.uniform(0.05, 0.3, (frames, named.sum()))
    x[:, -6:-3] = rng.normal(size=(frames, 3)) * 0.15
    x[:, -3:] = [0.005, -0.004, 0.7]
    landmarks = Energy(
        model=MODEL,
        weights=Weights(),
        focal=FOCAL,
        principal=np.array([320.0, 240.0]),
        observed=np.zeros((frames, len(MODEL.mean), 2)),
        px_per_m=np.full(frames, FOCAL / 0.7),
        visible=np.ones((frames, len(MODEL.mean))),
        strictness=np.ones(frames),
    )
    landmarks.observed[:] = landmarks.project(MODEL.mean, x) + rng.normal(size=landmarks.observed.shape)
    window = Window(np.array([[70.0, -10.0], [72.0, -11.0]]), 0.8, SIZE, whole(*SIZE, 2))
    grey = np.stack([saddle(SIZE, twist) for twist in (15.0, -12.0)])
    skin = skin_of(HEAD, MODEL, IDENTITY)
    energy = PhotometricEnergy(
        landmarks=landmarks,
        skin=skin,
        view=View(grey, window),
        expected=rng.uniform(60, 180, (frames, len(skin))).astype(np.float32),
        seen=(rng.uniform(size=(frames, len(skin))) > 0.3).astype(np.float32),
        noise=rng.uniform(15, 25, len(skin)).astype(np.float32),
        robust=2.0,
        pull=rng.normal(size=x.shape[1]),
    )
    return energy, x


def test_gradient_matches_finite_differences(energy_and_x):
    energy, x = energy_and_x
    analytic = energy.linearize(MODEL.mean, x)
    np.testing.assert_allclose(analytic.value, energy.value(MODEL.mean, x), rtol=1e-6)
    for column in range(x.shape[1]):
        step = np.zeros(x.shape[1])
        step[column] = 1e-3 if column < MODEL.expressions else 1e-4
        ends = [energy.value(MODEL.mean, x + sign * step) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * step[column])
        np.testing.assert_allclose(analytic.gradient[:, column], numeric, rtol=5e-3, atol=0.5)


def test_hessian_is_that_of_the_rows_of_seen_points(energy_and_x):
    energy, x = energy_and_x
    blind = replace(energy, seen=np.zeros_like(energy.seen))
    skin = energy.linearize_skin(x)
    np.testing.assert_allclose(skin.hessian, skin.hessian.transpose(0, 2, 1), rtol=1e-5, atol=1e-3)
    assert np.linalg.eigvalsh(skin.hessian).min() > -1e-3 * np.abs(skin.hessian).max()
    assert not blind.linearize_skin(x).hessian.any()
    assert not blind.linearize_skin(x).gradient.any()


def test_landmarks_and_skin_curve_the_energy_together(energy_and_x):
    energy, x = energy_and_x
    parts = energy.landmarks.linearize(MODEL.mean, x), energy.linearize_skin(x)
    whole = energy.linearize(MODEL.mean, x).hessian
    np.testing.assert_allclose(whole, sum(part.hessian for part in parts), rtol=1e-9)
    assert np.abs(parts[1].hessian).max() > 1e-3 * np.abs(parts[0].hessian).max()


def test_view_reads_a_ramp_exactly_and_is_flat_outside():
    ramp = (3 * np.arange(40)[None, :] + 2 * np.arange(30)[:, None]).astype(np.float32)
    view = View(ramp[None], Window(np.array([[100.0, 50.0]]), 0.5, (40, 30), whole(640, 640)))
    inside, outside = [120.3, 71.7], [90.0, 60.0]
    depth = 2.0
    points = [[depth * (x - 110) / 300, depth * (y - 60) / 300, depth] for x, y in (inside, outside)]
    value, slope = view.read(np.array([points], np.float32), 300.0, np.array([110.0, 60.0]))
    place = (np.array(inside) - [100, 50] + 0.5) * 0.5 - 0.5
    np.testing.assert_allclose(value[0, 0], 3 * place[0] + 2 * place[1], rtol=1e-5)
    per_m = 300 / depth
    along = -per_m / depth * (1.5 * points[0][0] + 1.0 * points[0][1])
    np.testing.assert_allclose(slope[0], [[1.5 * per_m, per_m, along], [0, 0, 0]], rtol=1e-5)


def test_window_cuts_what_lies_outside_as_its_border():
    rgb = np.zeros((20, 30, 3), np.uint8)
    rgb[:, :2] = 200
    inside = Window(np.array([[-6.0, 4.0]]), 1.0, (10, 8), whole(640, 640)).cut(rgb, 0)
    assert inside.shape == (8, 10)
    assert (inside[:, :8] == 200).all() and (inside[:, 8:] == 0).all()
    assert Window(np.array([[500.0, -90.0]]), 0.5, (10, 8), whole(640, 640)).cut(rgb, 0).shape == (8, 10)


@pytest.mark.parametrize("scale", [0.7, 0.5, 0.36, 0.23])
def test_a_cut_picture_shows_what_its_window_says_however_much_it_is_shrunk(scale: float):
    across, down = np.meshgrid(np.arange(700), np.arange(900))
    rgb = np.stack([0.2 * across + 0.1 * down] * 3, axis=-1).round().astype(np.uint8)
    window = Window(np.array([[31.0, 42.0]]), scale, (130, 150), whole(640, 640))
    places = [(np.arange(side) + 0.5) / scale - 0.5 for side in window.size]
    wanted = 0.2 * (places[0] + 31)[None, :] + 0.1 * (places[1] + 42)[:, None]
    error = window.cut(rgb, 0) - wanted
    # Half a pixel of the cut picture is what whole pixels of the other leave open, and halves of grey levels.
    assert np.abs(error).max() < 0.5 * 0.3 / scale + 0.7
    assert abs(error.mean()) < 0.25 * 0.3 / scale


def test_halved_pictures_are_means_of_blocks():
    rng = np.random.default_rng(3)
    picture = rng.uniform(0, 255, (43, 66, 3)).astype(np.float32)
    for times in range(4):
        block = 2**times
        height, width = 43 // block, 66 // block
        blocks = picture[: height * block, : width * block].reshape(height, block, width, block, 3)
        np.testing.assert_allclose(halved(picture, times), blocks.mean((1, 3)), rtol=1e-5)
    assert halved(picture[:3], 3).shape == (1, 8, 3)


def test_light_and_albedo_explain_what_they_made():
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(6, 500, 3)).astype(np.float32)
    normals[..., 2] = -np.abs(normals[..., 2]) - 0.5
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    basis = harmonics(normals)
    light = np.tile([120.0, 10, -20, -30, 5, 3, 0, 4, 2], (6, 1)) * rng.uniform(0.8, 1.2, (6, 1))
    grey = shaded(rng.uniform(0.5, 1.0, 500).astype(np.float32), basis, light)
    covered = grey.copy()
    covered[0, :40] = 250
    seen = np.ones_like(grey)
    albedo, usual = appearance(covered, basis, seen)
    found = shaded(albedo, basis[1:], frame_light(covered[1:], albedo, basis[1:], seen[1:], usual))
    assert light.shape == (6, HARMONICS)
    assert np.abs(found - grey[1:]).mean() < 1.5


def test_harmonics_are_nine_that_have_nothing_in_common():
    """Over directions spread evenly (a golden spiral)."""
    count = np.arange(4000) + 0.5
    z, turn = 1 - 2 * count / 4000, np.pi * (1 + 5**0.5) * count
    level = np.sqrt(1 - z**2)
    basis = harmonics(np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=-1).astype(np.float32))
    products = basis.T @ basis / 4000
    np.testing.assert_allclose(products - np.diag(np.diag(products)), 0, atol=2e-3)
    assert np.diag(products).min() > 0.05


def test_light_of_which_a_frame_tells_nothing_is_the_usual_one():
    rng = np.random.default_rng(4)
    normals = rng.normal(size=(1, 300, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    basis, albedo = harmonics(normals), rng.uniform(0.5, 1.0, 300).astype(np.float32)
    usual = np.array([120.0, 10, -20, -30, 5, 3, 0, 4, 2])
    grey = shaded(albedo, basis, 0.5 * usual[None])
    front = np.float32(normals[..., 2] < -0.9)
    np.testing.assert_allclose(frame_light(grey, albedo, basis, 0 * front, usual)[0], usual, rtol=1e-3)
    some = frame_light(grey, albedo, basis, front, usual)
    expected, turned_away = shaded(albedo, basis, some), normals[0, :, 2] > 0.5
    assert np.abs(expected - grey)[front > 0].max() < 1.5  # where it is seen, it is half as bright
    assert np.isfinite(expected).all() and np.abs(expected[0, turned_away]).max() < 255


def test_skin_is_seen_where_rays_meet_it_and_not_aslant():
    """Of a head turned by 40 degrees the nose hides cheek, and the far side lies aslant."""
    skin = skin_of(HEAD, MODEL, IDENTITY)
    turn = Rotation.from_euler("y", 40, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    vertices = ((HEAD.template - MODEL.centre) @ turn.T + [0, 0, 0.6]).astype(np.float32)
    principal, size = np.array([199.5, 199.5]), (400, 400)
    own = np.array([[0.0, 0.0], [399.0, 399.0]])
    seen, normal = seen_skin(skin, HEAD, vertices, FOCAL, principal, size, own)
    points = np.einsum("pc,pcx->px", skin.barycentric, vertices[HEAD.faces[skin.triangles]])
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    facing = -(normal * ray).sum(1)
    assert facing[seen].min() > FACING
    some = np.flatnonzero(facing > FACING + 0.05)[::8]
    behind = np.linalg.norm(points[some], axis=1) - first_hits(ray[some], vertices, HEAD.faces)
    hidden, bare = some[behind > 0.007], some[behind < 0.002]
    assert len(hidden) > 3 and not seen[hidden].any()
    assert seen[bare].mean() > 0.97


def test_sample_points_lie_on_skin_alone():
    skin = skin_of(HEAD, MODEL, IDENTITY)
    corners = np.unique(HEAD.faces[skin.triangles])
    for name in ("eyes", "teeth", "tongue"):
        assert not np.isin(corners, HEAD.regions[name]).any()
    assert not np.isin(corners, HEAD.behind_lips()).any()
    assert np.isin(corners, HEAD.regions["lips"]).any()
    assert (skin.barycentric >= 0).all()
    np.testing.assert_allclose(skin.barycentric.sum(1), 1, rtol=1e-5)
    assert 0.1 < skin.mouth.mean() < 0.7


def test_points_know_how_far_the_mouths_inside_is():
    skin = skin_of(HEAD, MODEL, IDENTITY)
    inner = np.concatenate([HEAD.regions[f"inner_lip_{lip}"] for lip in ("upper", "lower")])
    vertices = HEAD.template[inner] - MODEL.centre
    to_vertex = np.linalg.norm(skin.rest[:, None] - vertices, axis=-1).min(1)
    assert (skin.to_inside <= to_vertex + 1e-6).all()
    assert skin.to_inside.min() < 0.002 and skin.to_inside[~skin.mouth].min() > 0.01


def test_a_head_that_knows_one_point_of_each_inner_lip_has_a_mouth():
    lines = {f"inner_lip_{lip}": HEAD.regions[f"inner_lip_{lip}"] for lip in ("upper", "lower")}
    middles = {name: line[[len(line) // 2]] for name, line in lines.items()}
    skin = skin_of(replace(HEAD, regions=HEAD.regions | middles), MODEL, IDENTITY)
    vertices = HEAD.template[np.concatenate(list(middles.values()))] - MODEL.centre
    to_middle = np.linalg.norm(skin.rest[:, None] - vertices, axis=-1).min(1)
    np.testing.assert_allclose(skin.to_inside, to_middle, atol=1e-6)


def test_skin_moves_as_a_flame_head_does():
    fake = FakeFlame()
    flame = flame_head("flame", arrays(fake), surface(fake), {})
    model = landmark_model(flame, Weights())
    identity = np.zeros(len(flame.identity_basis), np.float32)
    skin = skin_of(flame, model, identity)
    weights = np.zeros(model.expressions)
    weights[:3], weights[-2] = (0.5, -0.4, 0.3), 1.0  # shapes, and the jaw at the step of its chord
    expression, jaw = (part.astype(np.float32) for part in model.modes.head_weights(weights))
    posed = flame.vertices(identity, expression, jaw=jaw)
    expected = np.einsum("pc,pcx->px", skin.barycentric, posed[flame.faces[skin.triangles]])
    np.testing.assert_allclose(skin.rest + skin.expression @ weights + model.centre, expected, atol=3e-4)
    assert skin.mouth.any() and not skin.mouth.all()
    np.testing.assert_allclose(model.modes.of_head(expression, jaw), weights, atol=1e-6)


def test_lids_move_as_fast_as_the_landmarks_say(energy_and_x):
    window = Window(np.zeros((1, 2)), 1.0, SIZE, whole(*SIZE))
    skin = energy_and_x[0]
    subject = Subject(HEAD, IDENTITY, skin.landmarks, skin.skin, window, Photometry(smoothness=20.0))
    factor = dict(zip(HEAD.expression_names, subject.smoothness))
    assert factor["eyeBlinkLeft"] == factor["eyeLookDownRight"] == 1
    assert factor["jawOpen"] == factor["mouthPressLeft"] == factor["browInnerUp"] == 20
    assert (subject.smoothness[-POSE:] == 20).all()


def test_only_the_mouth_has_noise_of_its_own():
    rng = np.random.default_rng(2)
    error = rng.normal(size=(200, 90)).astype(np.float32) * 3
    error[:, 40:50] *= 4
    seen, mouth = np.ones(error.shape, bool), np.arange(90) >= 45
    seen[:, 89] = False
    noise = grey_noise(error, seen, mouth)
    assert noise[45:50] == pytest.approx(12, rel=0.25)
    assert noise[:45] == pytest.approx(noise[0]) and noise[89] == noise[0]
    assert (grey_noise(error, np.zeros_like(seen), mouth) == LEAST_NOISE).all()
