"""Overlay modes on a head rendered in known colours: they draw on the face alone, and say how well it fits."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracker.albedo import Rendering, learn_albedo, rerender
from tracker.head import HeadModel, load_head
from tracker.overlay import DETECTED, FITTED, MODES, NEEDS_ALBEDO, draw
from tracker.raster import render
from tracker.scene import OUTSIDE, Crop, Scene, place, scene
from tracker.track import Landmarks, Track

SIZE, FOCAL, FRAMES = (360, 300), 700.0, 6
WHOLE = Crop((0, 0), SIZE, SIZE)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


@pytest.fixture(scope="module")
def track(head: HeadModel) -> Track:
    """A head that turns a little from frame to frame and opens its mouth."""
    turn = Rotation.from_euler("y", np.linspace(-12, 12, FRAMES)[:, None], degrees=True)
    expression = np.zeros((FRAMES, len(head.expression_names)), np.float32)
    expression[:, head.expression_names.index("jawOpen")] = np.linspace(0, 0.4, FRAMES)
    still = np.zeros((FRAMES, 3), np.float32)
    facing = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    return Track(
        time=np.arange(FRAMES) / 25,
        valid=np.ones(FRAMES, bool),
        confidence=np.ones(FRAMES, np.float32),
        identity=np.zeros(len(head.identity_basis), np.float32),
        expression=expression,
        jaw=still,
        neck=still,
        eyes=np.zeros((FRAMES, 2, 3), np.float32),
        rotation=(turn * facing).as_rotvec().astype(np.float32),
        translation=np.tile(np.array([0, 0, 0.75], np.float32), (FRAMES, 1)),
        focal=FOCAL,
        principal=np.array([179.5, 149.5], np.float32),
        distortion=np.zeros(0, np.float32),
        size=SIZE,
        head=head.name,
        lip_gap_mm=np.zeros(FRAMES, np.float32),
        reprojection_px=np.zeros(FRAMES, np.float32),
    )


@pytest.fixture(scope="module")
def landmarks(track: Track, head: HeadModel) -> Landmarks:
    """Detected points 6 px to the right of the fitted ones."""
    points = np.full((FRAMES, 478, 3), np.nan, np.float32)
    for frame in range(FRAMES):
        at = place(track, frame, head)[1]
        points[frame, head.landmark_embedding.landmarks, :2] = (
            FOCAL * at[:, :2] / at[:, 2:] + track.principal + (6, 0)
        )
    return Landmarks(track.time, points, track.confidence, np.zeros((FRAMES, 52), np.float32), (), SIZE)


def film(track: Track, head: HeadModel, frame: int) -> np.ndarray:
    vertices, _ = place(track, frame, head)
    return render(vertices, head.faces, head.albedo, FOCAL, tuple(track.principal.tolist()), SIZE)


@pytest.fixture(scope="module")
def scenes(track: Track, landmarks: Landmarks, head: HeadModel) -> list[Scene]:
    return [scene(film(track, head, n), WHOLE, track, n, landmarks, head) for n in range(FRAMES)]


def test_a_crop_maps_points_as_it_maps_the_picture() -> None:
    rgb = np.zeros((60, 80, 3), np.uint8)
    rgb[30:34, 40:44] = 255  # its middle is at 31.5, 41.5
    for crop in (Crop((20, 10), (40, 40), (80, 120)), Crop((-20, 20), (80, 60), (40, 30))):
        shown = np.maximum(crop.picture(rgb)[..., 0].astype(float) - OUTSIDE[0], 0)
        y, x = np.mgrid[: shown.shape[0], : shown.shape[1]]
        middle = np.array([(x * shown).sum(), (y * shown).sum()]) / shown.sum()
        assert shown.shape == crop.size[::-1]
        np.testing.assert_allclose(middle, crop.place(np.array([41.5, 31.5])), atol=0.05)


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


def test_the_rendering_comes_near_the_picture_and_less_so_at_a_wrong_pose(
    scenes: list[Scene], track: Track, landmarks: Landmarks, head: HeadModel
) -> None:
    albedo = learn_albedo(scenes)

    def error(one: Scene) -> float:
        rendering = rerender(one, albedo)
        difference = cv2.absdiff(rendering.colour, rendering.blurred)[rendering.known > 0]
        return float(difference.mean())

    right = [error(one) for one in scenes]
    wrong = scene(film(track, head, 1), WHOLE, track, 4, landmarks, head)
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
    assert one.detected[cheek, 0] - one.fitted[cheek, 0] == pytest.approx(6, abs=1e-3)


def test_a_face_outside_of_the_part_shown_leaves_it_as_it_is(
    track: Track, landmarks: Landmarks, head: HeadModel
) -> None:
    away = scene(film(track, head, 0), Crop((0, 0), (40, 40), (80, 80)), track, 0, landmarks, head)
    assert (draw(away, "shaded", head, None) == away.picture).all()
