"""A person's blinks, taken out of the motion and given back at moments of their own.

Some people blink four times in a clip. Shown beside the words that were being said, four are learned by heart: the
network then blinks at these words, and never at others (docs/method.md). So training sees each moment with the eyes
open, and with blinks of the same person that fall at random, as often as the person's do as far as the clip tells.
"""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from model.checkpoint import Checkpoint
from model.dataset import Sequence
from model.metrics import EYELIDS, eyelid_opening_mm
from model.motion import FPS
from model.objective import SMALLEST_SPREAD
from model.vertex_mask import masked

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Of the usual opening of the eyes: a blink falls below the first, and leaves them at more than the second.
SHUT, OPEN = 0.65, 0.75
# It lasts while the lids move by more than this a frame, and no longer than that: eyes may also look down.
LEAST_CHANGE, LONGEST_FRAMES = 0.02, 20
# What moves with the lids: all that is as near as the first, nothing beyond the second.
NEAR_M, FAR_M = 0.015, 0.035
# Three blinks in a clip tell little of how often a person blinks. Who talks does so 26 times a minute on the mean
# (Bentivoglio et al. 1997); that people differ by half of it is our judgement. That is worth:
USUAL_BLINKS = 4
USUAL_FRAMES = USUAL_BLINKS * 60 * FPS / 26
DRAWN_FRAMES = 20_000


def independent_blinks(
    checkpoint: Checkpoint, sequences: Many[Sequence], seed: int
) -> tuple[list[Sequence], F32 | None]:
    """The sequences without their blinks, and blinks at random moments, [S, N, K] m for the checkpoint's S styles.

    Where the mesh names no eyelids, or nobody blinks, the sequences as they are and None.
    """
    if not all(name in checkpoint.regions for pair in EYELIDS for name in pair):
        return list(sequences), None
    around = _around_eyes(checkpoint)
    opened = [_opened(checkpoint, sequence, around) for sequence in sequences]
    drawn = np.zeros((len(checkpoint.styles), DRAWN_FRAMES, len(checkpoint.basis)), np.float32)
    random = np.random.default_rng(seed)
    for style in sorted({sequence.style for sequence in sequences}):
        own = [(q, blinks) for q, blinks in opened if q.style == style]
        blinks = [blink for _, some in own for blink in some]
        if blinks:
            frames = sum(int(q.valid.sum()) for q, _ in own)
            every = (frames + USUAL_FRAMES) / (len(blinks) + USUAL_BLINKS)
            drawn[style] = at_random(blinks, every, DRAWN_FRAMES, random)
    return [q for q, _ in opened], drawn if drawn.any() else None


def blink_spans(opening: F32, valid: NDArray[np.bool_]) -> list[slice]:
    """Frames of each blink in an opening of the eyes [N] mm, from the last before the lids fall to the first at rest.

    A blink that a cut or an invalid frame breaks off, or that does not end, is left out.
    """
    if not valid.any() or (usual := float(np.median(opening[valid]))) <= 0:
        return []
    share = np.where(valid, opening / usual, np.nan)
    shut = np.flatnonzero(share < SHUT)
    spans = []
    for run in np.split(shut, np.flatnonzero(np.diff(shut) > 1) + 1) if len(shut) else []:
        first, last = int(run[0]), int(run[-1])
        while first > 0 and share[first - 1] > share[first] + LEAST_CHANGE:
            first -= 1
        while last + 1 < len(share) and share[last + 1] > share[last] + LEAST_CHANGE:
            last += 1
        if min(share[first], share[last]) > OPEN and last - first < LONGEST_FRAMES:
            spans.append(slice(first, last + 1))
    return spans


def at_random(blinks: Many[F32], every: float, frames: int, random: np.random.Generator) -> F32:
    """[frames, K]: some of the blinks [n, K], one in `every` frames on the mean, and nothing between."""
    drawn = np.zeros((frames, blinks[0].shape[1]), np.float32)
    pause = max(every - float(np.mean([len(blink) for blink in blinks])), 1.0)
    first = round(random.exponential(pause))
    while first < frames:
        blink = blinks[int(random.integers(len(blinks)))][: frames - first]
        drawn[first : first + len(blink)] = blink
        first += len(blink) + round(random.exponential(pause))
    return drawn


def _opened(checkpoint: Checkpoint, sequence: Sequence, around: F64) -> tuple[Sequence, list[F32]]:
    """The sequence without its blinks, and what each moved the eyes by, [n, K] m."""
    mesh = checkpoint.template, checkpoint.basis, checkpoint.regions
    coefficients, blinks = sequence.coefficients.copy(), []
    for span in blink_spans(eyelid_opening_mm(*mesh, coefficients), sequence.valid):
        part = coefficients[span]
        along = np.linspace(0, 1, len(part))[:, None]
        blink = ((part - (1 - along) * part[0] - along * part[-1]) @ around).astype(np.float32)
        coefficients[span] -= blink
        blinks.append(blink)
    return replace(sequence, coefficients=coefficients), blinks


def _around_eyes(checkpoint: Checkpoint) -> F64:
    """[K, K]: keeps of coefficients what they move around the eyes, B diag(m) B' with m from 1 at the lids to 0.

    Into coefficients that the person hardly ever moves nothing goes: there any bit would outweigh all else in the loss.
    """
    lids = np.concatenate([checkpoint.regions[name] for pair in EYELIDS for name in pair])
    distance, _ = cKDTree(checkpoint.template[lids]).query(checkpoint.template)
    share = np.clip((FAR_M - distance) / (FAR_M - NEAR_M), 0, 1)
    return masked(checkpoint.basis, share) * (checkpoint.standardization.spread >= SMALLEST_SPREAD)
