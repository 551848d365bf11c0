"""The embedded head: what it is made of, how it moves, what it refuses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracker.energy import LIP_PAIRS
from tracker.head import ASSET, HeadModel, load_head, read_head, read_landmark_embedding
from tracker.modes import LIP_SHAPES
from tracker.raster import rasterize
from tracker.track import TrackError

FLIP = np.array([-1, 1, 1], np.float32)
SHAPES = 52 + len(LIP_SHAPES)
REGIONS = {
    "lips", "inner_lip_upper", "inner_lip_lower", "face", "eyelids", "eyes", "forehead", "neck", "scalp", "teeth",
}  # fmt: skip


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def _weights(head: HeadModel, **weights: float) -> np.ndarray:
    """Expression weights by name; a name without its side sets both sides."""
    out = np.zeros(len(head.expression_names), np.float32)
    for name, value in weights.items():
        sides = [name] if name in head.expression_names else [f"{name}Left", f"{name}Right"]
        for side in sides:
            out[head.expression_names.index(side)] = value
    return out


def _people(head: HeadModel, count: int) -> np.ndarray:
    return np.random.default_rng(3).standard_normal((count, len(head.identity_basis))).astype(np.float32)


def test_shapes_types_and_names(head: HeadModel) -> None:
    count = len(head.template)
    assert head.template.dtype == np.float32 and head.faces.dtype == np.int32
    assert head.identity_basis.shape == (100, count, 3) and head.expression_basis.shape == (SHAPES, count, 3)
    assert head.identity_basis.dtype == head.expression_basis.dtype == np.float32
    assert len(set(head.expression_names)) == SHAPES and {"jawOpen", *LIP_SHAPES} <= set(
        head.expression_names
    )
    assert head.faces.min() == 0 and head.faces.max() == count - 1
    assert set(head.regions) >= REGIONS
    assert head.albedo.shape == (count, 3) and head.albedo.dtype == np.uint8
    assert ASSET.stat().st_size < 5e6


def test_frame_and_size(head: HeadModel) -> None:
    left, right = (head.template[head.regions[f"{side}_eye"]].mean(0) for side in ("left", "right"))
    assert left[0] > 0 > right[0] and left[2] > 0.05  # x to the subject's left, z out of the face
    assert (
        head.template[head.regions["forehead"], 1].mean()
        > head.template[head.regions["lips"], 1].mean() + 0.05
    )
    assert abs(head.joints["left_eye"].position[0] - head.joints["right_eye"].position[0] - 0.0624) < 1e-4
    assert np.abs(head.template).max() < 0.2  # metres


def test_faces_run_counter_clockwise_from_outside(head: HeadModel) -> None:
    solid = np.isin(head.faces, head.regions["scalp"]).all(1)
    a, b, c = np.moveaxis(head.template[head.faces[solid]], 1, 0)
    outward = np.einsum("fx,fx->f", np.cross(b - a, c - a), a - [0, 0.02, 0.02])
    assert (outward > 0).all()


def test_neutral_is_the_template_and_vertices_equal_the_sum(head: HeadModel) -> None:
    nobody, rest = np.zeros(100), np.zeros(SHAPES)
    np.testing.assert_array_equal(head.vertices(nobody, rest), head.template)
    identity, expression = _people(head, 1)[0], np.random.default_rng(0).uniform(0, 1, SHAPES)
    expected = head.template.astype(float)
    for weight, shape in zip(identity, head.identity_basis):
        expected = expected + weight * shape
    for weight, shape in zip(expression, head.expression_basis):
        expected = expected + weight * shape
    np.testing.assert_allclose(head.vertices(identity, expression), expected, atol=2e-6)


def test_leading_dimensions_broadcast(head: HeadModel) -> None:
    expression = np.random.default_rng(1).uniform(0, 1, (2, 3, SHAPES))
    eyes = np.random.default_rng(2).normal(0, 0.2, (2, 3, 2, 3))
    identity = _people(head, 1)[0]
    all_at_once = head.vertices(identity, expression, eyes=eyes)
    assert all_at_once.shape == (2, 3, *head.template.shape)
    one = head.vertices(identity, expression[1, 2], eyes=eyes[1, 2])
    np.testing.assert_allclose(all_at_once[1, 2], one, atol=1e-6)
    assert head.vertices(_people(head, 4), np.zeros(SHAPES)).shape[0] == 4


def test_everything_is_symmetric(head: HeadModel) -> None:
    mirror = head.mirror
    np.testing.assert_array_equal(mirror[mirror], np.arange(len(mirror)))
    np.testing.assert_allclose(head.template[mirror] * FLIP, head.template, atol=1e-6)
    turned = {tuple(sorted(face)) for face in mirror[head.faces].tolist()}
    assert turned == {tuple(sorted(face)) for face in head.faces.tolist()}
    for name, region in head.regions.items():
        other = name.replace("left", "@").replace("right", "left").replace("@", "right")
        assert set(mirror[region]) == set(head.regions[other]), name
    shapes = dict(zip(head.expression_names, head.expression_basis))
    for name, shape in shapes.items():
        other = name.replace("Left", "@").replace("Right", "Left").replace("@", "Right")
        turned_round = -1 if name in ("lipUpper2", "lipLower2") else 1
        np.testing.assert_allclose(
            shape[mirror] * FLIP, turned_round * shapes[other], atol=5e-6, err_msg=name
        )
    for mode in head.identity_basis:
        image = mode[mirror] * FLIP
        assert min(np.abs(image - mode).max(), np.abs(image + mode).max()) < 1e-5


def test_albedo_is_symmetric(head: HeadModel) -> None:
    apart = np.abs(head.albedo[head.mirror].astype(int) - head.albedo)
    assert apart.max() <= 1


def test_lips_touch_on_every_neutral_face_and_open_with_the_jaw(head: HeadModel) -> None:
    upper, lower = head.regions["inner_lip_upper"], head.regions["inner_lip_lower"]
    assert len(upper) == len(lower) and upper[0] == lower[0] and upper[-1] == lower[-1]
    assert (np.diff(head.template[lower, 0]) > 0).all()
    neutral = head.vertices(_people(head, 40), np.zeros(SHAPES))
    assert np.abs(head.lip_gap_mm(neutral)).max() < 0.15
    assert np.abs(neutral[:, upper] - neutral[:, lower]).max() < 2e-3
    opening = [
        head.lip_gap_mm(head.vertices(np.zeros(100), _weights(head, jawOpen=w)))
        for w in (0, 0.1, 0.3, 0.6, 1)
    ]
    assert (np.diff(opening) > 2).all() and 25 < opening[-1] < 45


def test_shut_lips_do_not_bulge_into_each_other_behind_the_line_where_they_meet(head: HeadModel) -> None:
    behind = head.behind_lips()
    follows_jaw = _weights(head, jawOpen=1) @ head.expression_basis[:, behind, 1].astype(np.float64) < -0.012
    x, y = head.template[head.regions["lower_lip_edge"], :2].T
    within = np.abs(head.template[behind, 0]) < 0.02  # at the corners nothing tells upper from lower
    above = head.template[behind, 1] - np.interp(head.template[behind, 0], x, y)
    assert above[within & ~follows_jaw].min() > -1e-4 and above[within & follows_jaw].max() < 1e-4


@pytest.mark.parametrize("jaw", [0.15, 0.4])
def test_between_the_lips_an_open_mouth_shows_its_inside(head: HeadModel, jaw: float) -> None:
    vertices = head.vertices(np.zeros(100), _weights(head, jawOpen=jaw))
    px_per_m, height = 1e4, 1200
    pixels = vertices * (px_per_m, -px_per_m, -1) + (2, 0, 1)
    pixels[:, 1] += height / 2 - pixels[head.regions["inner_lip_upper"], 1].mean()
    seen = rasterize(pixels, head.faces, (5, height)).triangle[:, 2]
    inside = [head.regions[name] for name in ("mouth", "teeth", "tongue")]
    shows = np.isin(head.faces[seen], np.concatenate([*inside, head.behind_lips()])).any(1)
    assert 1e3 * shows.sum() / px_per_m == pytest.approx(head.lip_gap_mm(vertices), abs=0.3)


@pytest.mark.parametrize(
    "weights",
    [
        {"mouthSmile": 1}, {"mouthPucker": 1}, {"mouthFrown": 1}, {"mouthDimple": 1}, {"mouthStretch": 1},
        {"mouthPress": 1}, {"mouthLeft": 1}, {"jawOpen": 1, "mouthClose": 1}, {"jawOpen": 0.4, "mouthClose": 0.4},
    ],
)  # fmt: skip
def test_lips_stay_shut(head: HeadModel, weights: dict[str, float]) -> None:
    vertices = head.vertices(_people(head, 10), _weights(head, **weights))
    gap = (vertices[:, head.regions["inner_lip_upper"]] - vertices[:, head.regions["inner_lip_lower"]])[
        ..., 1
    ]
    assert np.abs(gap).max() < 0.5e-3
    assert np.abs(head.lip_gap_mm(vertices)).max() < 0.15


@pytest.mark.parametrize("name", LIP_SHAPES)
def test_a_profile_moves_one_lip_up_and_down_in_waves_and_nothing_else(head: HeadModel, name: str) -> None:
    shape = head.expression_basis[head.expression_names.index(name)]
    upper, lower = head.regions["inner_lip_upper"], head.regions["inner_lip_lower"]
    right, left = head.template[upper[[0, -1]], 0]
    own, other = (upper, lower) if "Upper" in name else (lower, upper)
    along = (head.template[own, 0] - right) / (left - right)
    np.testing.assert_allclose(shape[own, 1], 0.005 * np.sin(int(name[-1]) * np.pi * along), atol=2e-5)
    assert not shape[other].any() and not shape[:, [0, 2]].any()
    others = np.concatenate([head.regions[part] for part in ("teeth", "tongue", "eyes", "scalp", "ears")])
    assert np.abs(shape[others]).max() < 1e-5
    far = np.linalg.norm(head.template[:, None] - head.template[head.regions["lips"]], axis=2).min(1)
    assert np.abs(shape[far > 0.015]).max() < 2e-4


def test_a_full_blink_closes_the_eye_outside_the_ball(head: HeadModel) -> None:
    vertices = head.vertices(np.zeros(100), _weights(head, eyeBlink=1))
    for side in ("left", "right"):
        upper, lower = (vertices[head.regions[f"{side}_eyelid_{edge}"]] for edge in ("upper", "lower"))
        open_mm = 1e3 * np.linalg.norm(upper - lower, axis=1)
        assert np.median(open_mm) < 0.5 and open_mm.max() < 1.5
        ball = head.template[head.regions[f"{side}_eye"]] - head.joints[f"{side}_eye"].position
        lids = np.r_[upper, lower] - head.joints[f"{side}_eye"].position
        assert np.linalg.norm(lids, axis=1).min() > np.linalg.norm(ball, axis=1).max()


def test_eyes_turn_about_their_centres_and_nothing_else_moves(head: HeadModel) -> None:
    identity = _people(head, 1)[0]
    turn = np.array([[0.1, 0.4, 0.0], [-0.2, 0.0, 0.05]])
    still, turned = (head.vertices(identity, np.zeros(SHAPES), eyes=eyes) for eyes in (None, turn))
    others = np.setdiff1d(np.arange(len(still)), head.regions["eyes"])
    np.testing.assert_array_equal(still[others], turned[others])
    for side, name in enumerate(("left_eye", "right_eye")):
        joint = head.joints[name]
        centre = joint.position + identity @ joint.identity_basis
        expected = (still[joint.vertices] - centre) @ Rotation.from_rotvec(turn[side]).as_matrix().T + centre
        np.testing.assert_allclose(turned[joint.vertices], expected, atol=1e-6)
        radius = np.linalg.norm(still[joint.vertices] - centre, axis=1)
        assert radius.std() / radius.mean() < 0.05  # the joint is the ball's own centre


def test_jaw_and_neck_must_be_zero(head: HeadModel) -> None:
    head.vertices(np.zeros(100), np.zeros(SHAPES), jaw=np.zeros(3), neck=np.zeros((5, 3)))
    with pytest.raises(TrackError, match="no jaw joint"):
        head.vertices(np.zeros(100), np.zeros(SHAPES), jaw=[0.1, 0, 0])


def test_landmarks_lie_on_the_mesh_and_follow_it(head: HeadModel) -> None:
    embedding = head.landmark_embedding
    assert len(embedding.landmarks) > 400 and set(embedding.landmarks) >= {13, 14, 33, 263, 61, 291, 468, 473}
    np.testing.assert_allclose(embedding.barycentric.sum(1), 1, atol=1e-5)
    identity, expression = _people(head, 2)[:, None], np.random.default_rng(0).uniform(0, 1, (3, SHAPES))
    eyes = np.full((3, 2, 3), 0.2)
    points = head.landmark_positions(identity, expression, eyes=eyes)
    assert points.shape == (2, 3, len(embedding.landmarks), 3)
    vertices = head.vertices(identity, expression, eyes=eyes)
    corners = vertices[..., head.faces[embedding.triangles], :]
    np.testing.assert_allclose(points, (corners * embedding.barycentric[..., None]).sum(-2), atol=1e-6)


def test_inner_lip_landmarks_touch_on_the_neutral_face(head: HeadModel) -> None:
    row = {int(index): k for k, index in enumerate(head.landmark_embedding.landmarks)}
    points = head.landmark_positions(np.zeros(100), np.zeros(SHAPES))
    for upper, lower in ((13, 14), (82, 87), (81, 178), (80, 88), (312, 317), (311, 402), (310, 318)):
        assert np.linalg.norm(points[row[upper]] - points[row[lower]]) < 1e-3
    left, right = points[row[263]], points[row[33]]
    np.testing.assert_allclose(left * FLIP, right, atol=1e-4)
    assert left[0] > 0


def test_an_embedding_of_another_head_is_refused(head: HeadModel) -> None:
    with pytest.raises(TrackError, match="made for head"):
        replace(head, landmark_embedding=replace(head.landmark_embedding, head_sha256="0" * 64))


def test_damaged_files_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(TrackError, match="not a head model"):
        read_head(tmp_path / "missing.npz")
    with pytest.raises(TrackError, match="not a landmark embedding"):
        read_landmark_embedding(tmp_path / "missing.landmarks.npz")
    whole = ASSET.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 255
    path = tmp_path / "head.npz"
    for content in (
        b"not an archive",
        b"",
        whole[: len(whole) // 2],
        b"PK\x03\x04" + whole[:50],
        bytes(flipped),
    ):
        path.write_bytes(content)
        with pytest.raises(TrackError, match="not a head model"):
            read_head(path)
        with pytest.raises(TrackError, match="not a landmark embedding"):
            read_landmark_embedding(path)


def test_the_inner_lips_landmarks_lie_each_on_its_own_lip():
    head = load_head()
    row = {int(index): i for i, index in enumerate(head.landmark_embedding.landmarks)}
    jaw = np.zeros(len(head.expression_names))
    jaw[head.expression_names.index("jawOpen")] = 0.5
    open_mouth = head.landmark_positions(np.zeros(len(head.identity_basis)), jaw)
    for upper, lower in LIP_PAIRS:
        assert open_mouth[row[upper], 1] - open_mouth[row[lower], 1] > 0.004
