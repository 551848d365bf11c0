"""A facial motion: displacements of a subject's vertices from the neutral template, and its file."""

from __future__ import annotations

import hashlib
import json
import lzma
import math
import tokenize
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.files import write_npz

FPS = 30.0
# A file of displacements becomes basis form with this root mean square error over vertices and frames.
BASIS_ERROR_M = 1e-5
# What a motion file may hold once unpacked: an hour at 5 000 vertices as displacements is 6.5 GB, in basis
# form 30 MB.
LARGEST_MOTION_BYTES = 4 << 30
# Farther than this no vertex of a face is moved by one mode: such numbers are of another unit, or nonsense.
LARGEST_MOVE_M = 1.0
# What a damaged archive of arrays, or the header of one of them, makes its readers raise.
DAMAGED = (
    OSError, ValueError, EOFError, MemoryError, OverflowError, RuntimeError, SyntaxError, tokenize.TokenError,
    zipfile.BadZipFile, zlib.error, lzma.LZMAError,
)  # fmt: skip


class MotionError(ValueError):
    """A motion file or array that cannot be used; the message says what is wrong and what is needed."""


def topology_hash(vertex_count: int, faces: NDArray[np.int32]) -> str:
    """sha256 of D and the faces: two motions are comparable when these agree."""
    digest = hashlib.sha256(str(int(vertex_count)).encode())
    digest.update(np.ascontiguousarray(faces, dtype="<i4").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class Motion:
    """Head-fixed vertex displacements at 30 fps, in basis form.

    start_s: time of the first motion frame, s of presentation time; frame n is at start_s + n / fps.
    template: [D, 3] f32 m, the subject's neutral. faces: [F, 3] i32.
    basis: [K, D, 3] f32, orthonormal in R^{3D}. coefficients: [N, K] f32 m; displacement = coefficients ·
    basis.
    valid: [N] bool, frames that were really seen.
    provenance: tool, version, synthetic true/false, source, checkpoint, seed, guidance; of a synthesis sample, and
    samples, how many were drawn together; of a run and its edits av_offset_s, and av_offset_of, the sha256 of the files
    whose sound is that late.
    """

    fps: float
    start_s: float
    template: NDArray[np.float32]
    faces: NDArray[np.int32]
    basis: NDArray[np.float32]
    coefficients: NDArray[np.float32]
    valid: NDArray[np.bool_]
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def topology(self) -> str:
        """sha256 of D and the faces."""
        return topology_hash(len(self.template), self.faces)

    def sound_offset_s(self, sha256: str) -> float:
        """How late the sound of a file is against the motion, s; 0 of one of which nothing is known."""
        known = sha256 in self.provenance.get("av_offset_of", [])
        return float(self.provenance.get("av_offset_s", 0.0)) if known else 0.0

    def displacements(self, vertices: NDArray[np.integer] | None = None) -> NDArray[np.float32]:
        """[N, D, 3] m, or [N, len(vertices), 3] for some vertices only."""
        basis = self.basis if vertices is None else self.basis[:, vertices]
        return np.tensordot(self.coefficients, basis, axes=1)

    def save(self, path: Path) -> None:
        """Write `motion.npz` atomically."""
        write_npz(
            path,
            fps=np.float64(self.fps),
            start_s=np.float64(self.start_s),
            template=self.template,
            faces=self.faces,
            basis=self.basis,
            coefficients=self.coefficients,
            valid=self.valid,
            topology=np.str_(self.topology),
            provenance=np.str_(json.dumps(self.provenance)),
        )

    @classmethod
    def load(cls, path: Path) -> Motion:
        """Read `motion.npz`, with `basis` and `coefficients` or with `displacements` [N, D, 3].

        Displacements are brought to basis form (their principal modes, 0.01 mm root mean square error).
        Raises MotionError, in one line, for a missing or broken file, shapes that do not fit, or more than
        memory holds.
        """
        arrays = _read_arrays(path)
        try:
            if "basis" not in arrays and "displacements" in arrays:
                moved, unseen = arrays["displacements"], ~arrays["valid"].astype(np.bool_)
                moved[unseen] = np.nan_to_num(moved[unseen], nan=0.0, posinf=0.0, neginf=0.0)
                arrays["basis"], arrays["coefficients"] = principal_modes(moved)
            motion = cls(
                fps=float(arrays["fps"]),
                start_s=float(arrays["start_s"]),
                template=arrays["template"].astype(np.float32),
                faces=arrays["faces"].astype(np.int32),
                basis=arrays["basis"].astype(np.float32),
                coefficients=arrays["coefficients"].astype(np.float32),
                valid=arrays["valid"].astype(np.bool_),
                provenance=json.loads(str(arrays["provenance"])) if "provenance" in arrays else {},
            )
        except (KeyError, TypeError, ValueError, IndexError, RecursionError) as error:
            raise MotionError(f"{path} is no motion file: {' '.join(str(error).split())}") from error
        _check_shapes(motion, path)
        _check_values(motion, path)
        if "topology" in arrays and str(arrays["topology"]) != motion.topology:
            raise MotionError(f"{path} is damaged: its mesh is not the one its topology names")
        return motion


def principal_modes(displacements: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """[N, D, 3] m -> orthonormal basis [K, D, 3] and coefficients [N, K] m, exact to BASIS_ERROR_M (rms)."""
    if displacements.ndim != 3 or displacements.shape[2] != 3 or 0 in displacements.shape:
        raise ValueError(f"displacements of shape {displacements.shape}, not [N, D, 3]")
    if not np.isfinite(displacements).all():
        raise ValueError("displacements that are not finite")
    frames, vertices, _ = displacements.shape
    flat = displacements.reshape(frames, -1)
    left, values, right = np.linalg.svd(flat.astype(np.float64), full_matrices=False)
    tail = np.append(np.cumsum(values[::-1] ** 2)[::-1], 0.0)
    count = max(1, int(np.argmax(tail <= BASIS_ERROR_M**2 * frames * vertices)))
    basis = right[:count].reshape(count, vertices, 3).astype(np.float32)
    return basis, (left[:, :count] * values[:count]).astype(np.float32)


def _check_shapes(motion: Motion, path: Path) -> None:
    """MotionError naming the array whose shape does not fit the others, or that holds nothing."""
    vertices, modes, frames, faces = (
        len(np.atleast_1d(getattr(motion, name))) for name in ("template", "basis", "coefficients", "faces")
    )
    expected = {
        "template": (vertices, 3),
        "faces": (faces, 3),
        "basis": (modes, vertices, 3),
        "coefficients": (frames, modes),
        "valid": (frames,),
    }
    for name, shape in expected.items():
        found = getattr(motion, name).shape
        if found != shape:
            raise MotionError(f"{path}: {name} has shape {found}, and {shape} fits the other arrays")
    for name in ("template", "basis", "coefficients"):
        if not getattr(motion, name).size:
            raise MotionError(f"{path}: {name} is empty")


def _check_values(motion: Motion, path: Path) -> None:
    """MotionError saying which of the motion's numbers cannot be used."""
    vertices, coefficients = len(motion.template), motion.coefficients[motion.valid]
    if len(motion.faces) and not 0 <= motion.faces.min() <= motion.faces.max() < vertices:
        raise MotionError(f"{path}: faces name vertices that do not exist (there are {vertices})")
    if not (math.isfinite(motion.fps) and motion.fps > 0 and math.isfinite(motion.start_s)):
        raise MotionError(f"{path}: fps {motion.fps} and start_s {motion.start_s} are not usable")
    if not all(np.isfinite(values).all() for values in (motion.template, motion.basis, coefficients)):
        raise MotionError(f"{path}: the motion holds values that are not finite")
    moves = np.abs(coefficients).max(0, initial=0).astype(np.float64) * np.abs(motion.basis).max((1, 2))
    if moves.max() > LARGEST_MOVE_M:
        raise MotionError(
            f"{path}: vertices move by {moves.max():.3g} m; coefficients times basis must be metres"
        )
    _check_provenance(motion.provenance, path)


def _check_provenance(provenance: Any, path: Path) -> None:
    """MotionError where it is no dictionary, or what is computed with is no number or list."""
    if not isinstance(provenance, dict):
        raise MotionError(f"{path}: provenance is no JSON object")
    offset_s = provenance.get("av_offset_s", 0.0)
    if not isinstance(offset_s, int | float) or not abs(offset_s) < 3600:
        raise MotionError(f"{path}: av_offset_s {offset_s!r} in the provenance is no delay in seconds")
    if not isinstance(provenance.get("av_offset_of", []), list):
        raise MotionError(f"{path}: av_offset_of in the provenance is no list")


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an npz file, never unpickling, its declared sizes checked before anything is
    allocated.
    """
    if not path.is_file():
        raise MotionError(f"there is no file {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > LARGEST_MOTION_BYTES:
                raise MotionError(
                    f"{path} would take {size / 1e9:.1f} GB of memory, {LARGEST_MOTION_BYTES / 1e9:.1f} GB is the"
                    " most that is read; store `basis` and `coefficients` instead of `displacements`"
                )
            for entry in archive.infolist():
                _check_header(archive, entry)
        with np.load(path, allow_pickle=False) as archive_arrays:
            return {name: archive_arrays[name] for name in archive_arrays.files}
    except MotionError:
        raise
    except DAMAGED as error:
        reason = " ".join(str(error).split())
        raise MotionError(f"{path} is not a readable motion file (.npz): {reason}") from error


def _check_header(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> None:
    """ValueError where an array's header claims more bytes than its entry in the archive holds, or needs
    pickle.
    """
    with archive.open(entry) as stream:
        version = np.lib.format.read_magic(stream)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
        elif version == (2, 0):
            shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
        else:
            raise ValueError(f"{entry.filename} has an unknown array format {version}")
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > entry.file_size:
        raise ValueError(f"{entry.filename} claims shape {shape} of {dtype}, which it does not hold")
