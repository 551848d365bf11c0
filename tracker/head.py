"""The parametric head: a mesh that is linear in who it is and in what it does, with eyeballs that turn.

Head frame: right-handed, x to the subject's left, y up, z out of the face, metres, origin at the jaw hinge between the
ears of the average head.
"""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from tracker.skinning import Skeleton
from tracker.track import F32, TrackError

I32 = NDArray[np.int32]

ASSET = Path(__file__).parent / "assets" / "head.npz"
# What reading a file that is no `.npz`, or a broken one, raises.
DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class LandmarkEmbedding:
    """Where the landmarker's points lie on the surface of one head.

    landmarks: [L] i32, indices into the 478 points. triangles: [L] i32 into the head's faces.
    barycentric: [L, 3] f32, weights of the triangle's corners. head_sha256: the head it was made for.
    """

    landmarks: I32
    triangles: I32
    barycentric: F32
    head_sha256: str


@dataclass(frozen=True)
class Joint:
    """A part that turns rigidly: its centre [3] m, how the centre moves with identity [Ki, 3], its vertices."""

    position: F32
    identity_basis: F32
    vertices: I32


@dataclass(frozen=True)
class HeadModel:
    """vertices = template + identity · identity_basis + expression · expression_basis, eyeballs turned about joints.

    template: [D, 3] f32 m. faces: [F, 3] i32, counter-clockwise from outside. mirror: [D] i32, the vertex on the other
    side. identity_basis: [Ki, D, 3] m per standard deviation. expression_basis: [Ke, D, 3] m at weight 1, in the order
    of `expression_names`: ARKit's, weights 0..1, then LIP_SHAPES (tracker/modes.py), -1..1. joints: `left_eye`,
    `right_eye`, of FLAME `neck` and `jaw` too. regions: name -> vertex indices; `inner_lip_upper` and `inner_lip_lower`
    run from the right to the left corner and are paired, the two ends being the corners (of FLAME as far as the
    landmark embedding goes). albedo: [D, 3] u8 sRGB of a painted neutral skin. sha256: of the geometry. skeleton: of a
    head that turns its jaw and neck by joints, which then turn the eyes too; None for one that moves the jaw by
    expressions. signed: expression weights are standard deviations of either sign and names mean nothing.
    """

    name: str
    sha256: str
    template: F32
    faces: I32
    mirror: I32
    identity_basis: F32
    expression_basis: F32
    expression_names: tuple[str, ...]
    joints: dict[str, Joint]
    regions: dict[str, I32]
    albedo: NDArray[np.uint8]
    landmark_embedding: LandmarkEmbedding
    skeleton: Skeleton | None = None
    signed: bool = False

    def __post_init__(self) -> None:
        if self.landmark_embedding.head_sha256 != self.sha256:
            raise TrackError(
                f"the landmark embedding was made for head {self.landmark_embedding.head_sha256[:12]}, "
                f"not for {self.name} {self.sha256[:12]}: build it for this head (tools/build_embedding.py)"
            )

    def vertices(
        self,
        identity: ArrayLike,
        expression: ArrayLike,
        jaw: ArrayLike | None = None,
        neck: ArrayLike | None = None,
        eyes: ArrayLike | None = None,
    ) -> F32:
        """Pose the mesh: [.., D, 3] m in the head frame.

        identity: [.., Ki] standard deviations. expression: [.., Ke] weights. eyes: [.., 2, 3] axis-angle rad, left
        then right. Leading dimensions broadcast. jaw, neck: [.., 3]; a head without a skeleton moves its jaw by
        expressions and its neck with the head, so anything but zero raises TrackError.
        """
        return self._positions(slice(None), identity, expression, jaw, neck, eyes)

    def landmark_positions(
        self,
        identity: ArrayLike,
        expression: ArrayLike,
        jaw: ArrayLike | None = None,
        neck: ArrayLike | None = None,
        eyes: ArrayLike | None = None,
    ) -> F32:
        """Positions of the embedded landmarks, [.., L, 3] m; arguments as for `vertices`."""
        embedding = self.landmark_embedding
        used, corners = np.unique(self.faces[embedding.triangles], return_inverse=True)
        vertices = self._positions(used, identity, expression, jaw, neck, eyes)
        return np.einsum("lc,...lcx->...lx", embedding.barycentric, vertices[..., corners.reshape(-1, 3), :])

    def lip_gap_mm(self, vertices: NDArray[np.floating]) -> NDArray[np.floating]:
        """Height of the middle of the inner upper lip above the lower one, [.., D, 3] m -> [..] mm; < 0: overlap."""
        upper, lower = self.regions["inner_lip_upper"], self.regions["inner_lip_lower"]
        middle = len(upper) // 2
        return 1e3 * (vertices[..., upper[middle], 1] - vertices[..., lower[middle], 1])

    def behind_lips(self) -> I32:
        """[B] the lips' vertices behind the line where they meet: the mouth's inside. None of a head without one."""
        lips, mouth = self.regions["lips"], self.regions["mouth"]
        if not len(mouth):
            return mouth
        open_side = np.zeros(len(self.template), bool)
        open_side[np.concatenate([lips, mouth])] = True
        open_side[np.concatenate([self.regions["upper_lip_edge"], self.regions["lower_lip_edge"]])] = False
        sides = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        sides = sides[open_side[sides].all(1)]
        graph = coo_matrix((np.ones(len(sides)), sides.T), (len(open_side),) * 2)
        part = connected_components(graph, directed=False)[1]
        return lips[open_side[lips] & np.isin(part[lips], part[mouth])]

    def _positions(
        self,
        select: NDArray[np.integer] | slice,
        identity: ArrayLike,
        expression: ArrayLike,
        jaw: ArrayLike | None,
        neck: ArrayLike | None,
        eyes: ArrayLike | None,
    ) -> F32:
        who, what = np.asarray(identity, np.float32), np.asarray(expression, np.float32)
        vertices = self.template[select] + _combine(who, self.identity_basis[:, select])
        vertices = vertices + _combine(what, self.expression_basis[:, select])
        if self.skeleton is not None:
            return self.skeleton.pose(vertices, select, self.skeleton.positions(who, what), jaw, neck, eyes)
        for name, rotation in (("jaw", jaw), ("neck", neck)):
            if rotation is not None and np.any(np.asarray(rotation)):
                raise TrackError(
                    f"the head {self.name} has no {name} joint: its {name} rotation must be zero"
                )
        if eyes is None:
            return vertices
        turns = np.asarray(eyes, np.float32)
        for side, name in enumerate(("left_eye", "right_eye")):
            member = np.isin(np.arange(len(self.template))[select], self.joints[name].vertices)
            vertices = _turn(vertices, member, self.joints[name], who, turns[..., side, :])
        return vertices


