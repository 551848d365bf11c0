"""Everything a user can set on a run. Each stage names the fields it reads; they are part of its key."""

from __future__ import annotations

from dataclasses import dataclass

from personalize.errors import UserError

# Of the picture's longer side. Beyond lie fisheyes and telescopes, and focal lengths that are in mm.
FOCAL_RANGE = (0.3, 10.0)
# How far out is looked, in times of half the longer side, for what a lens shows at ENOUGH of that; in so many steps.
# Farther out is hardly a face, and few calibrations hold there.
FARTHEST, STEPS, ENOUGH = 4.0, 4000, 0.85
LARGEST_SEED = 2**32 - 1


@dataclass(frozen=True)
class Settings:
    """Options of `personalize VIDEO`; the defaults are the recommended ones.

    iterations: fine-tuning steps (the paper: 30 000).
    seed: seed of every random draw.
    focal_px: focal length in pixels, None to estimate it.
    distortion: radial coefficients k1, k2, k3 or fewer, of OpenCV's model; they go with `focal_px`.
    base: checkpoint that fine-tuning starts from, None for the embedded one.
    encoder: folder or hub name of the speech encoder that `base` was trained with, None for the embedded one.
    device: that fine-tuning runs on, `cpu` or `cuda`.
    head: FLAME pickle to track with, None for the embedded head.
    head_embedding: its landmark embedding, None for the one that lies beside it.
    min_confidence: frames below it are left out of fine-tuning and evaluation, 0..1.
    tracked: folder of another tracker's result, to be read instead of tracking; it needs `head`.
    overlay: what the overlay film shows beside the video, of tracker.overlay.MODES.
    """

    iterations: int = 30_000
    seed: int = 0
    focal_px: float | None = None
    distortion: tuple[float, ...] = ()
    base: str | None = None
    encoder: str | None = None
    device: str = "cpu"
    head: str | None = None
    head_embedding: str | None = None
    tracked: str | None = None
    overlay: tuple[str, ...] = ("wireframe",)
    min_confidence: float = 0.5


def check_distortion(focal_px: float | None, distortion: tuple[float, ...], size: tuple[int, int]) -> None:
    """Raises UserError for a lens that would show two places of the world at one of the picture, (width, height) px."""
    if focal_px is None or not distortion:
        return
    k1, k2, k3 = (*distortion, 0.0, 0.0)[:3]
    edge, last = max(size) / 2 / focal_px, 0.0
    for step in range(1, STEPS + 1):
        straight = FARTHEST * edge * step / STEPS
        seen = straight * (1 + k1 * straight**2 + k2 * straight**4 + k3 * straight**6)
        if seen <= last:
            break
        if seen >= ENOUGH * edge:
            return
        last = seen
    given = ",".join(f"{number:g}" for number in distortion)
    raise UserError(
        f"--distortion {given}: with --focal {focal_px:g} such a lens folds a picture of {size[0]}x{size[1]} px over "
        "itself; give the coefficients that were calibrated with that focal length, for pictures of that size"
    )


def check_focal(focal_px: float | None, size: tuple[int, int]) -> None:
    """Raises UserError for a focal length that pictures of this size, (width, height) px, are hardly taken with."""
    low, high = (bound * max(size) for bound in FOCAL_RANGE)
    if focal_px is not None and not low <= focal_px <= high:  # nor is a NaN between them
        raise UserError(
            f"--focal {focal_px:g}: it is wanted in pixels, not mm; for this video of {size[0]}x{size[1]} px give "
            f"one between {low:.0f} and {high:.0f}, or leave it out and it is estimated"
        )
