"""The bench's films: the landmarker finds their faces where the truth has them, props cover what they should."""

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.films import MADE_BY, Studio, film, film_key, shoot
from benchmarks.ground_truth import GroundTruth
from benchmarks.rendered_heads import SCENES, SPEECH, Scene, scene_motion, stranger
from personalize.pictures import FrameReader
from personalize.render.mouth import furnished
from tests.personalize.mouth_view import assert_seen_between_parted_lips_only
from tracker.head import HeadModel, load_head
from tracker.landmarker import track_landmarks
from tracker.raster import project

SCENE = Scene("tiny", 5, seconds=0.2, head=0.5)
ROOT = Path(__file__).parents[2]
MOVING = ("expression", "rotation", "translation", "eyes")
# What is imported and changes no film: where and how files lie, types, sound, heads of another kind.
NO_MAKERS = {
    *("model/files.py", "personalize/feature_cache.py", "personalize/files.py", "personalize/sound.py"),
    *("tracker/skinning.py", "tracker/track.py"),
}


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, GroundTruth]:
    path = tmp_path_factory.mktemp("films") / "tiny.mp4"
    return path, shoot(SCENE, load_head(), path)


def test_landmarks_lie_on_the_true_face(shot: tuple[Path, GroundTruth]) -> None:
    path, truth = shot
    landmarks = track_landmarks(FrameReader(path), 5, set())
    assert (landmarks.presence > 0.9).all()
    posed = (truth.neutral + truth.displacement) @ truth.rotation.transpose(0, 2, 1) + truth.translation[
        :, None
    ]
    centre = [(side - 1) / 2 for side in SCENE.size]
    assert truth.vertices is not None
    upper = np.searchsorted(truth.vertices, load_head().regions["inner_lip_upper"])
    corners = project(posed[:, upper[[0, -1]]], truth.focal, centre)
    found = landmarks.points[:, [78, 308], :2]
    width = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1)
    assert (np.linalg.norm(found - corners, axis=-1) < 0.15 * width[:, None]).all()


def test_same_scene_same_film(shot: tuple[Path, GroundTruth], tmp_path: Path) -> None:
    path, truth = shot
    again = shoot(SCENE, load_head(), tmp_path / "again.mp4")
    assert (tmp_path / "again.mp4").read_bytes() == path.read_bytes()
    np.testing.assert_array_equal(again.displacement, truth.displacement)


def test_hand_covers_the_mouth_for_half_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.props.HAND_S", (0.04, 0.04, 0.08))
    truth = shoot(replace(SCENE, hand=True, seconds=0.32), load_head(), tmp_path / "hand.mp4")
    np.testing.assert_array_equal(truth.covered > 0.5, [False, False, True, True, True, False, False, False])


@pytest.mark.parametrize("shift", [(0.4, 0, 0), (0, 0.12, 0)], ids=["head", "mouth"])
def test_lips_outside_the_picture_count_as_covered(shift: tuple[float, float, float]) -> None:
    person, moves = furnished(stranger(load_head(), SCENE)), scene_motion(SCENE)
    away = replace(moves, translation=moves.translation + np.float32(shift))
    picture, covered = Studio(SCENE, person, away).picture(0, person.template)
    assert covered == 1 and picture.shape == (640, 640, 3)


def test_no_motion_blurs_across_a_cut() -> None:
    scene = replace(SCENE, seconds=0.4, shot_s=0.2, noise=0.0, head=1.5)
    person, moves = furnished(stranger(load_head(), scene)), scene_motion(scene)
    moves.translation[5:, 0] += 0.05
    ended = replace(moves, **{name: getattr(moves, name)[:5] for name in MOVING})
    whole, alone = (Studio(scene, person, seen).picture(4, person.template)[0] for seen in (moves, ended))
    np.testing.assert_array_equal(whole, alone)


@pytest.mark.parametrize("scene", [s for s in SCENES if s.speaks], ids=lambda scene: scene.name)
def test_teeth_are_seen_between_parted_lips_only(scene: Scene) -> None:
    person = furnished(stranger(load_head(), scene))
    weights = scene_motion(scene).expression_for(person.expression_names)
    assert_seen_between_parted_lips_only(person, person.vertices(np.zeros(1), weights))


def test_a_film_is_made_once(shot: tuple[Path, GroundTruth], monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Path] = []

    def shoot_once(scene: Scene, head: HeadModel, path: Path) -> GroundTruth:
        made.append(path)
        return shot[1]

    monkeypatch.setattr("benchmarks.films.shoot", shoot_once)
    (path, truth), (again, read) = film(SCENE, load_head()), film(SCENE, load_head())
    film(replace(SCENE, noise=1.0), load_head())
    assert again == path and made[0] == path and len(made) == 2
    np.testing.assert_allclose(read.displacement, truth.displacement, atol=1e-5)
    np.testing.assert_array_equal(read.vertices, truth.vertices)


def test_another_look_is_another_film() -> None:
    head = load_head()
    redder, lips = head.albedo.copy(), head.regions["lips"]
    redder[lips[0], 0] -= 1
    others = [
        replace(head, albedo=redder),
        replace(head, regions=head.regions | {"lips": lips[1:]}),
        replace(head, joints=head.joints | {"left_eye": head.joints["right_eye"]}),
    ]
    keys = [film_key(SCENE, head), *(film_key(SCENE, other) for other in others)]
    assert len(set(keys)) == 4 and film_key(SCENE, replace(head, name="same")) == keys[0]


def test_another_speech_is_another_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = film_key(SCENE, load_head())
    (tmp_path / "speech.json").write_text(SPEECH.read_text() + "\n")
    monkeypatch.setattr("benchmarks.rendered_heads.SPEECH", tmp_path / "speech.json")
    assert film_key(SCENE, load_head()) != key


def test_all_code_that_films_come_from_is_in_their_key() -> None:
    def imported(path: Path) -> Iterator[str]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
                yield from (f"{name.replace('.', '/')}.py" for name in names)

    makers = {Path(str(file)) for file in MADE_BY}
    needed = {name for maker in makers for name in imported(maker) if (ROOT / name).is_file()}
    assert needed - {str(maker.relative_to(ROOT)) for maker in makers} == NO_MAKERS
