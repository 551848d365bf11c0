"""Scenes drawn by lot: always the same ones, unlike each other, before the camera, and chosen by name."""

from dataclasses import asdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.rendered_heads import Scene, scene_motion, stranger
from benchmarks.strangers import UNSEEN, drawn, number_of, strangers
from benchmarks.tracking import ground_truths
from tracker.head import HeadModel, load_head
from tracker.raster import project

FURTHER = range(101, 121)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return load_head()


def test_a_number_draws_one_scene_and_another_another() -> None:
    assert drawn(7) == drawn(7)
    scenes = [drawn(number) for number in FURTHER]
    assert len({scene.seed for scene in scenes}) == len(scenes)
    for name in ("size", "focal", "head", "skin", "hair", "key_light", "glasses", "fringe", "hand"):
        assert len({asdict(scene)[name] for scene in scenes}) > 1, name


def test_scenes_are_what_people_film() -> None:
    for scene in (drawn(number) for number in range(1, 300)):
        assert 0.35 <= scene.focal * max(scene.size) / scene.face_px_per_m <= 1.0
        assert min(scene.size) >= 640 and not (scene.glasses and scene.fringe)
        assert all(0 < part <= 1.06 for part in (*scene.skin, *scene.hair))


@pytest.mark.parametrize("scene", [scene for _, scene in strangers(set())], ids=lambda scene: scene.name)
def test_an_unseen_face_stays_in_the_picture_and_its_lips_meet(head: HeadModel, scene: Scene) -> None:
    person, moves = stranger(head, scene), scene_motion(scene)
    face = person.template[head.regions["face"]].astype(np.float64)
    turned = np.einsum("tij,vj->tvi", Rotation.from_rotvec(moves.rotation).as_matrix(), face)
    centre = [(side - 1) / 2 for side in scene.size]
    posed = (turned + moves.translation[:, None]).reshape(-1, 3)
    pixels = project(posed, scene.focal * max(scene.size), centre)
    assert (pixels > 0).all() and (pixels < scene.size).all()
    gap = person.lip_gap_mm(person.vertices(np.zeros(1), moves.expression_for(head.expression_names)))
    assert -0.5 < gap.min() < 0.3 and gap.max() > 5


def test_strangers_are_chosen_by_name() -> None:
    def chosen(*names: str) -> list[tuple[str, str]]:
        return [(group, scene.name) for group, scene in strangers(set(names))]

    assert chosen() == [("unseen", f"stranger{n}") for n in range(1, UNSEEN + 1)]
    assert chosen("hand", "stranger104", "stranger2") == [("unseen", "stranger2"), ("further", "stranger104")]
    assert strangers({"hand"}) == []
    names = ("stranger12", "stranger", "astranger1", "stranger1b")
    assert [number_of(name) for name in names] == [12, None, None, None]


def test_the_bench_watches_the_strangers_chosen(head: HeadModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.tracking.film", lambda scene, head: (scene.name, "truth"))
    monkeypatch.setattr("benchmarks.tracking.watched", lambda video, head, mm: f"watched {video} {mm}")
    (found,) = ground_truths(head, {"stranger8"})
    assert found == ("further", "stranger8", "watched stranger8 0.0", "truth")
