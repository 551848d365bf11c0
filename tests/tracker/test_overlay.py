"""Overlay modes on a head rendered in known colours: they draw on the face alone, and say how well it fits."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.flame_factory import FakeFlame
from tests.tracker.test_flame import arrays, surface
from tests.tracker.turning_head import SIZE, first_hits, picture, shifted_landmarks, turning_track
from tracker.albedo import Rendering, _seen, learn_albedo, rerender
from tracker.flame import flame_head
from tracker.head import HeadModel, load_head
from tracker.overlay import DETECTED, FITTED, IRISES, LIDS, LIPS, MODES, NEEDS_ALBEDO, draw
from tracker.raster import vertex_normals
from tracker.scene import OUTSIDE, Crop, Scene, place, scene
from tracker.track import Landmarks, Track

FRAMES, SHIFT = 6, 6.0
WHOLE = Crop((0, 0), SIZE, SIZE)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def track(head: HeadModel) -> Track:
    return turning_track(head, FRAMES)


@pytest.fixture(scope="module")
def landmarks(track: Track, head: HeadModel) -> Landmarks:
    return shifted_landmarks(track, head, SHIFT)


@pytest.fixture(scope="module")
def scenes(track: Track, landmarks: Landmarks, head: HeadModel) -> list[Scene]:
    return [scene(picture(track, head, n), WHOLE, track, n, landmarks, head) for n in range(FRAMES)]


def test_a_crop_maps_points_as_it_maps_the_picture() -> None:
    rgb = np.zeros((60, 80, 3), np.uint8)
    rgb[30:34, 40:44] = 255  # its middle is at 31.5, 41.5
    for crop in (Crop((20, 10), (40, 40), (80, 120)), Crop((-20, 20), (80, 60), (40, 30))):
        shown = np.maximum(crop.picture(rgb)[..., 0].astype(float) - OUTSIDE[0], 0)
        y, x = np.mgrid[: shown.shape[0], : shown.shape[1]]
        middle = np.array([(x * shown).sum(), (y * shown).sum()]) / shown.sum()
        assert shown.shape == crop.size[::-1]
        np.testing.assert_allclose(middle, crop.place(np.array([41.5, 31.5])), atol=0.05)


@pytest.mark.parametrize("origin", [(80, 0), (-40, 0), (0, 300), (0, -40), (10**6, -(10**6))])
def test_a_crop_that_lies_beside_the_picture_is_dark(origin: tuple[int, int]) -> None:
    shown = Crop(origin, (40, 40), (50, 30)).picture(np.full((60, 80, 3), 255, np.uint8))
    assert shown.shape == (30, 50, 3) and (shown == OUTSIDE).all()


@pytest.mark.parametrize("mode", MODES)
def test_each_mode_draws_on_the_face_and_nowhere_else(
    mode: str, scenes: list[Scene], head: HeadModel
) -> None:
    one = scenes[3]
    rendering = rerender(one, learn_albedo(scenes)) if mode in NEEDS_ALBEDO else None
    before = one.picture.copy()
    drawn = draw(one, mode, head, rendering)
    assert (one.picture == before).all()
    on_face = np.zeros(SIZE[::-1], np.uint8)
    one.part(on_face)[one.raster.triangle >= 0] = 1
    reach = on_face.copy()
    if mode == "landmarks":  # some are at the ears, and each is joined to its fitted one
        x, y = np.round(np.concatenate([one.detected, one.fitted])).astype(int).T
        reach[y, x] = 1
    reach = cv2.dilate(reach, np.ones((9, 9), np.uint8)).astype(bool)
    changed = (drawn != one.picture).any(2)
    assert changed[on_face.astype(bool)].mean() > 0.02
    if mode == "error":  # the surroundings are grey, with a legend below
        assert (np.ptp(drawn[: SIZE[1] // 2][~reach[: SIZE[1] // 2]], axis=-1) == 0).all()
    else:
        assert not changed[~reach].any()


def test_a_picture_like_the_rendering_has_no_error(scenes: list[Scene], head: HeadModel) -> None:
    one = scenes[2]
    part = one.part(one.picture)
    known = np.where(one.raster.triangle >= 0, 255, 0).astype(np.uint8)
    black = one.part(draw(one, "error", head, Rendering(part, known, part)))[known > 0]
    off = one.part(draw(one, "error", head, Rendering(part, known, np.roll(part, 8, axis=1))))[known > 0]
    assert black.max() <= 4
    assert off.max() > 200
    hot = off[off.max(1) > 200].astype(int)
    assert (hot[:, 0] > hot[:, 2]).mean() > 0.9  # large errors are red and yellow, none is blue


def test_the_rendering_comes_near_the_picture_and_less_so_at_a_wrong_pose(
    scenes: list[Scene], track: Track, landmarks: Landmarks, head: HeadModel
) -> None:
    albedo = learn_albedo(scenes)

    def error(one: Scene) -> float:
        rendering = rerender(one, albedo)
        difference = cv2.absdiff(rendering.colour, rendering.blurred)[rendering.known > 0]
        return float(difference.mean())

    right = [error(one) for one in scenes]
    wrong = scene(picture(track, head, 1), WHOLE, track, 4, landmarks, head)
    assert max(right) < 4
    assert error(wrong) > 2 * max(right)


def test_what_covers_the_face_stays_out_of_its_colours(scenes: list[Scene], head: HeadModel) -> None:
    albedo = learn_albedo(scenes)
    one = scenes[2]
    covered = Scene(**{**vars(one), "picture": one.picture.copy()})
    part = covered.part(covered.picture)
    part[: len(part) // 3] = (20, 200, 20)
    rendering, plain = rerender(covered, albedo), rerender(one, albedo)
    below = np.zeros(rendering.known.shape, bool)
    below[len(below) // 2 :] = True
    seen = (rendering.known > 0) & below
    assert cv2.absdiff(rendering.colour, plain.colour)[seen].mean() < 8


def test_detected_and_fitted_landmarks_are_both_seen(scenes: list[Scene], head: HeadModel) -> None:
    one = scenes[0]
    drawn = draw(one, "landmarks", head, None)
    cheek = int(np.flatnonzero(head.landmark_embedding.landmarks == 50)[0])
    for at, colour in ((one.detected[cheek], DETECTED), (one.fitted[cheek], FITTED)):
        x, y = np.round(at).astype(int)
        near = drawn[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3).astype(int)
        assert np.abs(near - colour).sum(1).min() < 120
    assert one.detected[cheek, 0] - one.fitted[cheek, 0] == pytest.approx(SHIFT, abs=1e-3)


def test_a_face_outside_of_the_part_shown_leaves_it_as_it_is(
    track: Track, landmarks: Landmarks, head: HeadModel
) -> None:
    away = scene(picture(track, head, 0), Crop((0, 0), (40, 40), (80, 80)), track, 0, landmarks, head)
    assert (draw(away, "shaded", head, None) == away.picture).all()


def test_a_scene_knows_how_large_the_face_is_shown(
    track: Track, landmarks: Landmarks, head: HeadModel
) -> None:
    twice = scene(picture(track, head, 0), Crop((90, 75), (180, 150), SIZE), track, 0, landmarks, head)
    assert twice.px_per_m == pytest.approx(2 * track.focal / track.translation[0, 2])


def test_a_head_with_joints_is_placed_as_they_turn(track: Track) -> None:
    fake = FakeFlame()
    flame, random = flame_head("flame", arrays(fake), surface(fake), {}), np.random.default_rng(3)
    turns = random.normal(0, 0.2, (FRAMES, 4, 3)).astype(np.float32)
    posed = replace(
        track,
        identity=random.normal(size=300).astype(np.float32),
        expression=random.normal(size=(FRAMES, 100)).astype(np.float32),
        jaw=turns[:, 0],
        neck=turns[:, 1],
        eyes=turns[:, 2:],
    )
    vertices, points = place(posed, 3, flame)
    own = fake.vertices(
        posed.identity, posed.expression[3], neck=turns[3, 1], jaw=turns[3, 0], eyes=turns[3, 2:]
    )
    expected = Rotation.from_rotvec(posed.rotation[3]).apply(own) + posed.translation[3]
    np.testing.assert_allclose(vertices, expected, atol=1e-5)
    embedding = flame.landmark_embedding
    at = np.einsum("lc,lcx->lx", embedding.barycentric, expected[flame.faces[embedding.triangles]])
    np.testing.assert_allclose(points, at, atol=1e-5)


def test_the_legend_tells_grey_levels(
    scenes: list[Scene], head: HeadModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr("tracker.overlay.letter", lambda picture, text, at, height: told.append(text))
    one, none = scenes[0], np.zeros(scenes[0].raster.triangle.shape, np.uint8)
    part = one.part(one.picture)
    bar = draw(one, "error", head, Rendering(part, none, part))
    assert told == ["0", "20", "40"]
    assert bar[SIZE[1] // 2 :].reshape(-1, 3).max() > 240  # the brightest colour of the bar


@pytest.mark.parametrize(
    ("names", "colour"), [(("inner_lip",), LIPS), (("left_eyelid", "right_eyelid"), LIDS)]
)
def test_lips_and_both_lids_are_lined(
    names: tuple[str, ...], colour: tuple[int, int, int], scenes: list[Scene], head: HeadModel
) -> None:
    drawn = draw(scenes[-1], "wireframe", head, None).astype(int)
    for name in names:
        for side in ("upper", "lower"):
            x, y = np.round(scenes[-1].pixels[head.regions[f"{name}_{side}"], :2]).astype(int).T
            near = np.stack([drawn[y + j, x + i] for i in (-1, 0, 1) for j in (-1, 0, 1)])
            assert np.median(np.abs(near - colour).sum(-1).min(0)) < 120


def test_irises_are_lined_between_the_lids_and_turn_with_the_eyes(
    track: Track, landmarks: Landmarks, head: HeadModel
) -> None:
    def lined(turn: float, name: str = "") -> np.ndarray:
        """[n, 2] px, (x, y) of what is lined of the left iris."""
        weights, eyes = track.expression.copy(), np.zeros_like(track.eyes)
        eyes[..., 1] = turn
        if name:
            weights[0, head.expression_names.index(name)] = 1.0
        posed = replace(track, expression=weights, eyes=eyes)
        one = scene(picture(track, head, 0), WHOLE, posed, 0, landmarks, head)
        drawn = draw(one, "wireframe", head, None).astype(int)
        x, y, width, height = cv2.boundingRect(one.pixels[head.regions["left_iris"], :2])
        return np.argwhere(np.abs(drawn[y : y + height, x : x + width] - IRISES).sum(-1) < 90)[:, ::-1] + (
            x,
            y,
        )

    straight, aside, shut = lined(0.0), lined(0.3), lined(0.0, "eyeBlinkLeft")
    assert len(straight) > 15 and len(shut) < 4
    assert aside[:, 0].mean() - straight[:, 0].mean() > 2
    lids = scene(picture(track, head, 0), WHOLE, track, 0, landmarks, head).pixels
    upper, lower = (lids[head.regions[f"left_eyelid_{lid}"], 1] for lid in ("upper", "lower"))
    assert upper.min() - 1 < straight[:, 1].min() and straight[:, 1].max() < lower.max() + 1


def test_what_the_face_itself_hides_has_no_colour(
    track: Track, landmarks: Landmarks, head: HeadModel
) -> None:
    """Against rays: behind the nose of a head that is turned by 40 degrees there is cheek."""
    turned = (
        Rotation.from_euler("y", 52, degrees=True) * Rotation.from_rotvec(track.rotation[0])
    ).as_rotvec()
    aside = replace(track, rotation=np.tile(turned.astype(np.float32), (FRAMES, 1)))
    one = scene(np.zeros((*SIZE[::-1], 3), np.uint8), WHOLE, aside, 0, landmarks, head)
    seen, normal = _seen(one), vertex_normals(one.vertices, one.faces)
    distance = np.linalg.norm(one.vertices, axis=1)
    ray = one.vertices / distance[:, None]
    facing = -(normal * ray).sum(1)
    assert facing[seen].min() > 0.4
    towards = np.flatnonzero((facing > 0.5) & np.isin(np.arange(len(ray)), head.regions["face"]))[::2]
    behind = distance[towards] - first_hits(ray[towards], one.vertices, one.faces)
    hidden, bare = towards[behind > 0.006], towards[behind < 0.001]
    assert len(hidden) > 3 and not seen[hidden].any()
    assert seen[bare].mean() > 0.95
