"""FLAME as a HeadModel: posed as the paper writes it, its regions, its fit, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.flame_factory import EMBEDDED, FakeFlame
from tracker.energy import Weights
from tracker.fit import fit_track
from tracker.flame import EmbeddedPoints, flame_head
from tracker.head import HeadModel, load_head
from tracker.landmark_indices import BLENDSHAPE_NAMES, IBUG_51, MIRRORED, POINTS, UPPER_FACE, of_rigid_face
from tracker.modes import head_modes, movements
from tracker.track import Camera, Landmarks, TrackError

RNG = np.random.default_rng(5)


def surface(fake: FakeFlame, landmarks: tuple[int, ...] = EMBEDDED) -> EmbeddedPoints:
    data = fake.embedding(landmarks)
    return EmbeddedPoints(
        data["landmark_indices"].astype(np.int32),
        data["lmk_face_idx"].astype(np.int32),
        data["lmk_b_coords"].astype(np.float32),
    )


def arrays(fake: FakeFlame) -> dict[str, np.ndarray]:
    return {**fake.content, "J_regressor": fake.content["J_regressor"].toarray()}


@pytest.fixture(scope="module")
def fake() -> FakeFlame:
    return FakeFlame()


@pytest.fixture(scope="module")
def head(fake: FakeFlame) -> HeadModel:
    return flame_head("flame", arrays(fake), surface(fake), {})


def test_vertices_are_the_papers(fake: FakeFlame, head: HeadModel) -> None:
    identity, expression = RNG.normal(0, 1, (2, 300)), RNG.normal(0, 1, (2, 100))
    jaw, neck, eyes = RNG.normal(0, 0.3, (2, 3)), RNG.normal(0, 0.3, (2, 3)), RNG.normal(0, 0.3, (2, 2, 3))
    ours = head.vertices(identity, expression, jaw=jaw, neck=neck, eyes=eyes)
    for frame in range(2):
        theirs = fake.vertices(
            identity[frame], expression[frame], neck=neck[frame], jaw=jaw[frame], eyes=eyes[frame]
        )
        assert np.abs(ours[frame] - theirs).max() < 1e-6
    at_rest = head.vertices(identity[0], expression)
    assert np.abs(at_rest[1] - fake.vertices(identity[0], expression[1])).max() < 1e-6


def test_landmarks_follow_the_mesh(head: HeadModel) -> None:
    jaw, eyes = np.array([0.3, 0, 0]), np.full((2, 3), 0.2)
    vertices = head.vertices(np.zeros(300), np.ones(100), jaw=jaw, eyes=eyes)
    embedding = head.landmark_embedding
    expected = np.einsum("lc,lcx->lx", embedding.barycentric, vertices[head.faces[embedding.triangles]])
    points = head.landmark_positions(np.zeros(300), np.ones(100), jaw=jaw, eyes=eyes)
    np.testing.assert_allclose(points, expected, atol=1e-6)
    assert set(embedding.landmarks) == {*EMBEDDED, 468, 473}


def test_a_turned_jaw_opens_the_lips_and_leaves_the_brow(head: HeadModel) -> None:
    rest, opened = (head.vertices(np.zeros(300), np.zeros(100), jaw=[turn, 0, 0]) for turn in (0.0, 0.3))
    assert abs(head.lip_gap_mm(rest)) < 1 and head.lip_gap_mm(opened) > 10
    brow = head.template[:, 1] > head.template[head.regions["lips"], 1].max() + 0.04
    still = np.flatnonzero(brow & (head.skeleton.weights[:, 2] == 0))  # type: ignore[union-attr]
    assert np.abs(opened - rest)[still].max() < 1e-3  # the pose correctives reach everywhere


def test_regions_lie_where_they_are_named(head: HeadModel) -> None:
    middle = {name: head.template[region].mean(0) for name, region in head.regions.items() if len(region)}
    assert middle["left_eye"][0] > 0.02 > -0.02 > middle["right_eye"][0]
    assert middle["neck"][1] < middle["lips"][1] < middle["eyelids"][1] < middle["forehead"][1]
    upper, lower = head.regions["inner_lip_upper"], head.regions["inner_lip_lower"]
    assert len(upper) == len(lower) == 11 and upper[0] == lower[0] and upper[-1] == lower[-1]
    assert head.template[upper[0], 0] < 0 < head.template[upper[-1], 0]  # from the right to the left corner
    assert not set(head.regions["face"]) & set(head.regions["eyes"])
    assert set(head.regions["lips"]) <= set(head.regions["face"])


def test_masks_take_the_place_of_what_is_told(fake: FakeFlame) -> None:
    masked = flame_head("flame", arrays(fake), surface(fake), {"lips": np.array([3, 5], np.int32)})
    assert masked.regions["lips"].tolist() == [3, 5]
    with pytest.raises(TrackError, match="masks are for another head"):
        flame_head("flame", arrays(fake), surface(fake), {"lips": np.array([9999], np.int32)})


def test_the_51_points_are_named_symmetrically(fake: FakeFlame) -> None:
    assert len(IBUG_51) == len(set(IBUG_51)) == 51
    assert {int(MIRRORED[index]) for index in IBUG_51} == set(IBUG_51)
    static = flame_head("flame", arrays(fake), surface(fake, IBUG_51), {})
    assert len(static.regions["inner_lip_upper"]) == 5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": None}, "weights is missing"),
        ({"posedirs": np.zeros((3, 3, 36))}, r"posedirs is \(3, 3, 36\)"),
        ({"v_template": np.full((3, 3), np.nan)}, "v_template"),
        ({"v_template": np.full((3, 3), 1e200)}, "numbers below 1e[+]06"),
        ({"shapedirs": "cut"}, "of the 300 shapes"),
        ({"kintree_table": np.zeros((2, 5))}, "joints are not root"),
        ({"f": np.full((4, 3), 10_000)}, "faces name vertices"),
        ({"v_template": np.array(["a"])}, r"v_template is \(1,\)"),
        ({"kintree_table": np.full((2, 5), "a")}, "kintree_table holds no numbers"),
        ({"v_template": np.array(0.1)}, r"v_template is \(1,\)"),
        ({"f": np.zeros((0, 3))}, "and 0 faces"),
    ],
)
def test_wrong_arrays_are_refused(fake: FakeFlame, change: dict, message: str) -> None:
    content = arrays(fake)
    for key, value in change.items():
        if value is None:
            del content[key]
        else:
            content[key] = content[key][..., :300] if isinstance(value, str) else value
    with pytest.raises(TrackError, match=message):
        flame_head("flame", content, surface(fake), {})


def test_wrong_landmarks_are_refused(fake: FakeFlame) -> None:
    points = surface(fake)
    for wrong, message in (
        (replace(points, triangles=points.triangles + 10_000), "another head"),
        (replace(points, barycentric=points.barycentric * 2), "sum to 1"),
        (replace(points, landmarks=points.landmarks[1:]), "as many"),
        (surface(fake, (168, 6, 197, 33, 133, 263)), "inner lips"),
        (surface(fake, (13, 14)), "holds 0 landmarks of the rigid upper face"),
        (surface(fake, (13, 14, 33, 263)), "holds 2 landmarks of the rigid upper face"),
        (surface(fake, (13, 14, 168, 6, 197, 195, 5, 4)), "on one line"),
    ):
        with pytest.raises(TrackError, match=message):
            flame_head("flame", arrays(fake), wrong, {})


def test_eyeballs_without_faces_have_no_irises(fake: FakeFlame) -> None:
    content = arrays(fake)
    ball = np.flatnonzero(content["weights"][:, 3:].max(1) > 0.5)
    bare = content | {"f": content["f"][~np.isin(content["f"], ball).any(1)]}
    assert not {468, 473} & set(flame_head("flame", bare, surface(fake), {}).landmark_embedding.landmarks)


def test_a_template_whose_landmarks_coincide_is_refused(fake: FakeFlame) -> None:
    content = arrays(fake)
    for template in (0 * content["v_template"], content["v_template"] * [0, 1, 1]):
        with pytest.raises(TrackError, match="in one place or on one line"):
            flame_head("flame", content | {"v_template": template}, surface(fake), {})


def test_a_face_without_area_under_a_landmark_is_refused(fake: FakeFlame) -> None:
    content, points = arrays(fake), surface(fake)
    faces = content["f"].copy()
    faces[points.triangles[0]] = faces[points.triangles[0], 0]
    with pytest.raises(TrackError, match="no area"):
        flame_head("flame", content | {"f": faces}, points, {})


def test_masks_without_bare_skin_are_refused(fake: FakeFlame) -> None:
    with pytest.raises(TrackError, match="bare skin"):
        flame_head("flame", arrays(fake), surface(fake), {"face": np.arange(2, dtype=np.int32)})


@pytest.mark.parametrize("landmarks", [EMBEDDED, IBUG_51])
def test_few_landmarks_give_a_rigid_face_of_some_width(fake: FakeFlame, landmarks: tuple[int, ...]) -> None:
    sparse = flame_head("flame", arrays(fake), surface(fake, landmarks), {})
    rigid = of_rigid_face(sparse.landmark_embedding.landmarks)
    points = sparse.landmark_positions(np.zeros(300), np.zeros(100))[rigid]
    assert len(points) >= 9 and np.linalg.svd(points - points.mean(0))[1].min() > 0.005
    full = load_head().landmark_embedding
    assert set(full.landmarks[of_rigid_face(full.landmarks)]) == set(UPPER_FACE)


def test_the_jaws_mode_is_its_motion(head: HeadModel) -> None:
    modes = head_modes(head, Weights())
    basis = np.tensordot(modes.to_head, movements(head), 1)
    expression, jaw = modes.head_weights(np.eye(len(modes))[-2])
    assert not expression.any() and jaw.tolist() == [0.2, 0, 0]
    moved = head.vertices(np.zeros(300), expression, jaw=jaw) - head.template
    np.testing.assert_allclose(basis[-2], moved, atol=1e-6)
    assert modes.lower[-2] == 0 and np.isinf(modes.lower[0])


def test_the_fit_finds_opening_and_pose(head: HeadModel) -> None:
    frames, focal, rng = 16, 1500.0, np.random.default_rng(5)
    time = np.arange(frames) / 25
    jaw = np.zeros((frames, 3), np.float32)
    jaw[:, 0] = 0.25 * np.clip(np.sin(2 * np.pi * 2 * time), 0, 1)
    expression = np.zeros((frames, 100), np.float32)
    expression[:, :4] = 0.7 * np.sin(np.outer(time, [5, 3, 4, 6]) + np.arange(4))
    identity = np.zeros(300, np.float32)
    identity[:20] = 0.5 * rng.normal(size=20)
    points = head.landmark_positions(identity, expression, jaw=jaw)
    camera = points * [1, -1, -1] + [0, 0, 0.7]
    pixels = focal * camera[..., :2] / camera[..., 2:] + [639.5, 359.5]
    pixels += 0.3 * rng.normal(size=pixels.shape)
    seen = np.zeros((frames, POINTS, 3), np.float32)
    seen[:, head.landmark_embedding.landmarks] = np.dstack([pixels, camera[..., 2] * focal / 0.7])
    landmarks = Landmarks(
        time,
        seen,
        np.ones(frames, np.float32),
        np.zeros((frames, 52), np.float32),
        BLENDSHAPE_NAMES,
        (1280, 720),
    )
    track = fit_track(
        landmarks, Camera(focal, 0.0, (639.5, 359.5), (), (1280, 720), "given", ""), head,
        np.ones(frames, bool), np.zeros(frames, np.int32),
    )  # fmt: skip
    gap = head.lip_gap_mm(head.vertices(identity, expression, jaw=jaw))
    assert np.corrcoef(track.lip_gap_mm, gap)[0, 1] > 0.995
    assert np.sqrt(np.mean((track.lip_gap_mm - gap) ** 2)) < 0.6
    slope, offset = np.polyfit(jaw[:, 0], track.jaw[:, 0], 1)
    assert 0.8 < slope < 1.1 and abs(offset) < 0.02 and track.jaw[:, 0].min() >= 0
    assert track.reprojection_px.mean() < 1.5
