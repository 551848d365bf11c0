"""A head's movements as the fit solves them: linear modes with bounds and priors, and what they mean to the head.

An embedded head gives its ARKit shapes, 0..1, and four of the lips' profile, -1..1. A head of signed shapes gives
those, with a Gaussian prior, and its jaw: opening and side turn, each as the displacement at a turn of JAW_STEP. That
chord differs from the arc, at the chin, by 0.6 mm at a jaw angle of 0.25 rad and 2.6 mm at 0.35 rad, mostly in depth;
the fit keeps one solver for all heads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tracker.track import F32, F64, TrackError

if TYPE_CHECKING:
    from tracker.energy import Weights
    from tracker.head import HeadModel

JAW_STEP, WIDEST_JAW = 0.2, 0.7  # rad
# A lip up by two or three half waves from corner to corner, 5 mm at weight 1.
LIP_SHAPES = ("lipUpper2", "lipUpper3", "lipLower2", "lipLower3")
# Shapes that trade depth against pose, or that landmarks cannot see.
AMBIGUOUS = ("jawForward", "tongueOut", "cheekPuff")
# Those that trade a shift to the side against pose, which a mouth pulled awry does show.
ASIDE = ("jawLeft", "jawRight", "mouthLeft", "mouthRight")


@dataclass(frozen=True)
class Modes:
    """K movements. Their prior is rate · w + precision · w² / 2 within lower <= w <= upper, all [K].

    to_head: [K, Ke + 3], expression weights and jaw (axis-angle, rad) of the head at weight 1.
    expression_range: the bounds of the head's own expression weights, [Ke] each.
    """

    to_head: F64
    lower: F64
    upper: F64
    rate: F64
    precision: F64
    expression_range: tuple[F64, F64]

    def __len__(self) -> int:
        return len(self.to_head)

    def head_weights(self, weights: F64) -> tuple[F64, F64]:
        """[.., K] the solver's weights -> the head's expression [.., Ke], within its range, and jaw [.., 3] rad."""
        both = weights @ self.to_head
        return np.clip(both[..., :-3], *self.expression_range), both[..., -3:]

    def of_head(self, expression: F64, jaw: F64) -> F64:
        """[.., K] the inverse of `head_weights`, within the bounds, where that has cut nothing off."""
        weights = np.concatenate([expression, jaw], axis=-1) @ np.linalg.pinv(self.to_head)
        return np.clip(weights, self.lower, self.upper)


def head_modes(head: HeadModel, weights: Weights) -> Modes:
    """The modes of a head. Raises TrackError for one of named shapes that lacks ARKit's jaw."""
    return _signed_modes(head, weights) if head.signed else _arkit_modes(head, weights)


def _arkit_modes(head: HeadModel, weights: Weights) -> Modes:
    """mouthClose carries jawOpen along: 0 <= mouthClose <= jawOpen is then a plain bound."""
    names = list(head.expression_names)
    if not {"jawOpen", "mouthClose"} <= set(names):
        raise TrackError(
            f"head {head.name} has no jawOpen and mouthClose: fit a head with ARKit-named shapes"
        )
    count = len(names)
    to_head = np.eye(count, count + 3)
    to_head[names.index("mouthClose"), names.index("jawOpen")] = 1.0
    mean = np.full(count, weights.expression_mean)
    mean[np.isin(names, AMBIGUOUS)], mean[np.isin(names, ASIDE)] = weights.ambiguous_mean, weights.aside_mean
    profile = np.isin(names, LIP_SHAPES)
    rate = np.where(profile, 0.0, 1.0 / mean)
    precision = np.where(profile, weights.lip_shape_sd, weights.expression_sd) ** -2.0
    lower, upper = np.where(profile, -1.0, 0.0), np.ones(count)
    return Modes(to_head, lower, upper, rate, precision, (lower, upper))


def _signed_modes(head: HeadModel, weights: Weights) -> Modes:
    """Shapes in standard deviations, then opening and side turn of the jaw where the head has joints."""
    shapes = len(head.expression_basis)
    count = shapes + (2 if head.skeleton is not None else 0)
    to_head = np.zeros((count, shapes + 3))
    to_head[:shapes, :shapes] = np.eye(shapes)
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    precision = np.full(count, weights.signed_sd**-2)
    if head.skeleton is not None:
        to_head[shapes, shapes], to_head[shapes + 1, shapes + 1] = JAW_STEP, JAW_STEP
        lower[shapes], upper[shapes] = 0.0, WIDEST_JAW / JAW_STEP
        # No exponential prior: the opening would go into the shapes, which have none.
        precision[shapes:] = (JAW_STEP / np.array([weights.jaw_open_sd, weights.jaw_side_sd])) ** 2
    anything = np.full(shapes, np.inf)
    return Modes(to_head, lower, upper, np.zeros(count), precision, (-anything, anything))


def movements(head: HeadModel) -> F32:
    """[Ke + 3, D, 3] what one unit of each expression weight and, as a chord, of each jaw angle moves: m, m/rad.

    `modes.to_head` times this are the modes' displacements.
    """
    jaw = np.zeros((3, *head.template.shape), np.float32)
    if head.skeleton is not None:
        rest = np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_basis))
        jaw[:] = (head.vertices(*rest, jaw=JAW_STEP * np.eye(3)) - head.template) / JAW_STEP
    return np.concatenate([head.expression_basis, jaw])
