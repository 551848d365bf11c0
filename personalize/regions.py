"""Parts of the face by name, as how far an edit keeps each vertex."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from model.checkpoint import Checkpoint
from personalize.errors import UserError


def kept_share(
    checkpoint: Checkpoint, keep: Iterable[str], remake: Iterable[str], blend_m: float
) -> NDArray[np.float32] | None:
    """Names of regions to keep, or of those to make anew -> share [D] f32, 1 kept .. 0 made anew; None without names.

    What is named is kept or made anew wholly; from its border outwards the share changes linearly over `blend_m` along
    the surface. Raises UserError for an unknown name, for names of both kinds, and for a width that is none.
    """
    keep, remake = tuple(keep), tuple(remake)
    if not np.isfinite(blend_m):
        raise UserError(f"--blend-mm {1e3 * blend_m:g}: give a width in mm")
    if keep and remake:
        raise UserError("--keep-regions and --remake: give one of them; what it does not name is the other")
    if not keep and not remake:
        return None
    for name in keep + remake:
        if name not in checkpoint.regions:
            known = ", ".join(sorted(checkpoint.regions))
            raise UserError(f"{name!r} is not a region of this checkpoint; choose from {known}")
    named = np.unique(np.concatenate([checkpoint.regions[name] for name in keep + remake]))
    near = _nearness(checkpoint.template, checkpoint.faces, named, blend_m)
    return near if keep else 1 - near


def _nearness(
    template: NDArray[np.float32], faces: NDArray[np.int32], named: NDArray[np.integer], width_m: float
) -> NDArray[np.float32]:
    """[D]: 1 on the named vertices, falling to 0 at `width_m` from them along the edges of the mesh."""
    near = np.zeros(len(template), np.float32)
    if width_m > 0:
        ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
        lengths = np.linalg.norm(template[ends[0]] - template[ends[1]], axis=1)
        _, first = np.unique(
            ends, axis=1, return_index=True
        )  # coo would add the lengths of an edge given twice
        edges = coo_array((lengths[first], ends[:, first]), shape=(len(template),) * 2).tocsr()
        distance = dijkstra(edges, directed=False, indices=named, min_only=True, limit=width_m)
        near = np.maximum(0, 1 - distance / width_m).astype(np.float32)
    near[named] = 1
    return near
