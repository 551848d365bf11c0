"""Other trackers' output folders as FLAME parameters: metrical-tracker's `.frame` files and VHAP's `.npz`.

Both pose FLAME under their own camera conventions; here all is brought to ours: X_camera = R X_head + t, where the
camera looks along z with x right and y down (OpenCV), and the head frame is FLAME's own.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from model.motion import DAMAGED
from personalize.errors import UserError
from personalize.restricted_pickle import LARGEST_PICKLE_BYTES, build_pickle
from personalize.user_arrays import read_user_npz
from tracker.head import HeadModel
from tracker.track import F64

PYTORCH3D_TO_OPENCV = np.diag([-1.0, -1.0, 1.0])  # x left, y up, z forward -> x right, y down, z forward
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])  # x right, y up, z back
VHAP_CAMERA_M = 1.0  # VHAP's camera stands so far before the origin
VHAP_KEYS = ("rotation", "translation", "neck_pose", "jaw_pose", "eyes_pose", "shape", "expr", "focal_length",
             "image_size")  # fmt: skip
VHAP_NAME = re.compile(r"tracked_flame_params(?:_(\d+))?\.npz")
# What an array that is missing, or of another shape or kind than expected, raises.
WRONG = (LookupError, TypeError, ValueError, OverflowError, AttributeError)


@dataclass(frozen=True)
class TrackedFace:
    """n frames of one face in the pictures that its tracker saw, which may be a part of the video's.

    identity: [Ki]. expression: [n, Ke]. jaw, neck: [n, 3] and eyes: [n, 2, 3] axis-angle rad. rotation: [n, 3, 3] and
    translation: [n, 3] m, head to OpenCV camera. focal: px, the same for all frames. principal: [2] px, pixel centres
    at integers.
    """

    identity: F64
    expression: F64
    jaw: F64
    neck: F64
    eyes: F64
    rotation: F64
    translation: F64
    focal: float
    principal: F64

    def __len__(self) -> int:
        return len(self.expression)


def read_tracked(folder: Path, head: HeadModel) -> TrackedFace:
    """The result in `folder` of either tracker. Raises UserError, in one line, where there is none or it is damaged."""
    if head.skeleton is None:
        raise UserError(
            "--tracked holds FLAME's parameters; give the FLAME file it was tracked with by --head"
        )
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such folder; give the one that the tracker wrote")
    frames = sorted((*folder.glob("*.frame"), *folder.glob("checkpoint/*.frame")), key=lambda path: path.stem)
    if frames:
        return _metrical(frames, head)
    archives = [
        (int(match[1] or 0), path) for path in folder.iterdir() if (match := VHAP_NAME.fullmatch(path.name))
    ]
    if archives:
        return _vhap(max(archives)[1], head)
    raise UserError(
        f"{folder}: holds neither metrical-tracker's checkpoint/*.frame nor VHAP's tracked_flame_params_*.npz; "
        "give the folder that docs/heads.md describes"
    )


def matrix_of_6d(six: NDArray[np.floating]) -> F64:
    """[.., 6] -> [.., 3, 3]: the first two rows, made orthonormal, and their cross product (Zhou et al. 2019).

    NaN of two rows that span no plane.
    """
    first, second = six[..., :3].astype(np.float64), six[..., 3:].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        first = first / np.linalg.norm(first, axis=-1, keepdims=True)
        second = second - (first * second).sum(-1, keepdims=True) * first
        second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-2)


def _metrical(paths: list[Path], head: HeadModel) -> TrackedFace:
    """PyTorch3D's camera: X_view = X R + t for rows, focal and principal point in NDC of the shorter side.

    The eyelids' two weights are of shapes that FLAME does not hold: left out.
    """
    numbers = [int(path.stem) if path.stem.isdecimal() else -1 for path in paths]
    if numbers != list(range(numbers[0], numbers[0] + len(paths))):
        raise UserError(
            f"{paths[0].parent}: the numbers of its .frame files have gaps; track the video again"
        )
    frames = [_frame_file(path) for path in paths]
    where = paths[0].parent

    def stack(group: str, name: str, size: int) -> F64:
        return _numbers(
            where, f"{group}.{name}", lambda: [frame[group][name] for frame in frames], (len(frames), size)
        )

    height, width = _numbers(where, "img_size", lambda: frames[0]["img_size"], (2,))
    half = min(height, width) / 2
    focal = np.median(stack("camera", "fl", 1)) * half
    principal = np.array([width, height]) / 2 - np.median(stack("camera", "pp", 2), axis=0) * half

    def turns(group: str, name: str, count: int = 1) -> F64:
        matrices = matrix_of_6d(stack(group, name, 6 * count).reshape(len(frames), count, 6))
        if not np.isfinite(matrices).all():
            raise UserError(f"{where}: {group}.{name} holds what is no rotation; track the video again")
        return matrices

    view = turns("camera", "R")[:, 0].transpose(0, 2, 1)
    return TrackedFace(
        identity=np.median(stack("flame", "shape", len(head.identity_basis)), axis=0),
        expression=stack("flame", "exp", len(head.expression_basis)),
        jaw=_axis_angle(turns("flame", "jaw")[:, 0]),
        neck=np.zeros((len(frames), 3)),
        eyes=_axis_angle(turns("flame", "eyes", 2)),
        rotation=PYTORCH3D_TO_OPENCV @ view,
        translation=stack("camera", "t", 3) @ PYTORCH3D_TO_OPENCV,
        focal=float(focal),
        principal=principal - 0.5,  # pixel edges at integers there
    )


def _vhap(path: Path, head: HeadModel) -> TrackedFace:
    """OpenGL's camera one metre before the origin; the head turns about FLAME's root joint, then moves.

    The static offsets of the vertices are left out: they are the person's shape at rest, not motion.
    """
    arrays: dict[str, Any] = read_user_npz(path, VHAP_KEYS)
    count = len(arrays["expr"]) if arrays["expr"].ndim else 0

    def rows(name: str, *size: int) -> F64:
        return _numbers(path, name, lambda: arrays[name], size)

    identity, expression = (
        rows("shape", len(head.identity_basis)),
        rows("expr", count, len(head.expression_basis)),
    )
    assert head.skeleton is not None
    root = head.skeleton.positions(identity, expression)[:, 0].astype(np.float64)
    turn = Rotation.from_rotvec(rows("rotation", count, 3))
    translation = root - turn.apply(root) + rows("translation", count, 3) - [0.0, 0.0, VHAP_CAMERA_M]
    height, width = rows("image_size", 2)
    return TrackedFace(
        identity=identity,
        expression=expression,
        jaw=rows("jaw_pose", count, 3),
        neck=rows("neck_pose", count, 3),
        eyes=rows("eyes_pose", count, 6).reshape(-1, 2, 3),
        rotation=OPENGL_TO_OPENCV @ turn.as_matrix(),
        translation=translation @ OPENGL_TO_OPENCV,
        focal=float(rows("focal_length", 1)[0] * max(height, width)),
        principal=np.array([width, height]) / 2 - 0.5,
    )


def _frame_file(path: Path) -> dict[Any, Any]:
    """The dictionary that torch.save wrote: a zip whose data.pkl holds numpy arrays.

    Not by torch.load: its safe mode refuses numpy's arrays unless their own unpickling functions are let run.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            name = next(name for name in archive.namelist() if name.endswith("/data.pkl"))
            if archive.getinfo(name).file_size > LARGEST_PICKLE_BYTES:
                raise UserError(
                    f"{path} unpacks to more than {LARGEST_PICKLE_BYTES >> 30} GB; is it another file?"
                )
            content = archive.read(name)
    except (StopIteration, *DAMAGED) as error:
        raise UserError(f"{path} is not a .frame file of metrical-tracker; track the video again") from error
    return build_pickle(path, content)


def _numbers(path: Path, name: str, get: Callable[[], Any], shape: tuple[int, ...]) -> F64:
    """What `get` finds as finite numbers of this shape, apart from axes of length 1."""
    try:
        values = np.asarray(get(), np.float64)
    except WRONG as error:
        raise UserError(
            f"{path}: {name} is missing or no numbers; is it another tracker's folder?"
        ) from error
    if values.size != np.prod(shape) or not values.size or not np.isfinite(values).all():
        raise UserError(
            f"{path}: {name} is {values.shape}, finite numbers of {shape} needed; was it tracked with this --head?"
        )
    return values.reshape(shape)


def _axis_angle(matrix: F64) -> F64:
    """[.., 3, 3] -> [.., 3] rad."""
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-1])
