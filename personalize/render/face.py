"""A head-fixed motion as pictures: one camera in front of the face."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from model.motion import topology_hash
from personalize.render import mouth
from tracker.head import HeadModel, load_head
from tracker.raster import project, rasterize, shade

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

# A portrait lens: far enough that the nose does not swell.
FOCAL_IN_HEIGHTS = 3.0
FACE_SHARE_OF_HEIGHT = 0.72
CLAY = (205, 186, 174)
TURN_DEG = -12.0
SUPERSAMPLING = 2
CREASES_SEED = 0


class FaceCamera:
    """Renders displaced templates of one topology from the front, slightly turned so that depth shows.

    The embedded head's own topology is painted, with teeth and tongue in place; any other is plain clay.
    template: [D, 3] m, head frame. size: (width, height) px. face: vertex indices the picture is framed on.
    """

    def __init__(
        self, template: F32, faces: NDArray[np.int32], face: NDArray[np.integer], size: tuple[int, int]
    ) -> None:
        self.size, self._faces = size, faces
        self._large = (size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING)
        self._focal = FOCAL_IN_HEIGHTS * self._large[1]
        self._principal = [(side - 1) / 2 for side in self._large]
        low, high = template[face].min(0), template[face].max(0)
        distance = float(high[1] - low[1]) * FOCAL_IN_HEIGHTS / FACE_SHARE_OF_HEIGHT
        angle = np.deg2rad(TURN_DEG)
        turn = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], np.float32
        )
        # Head axes (y up, z out of the face) to camera axes (y down, z forward).
        self._rotation = np.diag(np.array([1, -1, -1], np.float32)) @ turn
        self._translation = np.array([0, 0, distance], np.float32) - self._rotation @ ((low + high) / 2)
        self._person = _embedded(template, faces)
        if self._person is None:
            self._template, self._albedo = template, np.tile(np.asarray(CLAY, np.uint8), (len(template), 1))
        else:
            self._template, self._albedo = self._person.template, mouth.painted(self._person)
            self._detail = mouth.MouthDetail.of(self._person, len(template), CREASES_SEED)

    def picture(self, displacement: F32) -> U8:
        """[D, 3] m -> [H, W, 3] u8 RGB."""
        if self._person is not None:
            displacement = mouth.on_the_jaw(displacement, self._person)
        vertices = (self._template + displacement) @ self._rotation.T + self._translation
        pixels = np.concatenate([project(vertices, self._focal, self._principal), vertices[:, 2:]], axis=1)
        seen = rasterize(pixels, self._faces, self._large)
        picture = shade(seen, self._faces, vertices, self._albedo)
        if self._person is not None:
            lips = self._person.regions["lips"]
            pixels_per_m = self._focal / float(vertices[lips, 2].mean())
            self._detail.lay(picture, seen, self._faces, pixels[lips, :2], pixels_per_m)
        return cv2.resize(picture, self.size, interpolation=cv2.INTER_AREA)


def _embedded(template: F32, faces: NDArray[np.int32]) -> HeadModel | None:
    """The embedded head with this neutral [D, 3] m and a furnished mouth; None where the topology is another's."""
    head = load_head()
    if topology_hash(len(template), faces) != topology_hash(len(head.template), head.faces):
        return None
    return mouth.furnished(replace(head, template=template))
