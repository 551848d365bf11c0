"""The head that a run is tracked with: the embedded one, or a user's FLAME file with its landmark embedding."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from personalize.errors import UserError
from personalize.files import sha256_file
from personalize.restricted_pickle import read_pickle
from personalize.settings import Settings
from personalize.user_arrays import read_user_npz
from tracker.flame import ARRAYS, EmbeddedPoints, flame_head
from tracker.head import ASSET, HeadModel, load_head
from tracker.landmark_indices import IBUG_51
from tracker.track import TrackError

# Under their publishers' names, looked for beside the head.
EMBEDDINGS = ("mediapipe_landmark_embedding.npz", "flame_static_embedding.pkl")
MASKS = "FLAME_masks.pkl"
EMBEDDING_KEYS = ("lmk_face_idx", "lmk_b_coords", "landmark_indices")


def run_head(settings: Settings) -> HeadModel:
    """The settings' head. Raises UserError, in one line, for whatever is wrong with its files."""
    if settings.head is None:
        if settings.head_embedding is not None:
            raise UserError("--head-embedding belongs to a --head; give that too")
        return load_head()
    return read_flame(*_files(settings))


def head_assets(settings: Settings) -> dict[str, str]:
    """The head by content, for the keys of the stages that use it."""
    if settings.head is None:
        return {
            "head": load_head().sha256,
            "head_embedding": sha256_file(ASSET.with_suffix(".landmarks.npz")),
        }
    path, embedding = _files(settings)
    run_head(settings)  # says what is missing
    masks = path.parent / MASKS
    return {"head": sha256_file(path), "head_embedding": sha256_file(embedding)} | (
        {"head_masks": sha256_file(masks)} if masks.is_file() else {}
    )


@lru_cache(maxsize=2)
def read_flame(path: Path, embedding: Path) -> HeadModel:
    """FLAME from its pickle, a landmark embedding and, where it lies beside the pickle, FLAME_masks.pkl."""
    content = read_pickle(path)
    arrays = {key: _dense(path, key, content[key]) for key in ARRAYS if key in content}
    try:
        head = flame_head(path.stem, arrays, read_embedding(embedding), _masks(path.parent / MASKS))
    except TrackError as error:
        raise UserError(f"{path} with {embedding.name}: {error}") from error
    return head


def read_embedding(path: Path) -> EmbeddedPoints:
    """Landmarks on FLAME's surface: MediaPipe's 105 as .npz, or iBUG's 51 as .pkl."""
    if path.suffix == ".npz":
        data: dict[Any, Any] = read_user_npz(path, EMBEDDING_KEYS)
    elif path.suffix == ".pkl":
        data = {"landmark_indices": IBUG_51} | read_pickle(path)
    else:
        raise UserError(
            f"{path}: a landmark embedding is a .npz or a .pkl; give one of {', '.join(EMBEDDINGS)}"
        )
    try:
        triangles, shares, landmarks = (np.asarray(data[key]) for key in EMBEDDING_KEYS)
        points = EmbeddedPoints(
            landmarks.astype(np.int32).ravel(), triangles.astype(np.int32).ravel(), shares.astype(np.float32)
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"{path} is not a landmark embedding ({error}); give one of {', '.join(EMBEDDINGS)}"
        ) from error
    return points


def _files(settings: Settings) -> tuple[Path, Path]:
    assert settings.head is not None
    path = Path(settings.head)
    if not path.is_file():
        raise UserError(f"--head: there is no file {path}; give a FLAME model, such as flame2023.pkl")
    if settings.head_embedding is not None:
        return path, Path(settings.head_embedding)
    for name in EMBEDDINGS:
        if (path.parent / name).is_file():
            return path, path.parent / name
    raise UserError(
        f"{path}: a landmark embedding is needed too; put {' or '.join(EMBEDDINGS)} beside it or give --head-embedding"
    )


def _dense(path: Path, name: str, value: Any) -> NDArray[Any]:
    """An entry of a pickle as an array. Raises UserError for lists in it that are not equally long."""
    try:
        return value.toarray() if sparse.issparse(value) else np.asarray(value)
    except ValueError as error:
        raise UserError(f"{path}: {name} is no array ({error}); get the file again") from error


def _masks(path: Path) -> dict[str, NDArray[np.int32]]:
    if not path.is_file():
        return {}
    masks = {str(name): _dense(path, name, index).ravel() for name, index in read_pickle(path).items()}
    for name, index in masks.items():
        if index.dtype.kind not in "iu":
            raise UserError(f"{path}: {name} is not a list of vertices; get the file again")
    return {name: index.astype(np.int32) for name, index in masks.items()}
