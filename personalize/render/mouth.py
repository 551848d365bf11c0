"""What makes a rendered mouth look like one: teeth and tongue in their places, their colours, the shade between lips.

Only what the camera sees changes; lips and face stay where they are. Looks were judged beside real mouths at the same
openings: shut lips meet in a dark line, an open mouth shows the upper teeth below the lip's edge and darkens backwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracker.head import HeadModel
from tracker.raster import Raster, interpolate
from tracker.track import F32, F64

U8 = NDArray[np.uint8]

# Metres up and forward: the head's teeth stand 12 mm behind the line where the lips meet, and reach no lower.
UPPER_TEETH_M, LOWER_TEETH_M, TONGUE_M = (-0.0026, 0.006), (-0.003, 0.0045), (-0.004, 0.004)
TEETH, GUM, TONGUE, MUCOSA = (
    (204.0, 190.0, 166.0),
    (176.0, 98.0, 92.0),
    (166.0, 92.0, 86.0),
    (120.0, 58.0, 54.0),
)
CROWN_M = 0.0095  # height of the upper incisors
ROOTS_M, NARROWER = 0.005, 0.85
UPPER_WIDTHS_M = (0.0085, 0.0065, 0.0075, 0.007, 0.007)  # of the teeth from the midline on
LOWER_WIDTHS_M = (0.0054, 0.006, 0.0068, 0.007, 0.007)
BETWEEN_TEETH_M, BETWEEN_TEETH = 0.0004, 0.45
UPPER_LIP_M, LOWER_LIP_M, BORDER_M = 0.006, 0.008, 0.0035  # height of the vermilion and of its fading border
HALF_WIDTH_M = 0.027
CREASE_M, CREASES = 0.0008, 0.03
# Light that is lost behind what surrounds a point, by the size of the surroundings.
CREVICES_M, CREVICE_LOSS, DEEPEST = (0.001, 0.0025, 0.006), 0.9, 2.5
AROUND_M = 0.015
LIP_COLOUR = 0.75  # share of the head's own, which is a lipstick's
LIGHT_REACH_M = 0.01  # into the mouth, to 1 / e


def furnished(person: HeadModel) -> HeadModel:
    """The person with teeth and tongue where people have them."""
    template = person.template.copy()
    upper, lower = teeth(person)
    for row, side, (up, forward) in ((upper, 1, UPPER_TEETH_M), (lower, -1, LOWER_TEETH_M)):
        roots = side * template[row, 1] > (side * template[row, 1]).min() + 1.3 * CROWN_M
        template[row] += np.array([0, up, forward], np.float32)
        # Shorter and narrower than the head's own, which come through the cheeks and the chin.
        template[row[roots], 1] -= np.float32(side * ROOTS_M)
        template[row, 0] *= np.float32(NARROWER)
    template[person.regions["tongue"]] += np.array([0, *TONGUE_M], np.float32)
    basis = on_the_jaw(person.expression_basis, person)
    return replace(person, template=template, expression_basis=basis)


def on_the_jaw(displacement: F32, person: HeadModel) -> F32:
    """Displacements [.., D, 3] m whose tongue moves as the lower teeth do: the head's own leaves the mouth."""
    moved = displacement.copy()
    lower = teeth(person)[1]
    moved[..., person.regions["tongue"], :] = displacement[..., lower, :].mean(-2, keepdims=True)
    return moved


def teeth(person: HeadModel) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Vertices of the upper and of the lower row."""
    both = person.regions["teeth"]
    shift = np.abs(person.expression_basis[:, both]).sum((0, 2))
    # The lower row moves with the jaw.
    lower = shift > 0.5 * shift.max()
    return both[~lower], both[lower]


def within(person: HeadModel) -> NDArray[np.int32]:
    """Vertices within the mouth."""
    return np.concatenate(
        [person.regions[part] for part in ("mouth", "teeth", "tongue")] + [person.behind_lips()]
    )


def painted(person: HeadModel) -> U8:
    """[D, 3] RGB: the head's own paint with paler lips, and a mouth that is darker the deeper."""
    albedo = person.albedo.astype(np.float64)
    face = person.regions["face"]
    tone, redness = np.median(albedo[face], axis=0), albedo[face, 0] - albedo[face, 1]
    red = face[redness > tone[0] - tone[1]]
    albedo[red] = tone + LIP_COLOUR * (albedo[red] - tone)
    paint(albedo, person)
    inside = within(person)
    depth = person.template[person.regions["teeth"], 2].max() - person.template[inside, 2]
    # Colours are square roots of light, as in tracker.raster.
    albedo[inside] *= np.exp(-0.5 * np.maximum(depth, 0) / LIGHT_REACH_M)[:, None]
    return albedo.astype(np.uint8)


def paint(albedo: F64, person: HeadModel) -> None:
    """Colour what lies within the mouth, in an albedo [D, 3], in place."""
    albedo[np.union1d(person.regions["mouth"], person.behind_lips())] = MUCOSA
    albedo[person.regions["tongue"]] = TONGUE
    for row, side in zip(teeth(person), (1, -1)):
        height = side * person.template[row, 1]
        albedo[row] = np.where((height - height.min() > 1.2 * CROWN_M)[:, None], GUM, TEETH)


