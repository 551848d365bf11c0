"""A small FLAME of our own: the real file's keys, shapes and structure on a few hundred vertices of the embedded head.

Its vertices are the embedded head's landmarks, two eyeballs and a ring at the neck, so that it looks and moves like a
face; and a reference that poses it as FLAME's paper writes it, in double precision, vertex by vertex.
"""

from __future__ import annotations

import pickle
import sys
import types
from pathlib import Path

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from tracker.head import load_head
from tracker.landmark_indices import IBUG_51, INNER_LIP_LOWER, INNER_LIP_UPPER, LEFT_EYE, LIPS, RIGHT_EYE

IDENTITIES, EXPRESSIONS = 300, 100
ARKIT = 52  # shapes of the embedded head, whose others are the lips' profile's
NOSE_BROWS = (168, 6, 197, 195, 5, 4, 1, 2, 98, 327, 70, 63, 105, 66, 107, 336, 296, 334, 293, 300)
EMBEDDED = tuple(
    dict.fromkeys((*NOSE_BROWS, *LEFT_EYE, *RIGHT_EYE, *LIPS, *INNER_LIP_UPPER, *INNER_LIP_LOWER))
)


class FakeFlame:
    """`content`: the pickle's dictionary, with plain arrays. `rows`: landmark -> vertex."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        head, embedding = load_head(), load_head().landmark_embedding
        corners = head.faces[embedding.triangles]
        row = self.rows = {int(index): row for row, index in enumerate(embedding.landmarks)}

        def at(field: np.ndarray) -> np.ndarray:
            out = np.einsum("lc,...lcx->...lx", embedding.barycentric, field[..., corners, :]).astype(float)
            # The embedded head has 13 and 14 in one place; here the lower lip's middle lies between its neighbours.
            out[..., row[14], :] = (out[..., row[87], :] + out[..., row[317], :]) / 2
            return out

        skin = at(head.template)
        ball = 0.012 * np.concatenate([np.eye(3), -np.eye(3)])
        eyes = [head.joints[f"{side}_eye"].position + ball for side in ("left", "right")]
        angle = np.arange(8) * np.pi / 4
        ring = np.stack(
            [0.06 * np.cos(angle), np.full(8, skin[:, 1].min() - 0.08), 0.06 * np.sin(angle)], axis=1
        )
        template = np.concatenate([skin, *eyes, ring])
        count, extra = len(skin), len(template) - len(skin)
        jaw = np.linalg.norm(at(head.expression_basis[head.expression_names.index("jawOpen")]), axis=1)
        weights = np.zeros((len(template), 5))
        weights[:count, 2] = np.clip(1.4 * jaw / jaw.max(), 0, 1)
        weights[:count, 1] = 1 - weights[:count, 2]
        weights[count : count + 6, 3] = weights[count + 6 : count + 12, 4] = 1
        weights[count + 12 :] = [0.6, 0.4, 0, 0, 0]
        mixed = (
            rng.normal(size=(EXPRESSIONS, ARKIT)) @ at(head.expression_basis[:ARKIT]).reshape(ARKIT, -1) / 30
        )
        shapes = np.zeros((IDENTITIES + EXPRESSIONS, len(template), 3))
        shapes[:100, :count] = at(head.identity_basis)
        shapes[100:300, :count] = 1e-5 * rng.normal(size=(200, count, 3))
        shapes[IDENTITIES:, :count] = mixed.reshape(EXPRESSIONS, count, 3)
        regressor = rng.dirichlet(np.ones(len(template)), 5)
        middle = regressor @ template
        # Joints where a head has them: the regressor's rows are moved onto single places by a least-norm correction.
        wanted = np.array([[0, -0.12, 0], [0, -0.08, 0.0], [0, -0.01, 0.0], *(eye.mean(0) for eye in eyes)])
        homogeneous = np.concatenate([template, np.ones((len(template), 1))], axis=1)
        gap = np.concatenate([wanted - middle, np.zeros((5, 1))], axis=1)
        regressor += gap @ np.linalg.pinv(homogeneous)
        self.content = {
            "v_template": template,
            "f": self._faces(skin, count, extra).astype(np.uint32),
            "shapedirs": np.moveaxis(shapes, 0, -1),
            "posedirs": 2e-4 * rng.normal(size=(len(template), 3, 36)),
            "J_regressor": sparse.csc_matrix(regressor),
            "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], np.arange(5)], np.int64),
            "weights": weights,
            "bs_style": "lbs",
        }

    @staticmethod
    def _faces(skin: np.ndarray, count: int, extra: int) -> np.ndarray:
        # Closed lips touch: points in one place would be left out.
        apart = skin[:, :2] + 1e-6 * np.random.default_rng(0).normal(size=(count, 2))
        faces = Delaunay(apart).simplices
        a, b, c = (skin[faces[:, k], :2] for k in range(3))
        flip = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
        faces[flip] = faces[flip][:, ::-1]
        # Octahedra with vertices +x, +y, +z, -x, -y, -z.
        octahedron = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
        balls = [np.array(octahedron) + count + start for start in (0, 6)]
        ring = [[k, k + 1, k + 2] for k in range(count + 12, count + extra - 2)]
        return np.concatenate([faces, *balls, np.array(ring)])

    def vertices(self, identity, expression, root=None, neck=None, jaw=None, eyes=None) -> np.ndarray:
        """[D, 3] of one frame, the paper's equations by 4x4 matrices; rotations axis-angle, eyes [2, 3]."""
        content, zero = self.content, np.zeros(3)
        eyes = np.zeros((2, 3)) if eyes is None else eyes
        turns = [zero if turn is None else turn for turn in (root, neck, jaw)] + list(eyes)
        matrices = [Rotation.from_rotvec(turn).as_matrix() for turn in turns]
        shaped = content["v_template"] + content["shapedirs"] @ np.concatenate([identity, expression]).astype(
            float
        )
        joints = content["J_regressor"].toarray() @ shaped
        feature = np.concatenate([(matrix - np.eye(3)).ravel() for matrix in matrices[1:]])
        posed = shaped + content["posedirs"] @ feature
        world: list[np.ndarray] = []
        for joint, parent in enumerate((-1, 0, 1, 1, 1)):
            local = np.eye(4)
            local[:3, :3] = matrices[joint]
            local[:3, 3] = joints[joint] - (joints[parent] if joint else 0)
            world.append(local if parent < 0 else world[parent] @ local)
        out = np.zeros_like(posed)
        for vertex, point in enumerate(posed):
            for joint, share in enumerate(content["weights"][vertex]):
                moved = world[joint] @ np.append(point - joints[joint], 1)
                out[vertex] += share * moved[:3]
        return out

    def write(self, folder: Path, protocol: int = 2, chumpy: bool = False) -> Path:
        """flame2023.pkl with a 105-point-like embedding beside it; chumpy: the old files' arrays."""
        content = dict(self.content)
        if chumpy:
            content |= {key: _chumpy(content[key]) for key in ("v_template", "shapedirs", "posedirs")}
        path = folder / "flame2023.pkl"
        path.write_bytes(pickle.dumps(content, protocol))
        np.savez(folder / "mediapipe_landmark_embedding.npz", **self.embedding(EMBEDDED))
        return path

    def write_static(self, folder: Path) -> Path:
        """flame_static_embedding.pkl: iBUG's 51 points without their names."""
        path = folder / "flame_static_embedding.pkl"
        points = self.embedding(IBUG_51)
        del points["landmark_indices"]
        path.write_bytes(pickle.dumps(points, 2))
        return path

    def embedding(self, landmarks: tuple[int, ...]) -> dict[str, np.ndarray]:
        """Each landmark is a vertex: any of its faces, and the corner."""
        places = [np.argwhere(self.content["f"] == self.rows[index])[0] for index in landmarks]
        return {
            "lmk_face_idx": np.array([face for face, _ in places], np.int64),
            "lmk_b_coords": np.eye(3)[[corner for _, corner in places]],
            "landmark_indices": np.array(landmarks, np.int64),
        }


def _chumpy(array: np.ndarray) -> object:
    """An array as chumpy pickles it; the module is made up, and gone when the file is read."""
    module = sys.modules.setdefault("chumpy.ch", types.ModuleType("chumpy.ch"))
    sys.modules.setdefault("chumpy", types.ModuleType("chumpy"))
    if not hasattr(module, "Ch"):
        module.Ch = type("Ch", (), {"__module__": "chumpy.ch"})  # type: ignore[attr-defined]
    held = module.Ch()
    held.x = array
    return held


def six(rotation: Rotation) -> np.ndarray:
    """[.., 6] as PyTorch3D writes a rotation: its matrix's first two rows."""
    return rotation.as_matrix()[..., :2, :].reshape(*rotation.as_matrix().shape[:-2], 6)


def write_frame(path: Path, flame: dict, camera: dict, size: tuple[int, int], number: int) -> None:
    """One of metrical-tracker's checkpoints; size: (width, height)."""
    single = {
        group: {name: np.asarray(value, np.float32)[None] for name, value in values.items()}
        for group, values in (("flame", flame), ("camera", camera))
    }
    rest = {"img_size": np.array(size[::-1]), "frame_id": f"{number:05d}", "global_step": 7}
    torch.save(single | rest, path)
