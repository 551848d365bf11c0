"""Take the base model to a head that has got further shapes: `python -m tools.widen_base`.

The motion basis gets what it lacks of the head's shapes; the network reads nothing from the new coefficients and leaves
them at rest, so that all it knew stays as it was. No talker moves these shapes: a person's own video teaches them.
Where nothing is missing nothing changes.
"""

from __future__ import annotations

import argparse
from dataclasses import fields, replace

import numpy as np
import torch
from torch import Tensor

from model.basis import orthonormal
from model.checkpoint import Checkpoint
from model.dataset import Standardization
from tools.build_base import OUTPUT
from tracker.head import ASSET, HeadModel, read_head

HELD = 0.99  # share of a shape's norm from which the basis has it
BY_COEFFICIENT = {"encoder.weight": 1, "decoder.weight": 0, "decoder.bias": 0}  # the axis of each


def widened(base: Checkpoint, head: HeadModel) -> Checkpoint:
    """The base with a basis that holds every shape of the head, which must have the base's template and faces."""
    known = base.basis.reshape(len(base.basis), -1).astype(np.float64)
    shapes = head.expression_basis.reshape(len(head.expression_basis), -1).astype(np.float64)
    held = shapes @ known.T
    missing = np.linalg.norm(held, axis=1) < HELD * np.linalg.norm(shapes, axis=1)
    if not missing.any():
        return base
    beyond = (shapes - held @ known)[missing].reshape(-1, *base.template.shape)
    added, _ = orthonormal(beyond.astype(np.float32))
    more = len(added)
    statistics = base.standardization
    unmoved = {"mean": 0.0, "scale": float(statistics.scale.min()), "spread": 0.0}
    arrays = {
        name.name: np.append(getattr(statistics, name.name), np.full(more, unmoved[name.name], np.float32))
        if name.name in unmoved
        else getattr(statistics, name.name)
        for name in fields(Standardization)
    }

    def grown(state: dict[str, Tensor]) -> dict[str, Tensor]:
        out = dict(state)
        for name, axis in BY_COEFFICIENT.items():
            shape = list(state[name].shape)
            shape[axis] = more
            out[name] = torch.cat([state[name], torch.zeros(shape)], dim=axis)
        return out

    return replace(
        base,
        config=replace(base.config, coefficients=len(base.basis) + more),
        basis=np.concatenate([base.basis, added]),
        standardization=Standardization(**arrays),
        network=grown(base.network),
        ema=grown(base.ema),
        provenance=base.provenance | {"widened": more},
    )


def main() -> None:
    """Widen the shipped base in place."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    base = widened(Checkpoint.load(OUTPUT), read_head(ASSET))
    base.save(OUTPUT)
    print(f"{OUTPUT}: {len(base.basis)} coefficients, {OUTPUT.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
