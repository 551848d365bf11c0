"""A head-fixed motion as pictures: one camera in front of the face."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from model.motion import topology_hash
from personalize.talkers.skin import painted, seen_faces
from tracker.head import load_head
from tracker.raster import render

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

# A portrait lens: far enough that the nose does not swell.
FOCAL_IN_HEIGHTS = 3.0
FACE_SHARE_OF_HEIGHT = 0.72
CLAY = (205, 186, 174)
TURN_DEG = -12.0


class FaceCamera:
    """Renders displaced templates of one topology from the front, slightly turned so that depth shows.

    template: [D, 3] m, head frame. size: (width, height) px. face: vertex indices the picture is framed on.
    """

    def __init__(
        self, template: F32, faces: NDArray[np.int32], face: NDArray[np.integer], size: tuple[int, int]
    ) -> None:
        self.template, self.size = template, size
        self.faces, self._albedo = appearance(template, faces)
        low, high = template[face].min(0), template[face].max(0)
        self._focal = FOCAL_IN_HEIGHTS * size[1]
        distance = float(high[1] - low[1]) * self._focal / (FACE_SHARE_OF_HEIGHT * size[1])
        angle = np.deg2rad(TURN_DEG)
        turn = np.array(
            [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], np.float32
        )
        # Head axes (y up, z out of the face) to camera axes (y down, z forward).
        self._rotation = np.diag(np.array([1, -1, -1], np.float32)) @ turn
        self._translation = np.array([0, 0, distance], np.float32) - self._rotation @ ((low + high) / 2)

    def picture(self, displacement: F32) -> U8:
        """[D, 3] m -> [H, W, 3] u8 RGB."""
        vertices = (self.template + displacement) @ self._rotation.T + self._translation
        principal = ((self.size[0] - 1) / 2, (self.size[1] - 1) / 2)
        return render(vertices, self.faces, self._albedo, self._focal, principal, self.size)


def appearance(template: F32, faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], U8]:
    """Triangles to show [F', 3] and vertex colours [D, 3] u8 RGB.

    On the embedded head's own topology the painted skin, without the tongue, which would fill the mouth; plain clay
    on any other.
    """
    head = load_head()
    if topology_hash(len(template), faces) == topology_hash(len(head.template), head.faces):
        return seen_faces(head), painted(head)
    return faces, np.tile(np.asarray(CLAY, np.uint8), (len(template), 1))
