"""What of a head's teeth and tongue is seen from the front."""

import numpy as np
from numpy.typing import NDArray

from tracker.head import HeadModel
from tracker.raster import rasterize

PIXELS_PER_M = 3000.0


def teeth_and_tongue(person: HeadModel, vertices: NDArray[np.floating]) -> NDArray[np.floating]:
    """[N, 2] m, where teeth or tongue are seen, a point a pixel."""
    pixels = np.stack(
        [vertices[:, 0] + 0.1, 0.1 - vertices[:, 1], (1 - vertices[:, 2]) / PIXELS_PER_M], axis=1
    )
    raster = rasterize(PIXELS_PER_M * pixels, person.faces, (600, 700))
    hidden = np.concatenate([person.regions["teeth"], person.regions["tongue"]])
    seen = (raster.triangle >= 0) & np.isin(person.faces, hidden).all(1)[raster.triangle]
    rows, columns = np.nonzero(seen)
    return np.stack([columns / PIXELS_PER_M - 0.1, 0.1 - rows / PIXELS_PER_M], axis=1)


def assert_seen_between_parted_lips_only(person: HeadModel, vertices: NDArray[np.floating]) -> None:
    """vertices: [T, D, 3] m, frames that close the mouth and open it."""
    gap, lips = person.lip_gap_mm(vertices), person.regions["lips"]
    assert len(teeth_and_tongue(person, vertices[gap.argmin()])) < 20
    wide = vertices[gap.argmax()]
    places = teeth_and_tongue(person, wide)
    assert len(places) > 200
    assert (places >= wide[lips, :2].min(0)).all() and (places <= wide[lips, :2].max(0)).all()
