"""A user's FLAME files become the run's head; every wrong one is a single line."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from personalize.errors import UserError
from personalize.heads import head_assets, read_embedding, read_flame, run_head
from personalize.settings import Settings
from tests.flame_factory import EMBEDDED, FakeFlame
from tracker.head import load_head
from tracker.landmark_indices import IBUG_51

FAKE = FakeFlame()


def settings(path: Path, embedding: Path | None = None) -> Settings:
    return Settings(head=str(path), head_embedding=None if embedding is None else str(embedding))


def test_without_a_file_the_embedded_head_is_used() -> None:
    assert run_head(Settings()) is load_head()
    assets = head_assets(Settings())
    assert assets["head"] == load_head().sha256
    assert set(assets) == {"head", "head_embedding"}
    with pytest.raises(UserError, match="belongs to a --head"):
        run_head(Settings(head_embedding="a.npz"))


@pytest.mark.parametrize("chumpy", [False, True])
def test_the_files_of_old_and_new_are_one_head(tmp_path: Path, chumpy: bool) -> None:
    head = run_head(settings(FAKE.write(tmp_path, protocol=2, chumpy=chumpy)))
    assert head.name == "flame2023" and head.signed and head.identity_basis.shape[0] == 300
    assert set(head.landmark_embedding.landmarks) == {*EMBEDDED, 468, 473}
    identity, expression = (
        np.random.default_rng(0).normal(0, 1, (2, 400))[0].reshape(4, 100)[:3].ravel(),
        np.ones(100),
    )
    expected = FAKE.vertices(identity, expression, jaw=np.array([0.2, 0.1, 0]))
    assert np.abs(head.vertices(identity, expression, jaw=[0.2, 0.1, 0]) - expected).max() < 1e-6


def test_masks_beside_the_head_are_read(tmp_path: Path) -> None:
    path = FAKE.write(tmp_path)
    (tmp_path / "FLAME_masks.pkl").write_bytes(pickle.dumps({"lips": np.array([7, 9])}, 2))
    assert run_head(settings(path)).regions["lips"].tolist() == [7, 9]
    assert set(head_assets(settings(path))) == {"head", "head_embedding", "head_masks"}


def test_the_static_embedding_names_its_points(tmp_path: Path) -> None:
    points = read_embedding(FAKE.write_static(tmp_path))
    assert tuple(points.landmarks) == IBUG_51
    head = read_flame(FAKE.write(tmp_path), tmp_path / "flame_static_embedding.pkl")
    assert {13, 14, 468, 473} <= set(head.landmark_embedding.landmarks)


def refused(path: Path, embedding: Path | None = None) -> str:
    with pytest.raises(UserError) as caught:
        run_head(settings(path, embedding))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_wrong_files_are_refused_in_one_line(tmp_path: Path) -> None:
    path = FAKE.write(tmp_path)
    good = tmp_path / "mediapipe_landmark_embedding.npz"
    assert "there is no file" in refused(tmp_path / "absent.pkl", good)
    assert "there is no file" in refused(path, tmp_path / "absent.npz")
    assert "is a .npz or a .pkl" in refused(path, tmp_path / "landmark_embedding.npy")
    torn = tmp_path / "torn.pkl"
    for kept in (5000, -8):
        torn.write_bytes(path.read_bytes()[:kept])
        assert "not a readable pickle" in refused(torn, good)
    np.savez_compressed(tmp_path / "damaged.npz", **FAKE.embedding(EMBEDDED))
    content = bytearray((tmp_path / "damaged.npz").read_bytes())
    content[80:90] = bytes(10)
    (tmp_path / "damaged.npz").write_bytes(content)
    assert "not a readable .npz" in refused(path, tmp_path / "damaged.npz")
    other = tmp_path / "other.pkl"
    other.write_bytes(pickle.dumps({"v_template": FAKE.content["v_template"]}))
    assert "is missing" in refused(other, good)
    for name, data, message in (
        ("keys", {"a": np.zeros(3)}, "lacks lmk_face_idx"),
        (
            "object",
            dict.fromkeys(("lmk_face_idx", "lmk_b_coords", "landmark_indices"), np.array([{}])),
            "plain arrays",
        ),
        ("far", FAKE.embedding(EMBEDDED) | {"lmk_face_idx": np.full(len(EMBEDDED), 10**6)}, "another head"),
        ("flat", FAKE.embedding(EMBEDDED) | {"lmk_b_coords": np.zeros(5)}, "must be as many"),
        ("single", FAKE.embedding(EMBEDDED) | {"lmk_b_coords": np.float64(1)}, "must be as many"),
    ):
        np.savez(tmp_path / f"{name}.npz", **data)
        assert message in refused(path, tmp_path / f"{name}.npz")
    good.unlink()
    assert "landmark embedding is needed" in refused(path)
    assert "there is no file" in refused(tmp_path / "nowhere.pkl")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"f": np.zeros((0, 3), np.uint32)}, "0 faces"),
        ({"v_template": [[0.0, 0.0, 0.0], [0.0]]}, "v_template is no array"),
        ({"v_template": np.zeros_like(FAKE.content["v_template"])}, "in one place or on one line"),
    ],
)
def test_a_damaged_head_is_refused_in_one_line(tmp_path: Path, change: dict, message: str) -> None:
    path = FAKE.write(tmp_path)
    path.write_bytes(pickle.dumps(FAKE.content | change, 2))
    said = refused(path)
    assert message in said and str(path) in said


def test_masks_that_are_no_lists_of_vertices_are_refused_in_one_line(tmp_path: Path) -> None:
    path, masks = FAKE.write(tmp_path), tmp_path / "FLAME_masks.pkl"
    for wrong in ([[1, 2], [3]], ["lips"], [0.5]):
        masks.write_bytes(pickle.dumps({"lips": wrong}, 2))
        said = refused(path)
        assert said.startswith(f"{masks}: lips is no") and "get the file again" in said


def test_an_embedding_with_too_few_landmarks_for_a_pose_is_refused_before_any_work(tmp_path: Path) -> None:
    path, few = FAKE.write(tmp_path), tmp_path / "few.npz"
    for landmarks, count in (((13, 14), 0), ((13, 14, 33, 263), 2)):
        np.savez(few, **FAKE.embedding(landmarks))
        said = refused(path, few)
        assert f"few.npz: the landmark embedding holds {count} landmarks" in said and "give one with" in said