def _turn(vertices: F32, member: NDArray[np.bool_], joint: Joint, identity: F32, turn: F32) -> F32:
    """Turn some vertices about the joint's centre by an axis-angle rotation [.., 3]."""
    lead = np.broadcast_shapes(vertices.shape[:-2], turn.shape[:-1])
    vertices = np.broadcast_to(vertices, (*lead, *vertices.shape[-2:])).copy()
    centre = (joint.position + identity @ joint.identity_basis)[..., None, :]
    matrix = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*turn.shape, 3).astype(np.float32)
    vertices[..., member, :] = (vertices[..., member, :] - centre) @ np.swapaxes(matrix, -1, -2) + centre
    return vertices


def _combine(weights: F32, basis: F32) -> F32:
    """[.., K] x [K, D, 3] -> [.., D, 3]."""
    return (weights @ basis.reshape(len(basis), -1)).reshape(*weights.shape[:-1], *basis.shape[1:])


@cache
def load_head() -> HeadModel:
    """The embedded head, with its landmark embedding.

    Raises TrackError when a file is missing or damaged, or when the embedding was made for another head.
    """
    embedding = read_landmark_embedding(ASSET.with_suffix(".landmarks.npz"))
    return replace(read_head(ASSET), landmark_embedding=embedding)


def read_landmark_embedding(path: Path) -> LandmarkEmbedding:
    """What tools/build_embedding.py wrote. Raises TrackError when the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return LandmarkEmbedding(
                landmarks=file["landmarks"],
                triangles=file["triangles"],
                barycentric=file["barycentric"],
                head_sha256=str(file["head_sha256"]),
            )
    except DAMAGED as error:
        raise TrackError(f"{path}: not a landmark embedding ({error})") from error


def read_head(path: Path) -> HeadModel:
    """A head without landmarks (L = 0). Raises TrackError when the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
        return _assemble(path.stem, arrays)
    except DAMAGED as error:
        raise TrackError(f"{path}: not a head model ({error})") from error


def _assemble(name: str, arrays: dict[str, NDArray]) -> HeadModel:
    unit = np.float32(arrays["unit"])
    identity, expression = (arrays[key] * unit for key in ("identity_basis", "expression_basis"))
    digest = hashlib.sha256()
    for array in (arrays["template"], arrays["faces"], identity, expression):
        digest.update(np.ascontiguousarray(array).tobytes())
    joints = {
        str(joint): Joint(
            arrays["joint_position"][k], arrays["joint_identity_basis"][k], arrays[f"region_{joint}"]
        )
        for k, joint in enumerate(arrays["joint_names"])
    }
    nothing = LandmarkEmbedding(
        np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32), digest.hexdigest()
    )
    return HeadModel(
        name=name,
        sha256=digest.hexdigest(),
        template=arrays["template"],
        faces=arrays["faces"],
        mirror=arrays["mirror"],
        identity_basis=identity,
        expression_basis=expression,
        expression_names=tuple(str(word) for word in arrays["expression_names"]),
        joints=joints,
        regions={
            key.removeprefix("region_"): value for key, value in arrays.items() if key.startswith("region_")
        },
        albedo=arrays["albedo"],
        landmark_embedding=nothing,
    )
