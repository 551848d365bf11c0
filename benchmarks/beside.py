"""How far a fitted mesh lies beside the picture, told by something else than what it was fitted to.

The subject's colours, learned from some 30 frames of the clip, are re-rendered on the mesh of every frame; by how much
the eyes, the nose and the mouth of that must be shifted to lie on the picture's is found by maximizing their enhanced
correlation (Evangelidis and Psarakis, 2008). On films whose truth is known the shift errs by .2 to .4 mm. What lies
beside the picture by as much in all frames alike is learned with the colours, or is how the search slides over a part
that is smooth: it is taken out, and not told.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from personalize.pictures import FrameReader
from personalize.render.track import TrackPictures
from personalize.run import RunFolder
from tracker.albedo import Rendering, rerender
from tracker.head import HeadModel
from tracker.scene import Scene
from tracker.track import F32, F64

PARTS = ("left eye", "right eye", "nose", "mouth")
EYES, MOUTH = ("left_eyelid", "right_eyelid"), "inner_lip"
BROWS_M = 0.006  # an eye's part reaches so much higher than low
NOSE = 0.6  # of the way from the eyes to the mouth
RADII_M = {"left eye": 0.022, "right eye": 0.022, "nose": 0.018, "mouth": 0.026}
BLUR_M = 0.001
SMALLEST = 10  # px, of a part's sides
ALIKE = 0.5  # correlation below which the shift means nothing
STEPS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-3)


def shifts(run: RunFolder, head: HeadModel, used: NDArray[np.bool_]) -> F64:
    """[T, 4] mm in the picture, of PARTS in the frames used [T], about their usual shifts; NaN where not found."""
    pictures = TrackPictures.of(run, head, ("albedo",))
    assert pictures.albedo is not None
    rows = parts(head, pictures.track.identity)
    found = np.full((len(used), len(PARTS), 2), np.nan)
    for frame, (_, rgb) in enumerate(FrameReader(run.video)):
        if used[frame]:
            seen = pictures.scene(rgb, frame)
            found[frame] = beside(seen, rerender(seen, pictures.albedo), rows)
    return about_usual(found)


def about_usual(found: F64) -> F64:
    """[T, n] mm, how far shifts [T, n, 2] lie from each part's median; NaN where there are none."""
    apart = np.full(found.shape[:2], np.nan)
    for part, moved in enumerate(np.moveaxis(found, 1, 0)):
        known = np.isfinite(moved).all(1)
        if known.any():
            apart[known, part] = np.linalg.norm(moved[known] - np.median(moved[known], axis=0), axis=1)
    return apart


def parts(head: HeadModel, identity: F32) -> list[NDArray[np.int64]]:
    """The face's vertices about each of PARTS."""
    neutral = head.vertices(identity, np.zeros(len(head.expression_names), np.float32)).astype(np.float64)
    face = head.regions["face"]

    def middle(name: str) -> F64:
        rims = np.concatenate([head.regions[f"{name}_{side}"] for side in ("upper", "lower")])
        return neutral[rims].mean(0)

    (left, right), mouth = (middle(name) for name in EYES), middle(MOUTH)
    nose = (1 - NOSE) * (left + right) / 2 + NOSE * mouth
    brows = np.array([0.0, BROWS_M, 0.0])
    places = (left + brows, right + brows, nose, mouth)
    return [
        face[np.linalg.norm((neutral[face] - place)[:, :2], axis=1) < RADII_M[part]]
        for part, place in zip(PARTS, places)
    ]


def beside(seen: Scene, rendering: Rendering, rows: list[NDArray[np.int64]]) -> F64:
    """[n, 2] mm, right and down, from the parts with vertices `rows` as they should look to the picture's.

    NaN where they are not found.
    """
    blur = max(0.5, BLUR_M * seen.px_per_m)
    expected, picture = (
        cv2.GaussianBlur(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), (0, 0), blur)
        for colour in (rendering.colour, rendering.blurred)
    )
    found = np.full((len(rows), 2), np.nan)
    for part, vertices in enumerate(rows):
        places = seen.pixels[vertices, :2] - seen.low
        low = np.maximum(np.floor(places.min(0)).astype(int), 0)
        high = np.minimum(np.ceil(places.max(0)).astype(int) + 1, expected.shape[::-1])
        if (high - low < SMALLEST).any():
            continue
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        start, known = np.eye(2, 3, dtype=np.float32), rendering.known[window]
        try:
            alike, moved = cv2.findTransformECC(
                expected[window], picture[window], start, cv2.MOTION_TRANSLATION, STEPS, known, 1
            )
        except cv2.error:  # it does not converge
            continue
        if alike > ALIKE:
            found[part] = 1e3 * moved[:, 2] / seen.px_per_m
    return found
