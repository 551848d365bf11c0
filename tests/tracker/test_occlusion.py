"""A textured face that moves: what covers or blurs it is told from what it does itself."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tracker.confidence import UNLIKE_LIPS, UNLIKE_LIPS_HALF
from tracker.head import load_head
from tracker.landmark_indices import BLENDSHAPE_NAMES, LIPS, POINTS
from tracker.occlusion import CONTRAST, FaceWatch, _contrasts, _logs, _unlike, regions
from tracker.track import Landmarks

FRAMES, SIDE = 60, 240
FACE_PX = 700.0  # pixels a metre: the face is about 100 px wide


def face_points() -> np.ndarray:
    """[478, 2] px of the mean face in the middle of the picture; points that the head lacks lie on its nose."""
    head = load_head()
    known = head.landmark_positions(np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_basis)))
    points = np.repeat(known.mean(0)[None], POINTS, axis=0)
    points[head.landmark_embedding.landmarks] = known
    middle = (points.max(0) + points.min(0)) / 2
    return SIDE / 2 + FACE_PX * (points - middle)[:, :2] * [1, -1]


POINTS_PX = face_points()
MOUTH_PX = [
    (POINTS_PX[list(LIPS)].min(0) - 14).round().astype(int).tolist(),
    (POINTS_PX[list(LIPS)].max(0) + 14).round().astype(int).tolist(),
]


def texture(seed: int) -> np.ndarray:
    """[SIDE, SIDE, 3] u8, blotches as large as lips and cheekbones, and pores."""
    noise = np.random.default_rng(seed).normal(size=(SIDE, SIDE, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 7)
    return np.clip(130 + 28 * smooth / smooth.std() + 8 * noise, 0, 255).astype(np.uint8)


def placement(frame: int) -> np.ndarray:
    """[2, 3]: the face sways, nods and comes nearer."""
    turn = cv2.getRotationMatrix2D(
        (SIDE / 2, SIDE / 2), 8 * np.sin(0.2 * frame), 1 + 0.08 * np.sin(0.13 * frame)
    )
    turn[:, 2] += [6 * np.sin(0.11 * frame), 4 * np.cos(0.17 * frame)]
    return turn


def clip(covered=None, spoil=None, wide=1.0, cover=None) -> tuple[list, Landmarks]:
    """Frames and their landmarks.

    covered: [T] share 0..1 of the mouth's box that a `cover` [SIDE, SIDE, 3], a thing with a texture of its own if none
    is given, has reached from below. wide: share of its width.
    """
    cover = texture(7) if cover is None else cover
    frames, points = [], np.zeros((FRAMES, POINTS, 3), np.float32)
    own = texture(0)
    for frame in range(FRAMES):
        picture = own.copy()
        if covered is not None and covered[frame] > 0:
            (left, low), (right, high) = MOUTH_PX
            rows = slice(round(high - covered[frame] * (high - low)), high)
            columns = slice(left, round(left + wide * (right - left)))
            picture[rows, columns] = cover[rows, columns]
        gain = 1 + 0.25 * np.sin(0.3 * frame)  # the camera adjusts its exposure
        matrix = placement(frame)
        picture = cv2.warpAffine(picture, matrix, (SIDE, SIDE), borderMode=cv2.BORDER_REFLECT)
        picture = np.clip(picture * gain, 0, 255).astype(np.uint8)
        frames.append((frame / 25, picture if spoil is None else spoil(frame, picture)))
        points[frame, :, :2] = POINTS_PX @ matrix[:, :2].T + matrix[:, 2]
    scores = np.zeros((FRAMES, len(BLENDSHAPE_NAMES)), np.float32)
    time, presence = np.arange(FRAMES) / 25, np.ones(FRAMES, np.float32)
    return frames, Landmarks(time, points, presence, scores, BLENDSHAPE_NAMES, (SIDE, SIDE))


def look(frames, landmarks, usable=None):
    watch = FaceWatch()
    for (_, rgb), points in zip(frames, landmarks.points):
        watch.see(rgb, points)
    return watch.appearance(np.ones(len(frames), bool) if usable is None else usable)


def test_a_bare_face_that_moves_in_changing_light_is_itself():
    seen = look(*clip())
    assert seen.strangeness.max() < 0.08
    assert seen.sharpness.min() > 0.8 and seen.sharpness.max() < 1.4


@pytest.mark.parametrize("rise", [1, 15])
def test_a_mouth_that_is_covered_looks_strange_whether_it_came_at_once_or_slowly(rise):
    covered = np.clip((np.arange(FRAMES) - 25) / rise, 0, 1)
    covered[45:] = 0
    seen = look(*clip(covered))
    assert seen.strangeness[covered > 0.6].min() > 0.3
    assert seen.strangeness[covered == 0].max() < 0.08


@pytest.mark.parametrize("rise", [3, 12])
def test_a_mouth_that_is_covered_on_one_side_looks_strange_however_slowly_it_came(rise):
    covered = np.clip((np.arange(FRAMES) - 22) / rise, 0, 1)
    covered[45:] = 0
    seen = look(*clip(covered, wide=0.4, cover=np.full((SIDE, SIDE, 3), 130, np.uint8)))
    assert seen.strangeness[covered == 1].min() > 0.22
    assert seen.strangeness[covered == 0].max() < 0.08


SKIN = np.array([1.25, 0.85, 0.75])


def tinted(cover=None, light=1.0, low=False):
    """Skin with red lips in some light, which a `cover` of one colour hides from the first frame to the last.

    low: it hides the lower lip alone.
    """

    def picture_of(frame, picture):
        matrix = placement(frame)
        shown = picture * SKIN
        lips = cv2.convexHull((POINTS_PX[list(LIPS)] @ matrix[:, :2].T + matrix[:, 2]).astype(np.float32))
        inside = np.zeros((SIDE, SIDE), np.uint8)
        cv2.fillConvexPoly(inside, lips.round().astype(int), 1)
        shown[inside == 1] *= [1.0, 0.8, 0.85]
        if cover is not None:
            wide = cv2.dilate(inside, np.ones((15, 15), np.uint8))
            if low:
                wide[: round((POINTS_PX[13] @ matrix[:, :2].T + matrix[:, 2])[1])] = 0
            shown[wide == 1] = cover
        return np.clip(shown * light, 0, 255).astype(np.uint8)

    return picture_of


BLUE_LIGHT = np.array([0.35, 0.6, 1.1])
# Most of the face in red light, the rest in blue.
SIDE_LIT = (np.arange(SIDE) < 0.54 * SIDE)[None, :, None]
TWO_LIGHTS = np.where(SIDE_LIT, np.array([1.2, 0.5, 0.5]), np.array([0.6, 0.55, 1.1]))


@pytest.mark.parametrize("low", [False, True])
@pytest.mark.parametrize("cover", [(38, 36, 36), (90, 140, 180)])
def test_what_covers_the_lips_all_the_time_is_told_by_its_colour(cover, low: bool):
    seen = look(*clip(spoil=tinted(cover, low=low)))
    assert seen.strangeness.max() < 0.1  # it is the clip's own pattern
    assert seen.unlike_lips.min() > UNLIKE_LIPS_HALF


def test_what_covers_the_lips_for_most_of_the_clip_is_not_its_pattern():
    bare, covered = tinted(), tinted((38, 36, 36))
    seen = look(*clip(spoil=lambda frame, picture: (bare if frame < 12 else covered)(frame, picture)))
    assert seen.strangeness[:12].max() < 0.08 and seen.unlike_lips[:12].max() < 0.05
    assert seen.strangeness[12:].min() > 0.2 and seen.unlike_lips[12:].min() > UNLIKE_LIPS_HALF


@pytest.mark.parametrize("light", [1.0, 0.2, BLUE_LIGHT, TWO_LIGHTS])
def test_lips_are_as_red_as_skin_in_any_light(light):
    assert look(*clip(spoil=tinted(light=light))).unlike_lips.max() < 0.1 < UNLIKE_LIPS


def test_without_colours_nothing_is_told_of_lips_that_are_not_red():
    def grey(frame, picture):
        shown = cv2.cvtColor(tinted((38, 36, 36))(frame, picture), cv2.COLOR_RGB2GRAY)
        return np.repeat(shown[..., None], 3, axis=2)

    assert look(*clip(spoil=grey)).unlike_lips.max() == 0


def lifted(frames, landmarks, cut_px):
    """The same without the upper cut_px [T] px of each picture, whose face then lies as much higher."""
    points = landmarks.points.copy()
    points[:, :, 1] -= cut_px[:, None]
    cut = [(time, rgb[c:]) for (time, rgb), c in zip(frames, cut_px)]
    return cut, replace(landmarks, points=points)


def test_a_forehead_outside_of_the_picture_is_no_cover():
    """Of a head that leaves the picture at its upper edge again and again; covers of its mouth are still seen."""
    top = int(POINTS_PX[:, 1].min())
    cut_px = np.where(np.arange(FRAMES) % 12 < 5, top + 45, 0)
    seen = look(*lifted(*clip(), cut_px))
    assert seen.strangeness.max() < 0.08
    covered = np.zeros(FRAMES)
    covered[26:34] = 1.0
    seen = look(*lifted(*clip(covered), cut_px))
    assert seen.strangeness[covered == 1].min() > 0.3
    assert seen.strangeness[covered == 0].max() < 0.08


def test_lips_beyond_the_pictures_edge_are_told():
    frames, landmarks = clip()
    lips = POINTS_PX[list(LIPS), 1]
    rows = np.where(np.arange(FRAMES) < 30, SIDE, int(np.median(lips)))
    still = [(time, frames[0][1][:low]) for (time, _), low in zip(frames, rows)]
    landmarks.points[..., :2] = POINTS_PX
    landmarks.points[40:50] = np.nan
    seen = look(still, landmarks)
    expected = np.where(rows < SIDE, (lips > rows[-1] - 1).mean(), 0)
    expected[40:50] = 0
    assert 0.3 < expected.max() < 0.9
    np.testing.assert_allclose(seen.outside, expected)


def test_lips_beyond_the_pictures_edge_are_no_covered_ones():
    low = int(POINTS_PX[list(LIPS), 1].min()) - 4
    landmarks = clip()[1]
    still = [(frame / 25, tinted()(0, texture(0))[:low]) for frame in range(FRAMES)]
    still = [(time, np.concatenate([rgb[:-2], np.full_like(rgb[:2], 40)])) for time, rgb in still]
    landmarks.points[..., :2] = POINTS_PX
    assert look(still, landmarks).unlike_lips.max() == 0


def test_light_that_comes_from_elsewhere_little_by_little_is_no_cover():
    across = np.linspace(-1, 1, SIDE)[None, :, None]

    def swept(frame, picture):
        """The light wanders from the left to the right, and stays on the left most of the time."""
        side = np.clip((frame - 30) / 20, 0, 1) * 2 - 1
        return np.clip(picture * (1 - 0.75 * side * across), 0, 255).astype(np.uint8)

    assert look(*clip(spoil=swept)).strangeness.max() < 0.1


def test_a_blurred_frame_is_less_sharp_than_the_clip():
    def shake(frame, picture):
        return cv2.blur(picture, (21, 3)) if frame in (20, 21) else picture

    seen = look(*clip(spoil=shake))
    assert seen.sharpness[20:22].max() < 0.55 < 0.8 < np.delete(seen.sharpness, [20, 21]).min()


def test_frames_without_a_face_say_nothing():
    frames, landmarks = clip()
    landmarks.points[10:20] = np.nan
    seen = look(frames, landmarks)
    assert (seen.strangeness[10:20] == 0).all() and (seen.sharpness[10:20] == 1).all()
    landmarks.points[:] = np.nan
    nothing = look(frames, landmarks)
    assert (nothing.strangeness == 0).all() and (nothing.sharpness == 1).all()


def test_another_person_is_not_the_measure():
    """In the second half somebody else is in the picture; those frames are not usable, and say nothing."""
    other = cv2.GaussianBlur(texture(3), (0, 0), 1)
    frames, landmarks = clip(spoil=lambda frame, own: cv2.add(own // 4, other) if frame >= 25 else own)
    usable = np.arange(FRAMES) < 25
    seen = look(frames, landmarks, usable)
    assert seen.strangeness.max() < 0.08 and (seen.strangeness[25:] == 0).all()
    assert look(frames, landmarks).strangeness.max() > 0.3


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_few_frames_are_not_called_strange(count):
    frames, landmarks = clip()
    landmarks.points[count:] = np.nan
    assert look(frames, landmarks).strangeness.max() < 0.1


def test_an_all_black_clip_is_finite():
    frames, landmarks = clip(spoil=lambda _, picture: 0 * picture)
    seen = look(frames, landmarks)
    assert np.isfinite(seen.sharpness).all() and seen.strangeness.max() < 1e-6


def test_the_regions_are_apart_and_leave_out_eyes_and_rim():
    right, left, *upper = (set(part.tolist()) for part in regions(POINTS_PX, np.ones(len(POINTS_PX), bool)))
    mouth = right | left
    together = set.union(mouth, *upper)
    assert len(together) == len(mouth) + sum(map(len, upper))
    assert set(LIPS) <= mouth and {61, 78} <= right - left and {291, 308} <= left - right
    assert {0, 13, 14, 17} <= right & left and len(right & left) < 0.25 * len(mouth)
    assert not {159, 145, 386, 374, 10, 152, 234, 454} & together
    assert min(map(len, (right, left, *upper))) > 40


def test_what_lies_outside_of_a_picture_is_as_bright_as_the_rest_of_it():
    random = np.random.default_rng(0)
    usual = random.integers(60, 200, (1, 30, 3)).astype(np.uint8)
    inside = np.arange(30)[None] < 20
    dim = (0.4 * usual).astype(np.uint8)
    whole = _contrasts(dim, np.ones_like(inside), _logs(usual)[0])
    dim[:, 20:] = 255  # the border's
    np.testing.assert_allclose(_contrasts(dim, inside, _logs(usual)[0]), whole, atol=0.12)


def test_patterns_that_are_hardly_there_cannot_be_told_apart():
    faint, other = 0.1 * CONTRAST * np.random.default_rng(0).normal(size=(2, 60))
    none = np.zeros((0, 60))
    assert _unlike(faint[None], np.ones((1, 60), bool), other, none)[0] < 0.05
    assert _unlike(100 * faint[None], np.ones((1, 60), bool), 100 * other, none)[0] > 0.5