def vermilion(person: HeadModel, lips: NDArray[np.integer]) -> F64:
    """[L] 0..1, how much of lip colour vertices of the lips have: fading into the skin."""
    place, line = person.template[lips].astype(np.float64), person.template[person.regions["inner_lip_upper"]]
    order = np.argsort(line[:, 0])
    above = place[:, 1] - np.interp(place[:, 0], line[order, 0], line[order, 1])
    height = np.where(above > 0, UPPER_LIP_M, LOWER_LIP_M)
    height *= np.sqrt(np.clip(1 - (place[:, 0] / HALF_WIDTH_M) ** 2, 0.05, 1))
    return 1 / (1 + np.exp((np.abs(above) - height) / (0.25 * BORDER_M)))


@dataclass(frozen=True)
class MouthDetail:
    """Lines between teeth and creases of lips, laid over a shaded picture.

    fields: [V, 6] f32: weight of upper teeth, of lower teeth, of lips; place along the row or across the lips, m; how
    much of the light lost in the narrowest and in wider crevices is lost here.
    """

    fields: F32
    creases: F64

    @classmethod
    def of(cls, person: HeadModel, vertices: int, seed: int) -> MouthDetail:
        """vertices: V, with those of props."""
        fields = np.zeros((vertices, 6), np.float32)
        fields[: len(person.template), 3] = person.template[:, 0]
        for number, row in enumerate(teeth(person)):
            fields[row, number] = 1
            fields[row, 3] = _along(person.template[row])
        lips = np.setdiff1d(person.regions["lips"], person.behind_lips())
        fields[lips, 2] = vermilion(person, lips)
        fields[lips, 4] = 1
        fields[within(person), 4:] = 1
        return cls(fields, np.random.default_rng((seed, 23)).standard_normal(97))

    def lay(
        self, picture: U8, seen: Raster, faces: NDArray[np.int32], lips_px: F64, pixels_per_m: float
    ) -> None:
        """Darken a picture [H, W, 3] of the mouth along the lines and in the crevices, in place.

        lips_px: [L, 2], where the lips' vertices are in it; they may be outside.
        """
        part = _window(lips_px, picture.shape[:2], pixels_per_m)
        around, depth = picture[part], seen.depth[part]
        if not around.size:
            return
        seen = Raster(seen.triangle[part], seen.barycentric[part], depth)
        upper, lower, lips, along, narrow, wide = np.moveaxis(interpolate(seen, faces, self.fields), -1, 0)
        factor = np.ones_like(along)
        for weight, widths in ((upper, UPPER_WIDTHS_M), (lower, LOWER_WIDTHS_M)):
            row, edges = weight > 0.9, np.concatenate([[0.0], np.cumsum(widths)])
            nearest = np.abs(np.abs(along[row])[:, None] - edges).min(axis=-1)
            factor[row] -= BETWEEN_TEETH * np.exp(-((nearest / BETWEEN_TEETH_M) ** 2))
        place = np.arange(len(self.creases)) - len(self.creases) // 2
        factor += CREASES * lips * np.interp(along / CREASE_M, place, self.creases)
        # Lips, thin and lit through, meet in a thin line.
        for size, weight in zip(CREVICES_M, (narrow, wide, wide)):
            factor *= np.exp(-0.5 * CREVICE_LOSS * weight * crevices(depth, size, pixels_per_m))
        around[:] = np.clip(around * factor[..., None] + 0.5, 0, 255)


def _along(row: F32) -> F32:
    """[R] m, places [R, 3] of a row of teeth along its arch, from the midline."""
    side = np.abs(row[:, 0])
    # An arch as a circle's: the front's depth falls with the distance from the midline.
    return np.sign(row[:, 0]) * np.hypot(side, row[:, 2].max() - row[:, 2])


def crevices(depth: F32, size: float, pixels_per_m: float) -> F32:
    """[H, W] how far points of a depth map [H, W] m lie behind the mean of what surrounds them within `size` m, in it.

    Large where lips meet, and within the mouth the more the deeper and the narrower the opening.
    """
    seen = np.isfinite(depth)
    solid = np.where(seen, depth, depth[seen].max(initial=0)).astype(np.float32)
    behind = solid - cv2.GaussianBlur(solid, (0, 0), size * pixels_per_m)
    return np.where(seen, np.clip(behind / np.float32(size), 0, DEEPEST), 0)


def _window(lips: F64, shape: tuple[int, int], pixels_per_m: float) -> tuple[slice, slice]:
    """Rows and columns of a picture [H, W] that hold lips [L, 2] px and what is near; empty where it holds none."""
    near = AROUND_M * pixels_per_m
    low = np.clip(lips.min(0) - near, 0, shape[::-1]).astype(int)
    high = np.clip(lips.max(0) + near, 0, shape[::-1]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])
