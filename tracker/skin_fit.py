"""Fit a stretch of frames to the grey levels of the skin, coarse to fine, from where the landmarks left it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tracker.appearance import Bool, Skin, appearance, frame_light, harmonics, seen_skin, shaded, skin_of
from tracker.energy import POSE, Energy, rotation_matrix
from tracker.photometric import PhotometricEnergy
from tracker.solver import Smoothness, solve_frames
from tracker.track import F32, F64
from tracker.view import U8, Index, View, Window

if TYPE_CHECKING:
    from tracker.head import HeadModel

LEAST_NOISE = 1.0  # grey levels
FARTHEST = 8.0  # standard deviations: a point counts for no more in a frame's mean deviation


@dataclass(frozen=True)
class Photometry:
    """How much grey levels count, and through which blurs they are looked at."""

    blurs_mm: tuple[float, ...] = (1.8, 1.1, 0.7)
    """Standard deviations on the face, coarse to fine."""
    least_blur_px: float = 1.0
    """No blur is smaller than this in the pictures worked on."""
    finest_px_per_m: float = 1600.0
    """Pictures of larger faces are shrunk to this: the finest blur is a pixel of it."""
    evidence: float = 0.1
    """Share of the points that err independently; neighbours err together."""
    robust: float = 2.5
    """Cauchy scale, in standard deviations of a point's grey level."""
    prior: float = 2.0
    """Factor on the landmark fit's expression prior: more evidence needs more holding of what it cannot tell."""
    pair_noise_mm: float = 0.04
    """Standard deviation of an opening between lips, or lids, from what the landmarks (of lips: moved by the colours)
    have: real lips roll, wet and fold as no albedo tells.

    At 1 the skin opened lips by 1 to 3 mm on real clips that the eye sees shut, at .2 some by 1.5.
    """
    pair_noise_share: float = 0.01
    """What this grows by with the opening."""
    edge_blurs: float = 1.0
    """Skin nearer to the mouth's inside than so many standard deviations of a blur shows teeth and dark as well."""
    smoothness: float = 20.0
    """Factor on the landmark fit's smoothness, but of the lids', which shut in two frames and are no skin compared: the
    skin shows motion so much finer than landmarks do."""
    steps: int = 2
    """Gauss-Newton steps at each blur."""
    refitting: int = 3
    """Steps of the landmark fit after identity and openings have been read from the pictures."""
    steadying: int = 2
    """Rounds in which the key frames tell what would move them all alike."""


@dataclass(frozen=True)
class Level:
    """What the skin looks like through one blur.

    blur_px: sd in px of the cut pictures. albedo: [P]. light: [9], the clip's usual. noise: [P], sd of a grey level.
    pull: [U], see PhotometricEnergy.
    """

    blur_px: float
    albedo: F32
    light: F64
    noise: F32
    pull: F64


@dataclass(frozen=True)
class Subject:
    """What stays the same along the clip, and the landmark energy of its n measured frames. identity: [Ki]."""

    head: HeadModel
    identity: F32
    energy: Energy
    skin: Skin
    window: Window
    photometry: Photometry

    @classmethod
    def of(cls, head: HeadModel, identity: F32, energy: Energy, observed: F64, ends: F64) -> Subject:
        """The subject with sample points on the skin and windows around the landmarks.

        observed: [n, 478, 2] px; a user's head may know few of them, with no chin. ends: [n, 2, 2] px,
        first and last (x, y) of the pictures.
        """
        photometry = Photometry()
        window = Window.around(observed, energy.px_per_m, photometry.finest_px_per_m, ends)
        weights = replace(
            energy.weights,
            pair_noise_mm=photometry.pair_noise_mm,
            pair_noise_share=photometry.pair_noise_share,
        )
        energy = replace(energy, weights=weights, strictness=energy.strictness * photometry.prior)
        return cls(head, identity, energy, skin_of(head, energy.model, identity), window, photometry)

    def with_identity(self, identity: F64) -> Subject:
        """The same with another identity [Ki]."""
        subject = identity.astype(np.float32)
        return replace(self, identity=subject, skin=skin_of(self.head, self.energy.model, subject))

    @property
    def smoothness(self) -> F64:
        """[U] factor on the landmark fit's smoothness."""
        free = np.append(self.energy.model.of_lids(), np.zeros(POSE, bool))
        return np.where(free, 1.0, self.photometry.smoothness)

    @property
    def px_per_m(self) -> float:
        """The face's usual scale in the cut pictures."""
        return float(np.median(self.energy.px_per_m)) * self.window.scale

    @property
    def blurs_px(self) -> list[float]:
        """The blurs in px of the cut pictures; those that come out alike are one."""
        wanted = {
            max(1e-3 * blur * self.px_per_m, self.photometry.least_blur_px)
            for blur in self.photometry.blurs_mm
        }
        return sorted(wanted, reverse=True)

    def look(self, rows: Index, x: F64) -> tuple[F32, F32]:
        """Which points [n, P] the pictures show at x [n, U], 0 or 1, and the harmonics [n, P, 9] of their normals."""
        model, window, matrix = self.energy.model, self.window, rotation_matrix(x[:, -6:-3])
        seen = np.zeros((len(rows), len(self.skin)), np.float32)
        normals = np.zeros((*seen.shape, 3), np.float32)
        moved = (part.astype(np.float32) for part in model.modes.head_weights(x[:, :-POSE]))
        for n, (row, expression, jaw) in enumerate(zip(rows, *moved)):
            face = self.head.vertices(self.identity, expression, jaw=jaw) - model.centre
            camera = (face @ matrix[n].T + x[n, -3:]).astype(np.float32)
            principal = window.principal(self.energy.principal, row)
            focal = self.energy.focal * window.scale
            own = window.own(int(row), self.blurs_px[0])
            seen[n], normals[n] = seen_skin(self.skin, self.head, camera, focal, principal, window.size, own)
        return seen, harmonics(normals)

    def photometric(self, cuts: Sequence[U8], rows: Index, seen: F32, blur_px: float) -> PhotometricEnergy:
        """Energy of some frames through one blur; nothing is expected of the skin yet."""
        window = self.window.select(rows)
        skin = self.skin.to_inside * self.px_per_m > self.photometry.edge_blurs * blur_px
        return PhotometricEnergy(
            landmarks=self.energy.select(rows),
            skin=self.skin,
            view=View.blurred(cuts, window, blur_px),
            expected=np.zeros_like(seen),
            seen=seen * skin * np.float32(self.photometry.evidence),
            noise=np.full(len(self.skin), LEAST_NOISE, np.float32),
            robust=self.photometry.robust,
            pull=np.zeros(self.energy.model.expressions + POSE),
        )


def fit_landmarks(subject: Subject, x: F64, smoothness: Smoothness) -> F64:
    """All frames from x [n, U] on, by landmarks alone, which have changed since, or the identity has."""
    shape = subject.energy.shape(subject.identity.astype(np.float64))
    return solve_frames(subject.energy, shape, x, smoothness, steps=subject.photometry.refitting)


def learn_levels(subject: Subject, cuts: Sequence[U8], rows: Index, x: F64) -> list[Level]:
    """What the skin looks like through each blur, from frames `rows` at their landmark fit x [n, U].

    Once and never again: an albedo that follows the fit lets the mean opening of the mouth drift, and a slow turn of
    the head keep the error that wrong depths of the face gave it.
    """
    seen, basis = subject.look(rows, x)
    levels, now = [], x
    for blur in subject.blurs_px:
        energy = subject.photometric(cuts, rows, seen, blur)
        grey = energy.grey(x)
        albedo, usual = appearance(grey, basis, seen)
        expected = shaded(albedo, basis, frame_light(grey, albedo, basis, seen, usual))
        noise = grey_noise(grey - expected, seen > 0, subject.skin.mouth)
        energy = replace(energy, expected=expected, noise=noise)
        energy = replace(energy, pull=energy.linearize_skin(x).gradient.mean(0))
        for _ in range(subject.photometry.steadying):
            energy, now = _steadied(energy, subject, x, now)
        levels.append(Level(blur, albedo, usual, noise, energy.pull))
    return levels


def grey_noise(error: F32, seen: Bool, mouth: Bool) -> F32:
    """Standard deviation [P] of grey levels by the median of errors [n, P], which outliers do not reach.

    Rigid skin has one in common. Around the mouth [P] it stretches, folds and gets wet as no albedo tells: each point
    that errs more than usual has its own.
    """
    size = np.ma.masked_array(1.4826 * np.abs(error), ~seen)
    usual = float(np.ma.median(size)) if seen.any() else 0.0
    own = np.where(mouth, np.ma.median(size, axis=0).filled(0.0), 0.0)
    return np.maximum(own, max(usual, LEAST_NOISE)).astype(np.float32)


def _steadied(
    energy: PhotometricEnergy, subject: Subject, anchor: F64, x: F64
) -> tuple[PhotometricEnergy, F64]:
    """The energy with a pull under which the frames' mean stays that of `anchor`, and where they then go from x.

    The method of multipliers on that mean: only grey levels' differences between frames are evidence. The frames give
    way by the mean of their compliances, which what is soft in one of them makes far from the mean stiffness' inverse.
    """
    shape = subject.energy.shape(subject.identity.astype(np.float64))
    alone = Smoothness.none(*x.shape)
    x = solve_frames(energy, shape, x, alone, steps=subject.photometry.steps)
    drift = (x - anchor).mean(0)
    compliance = np.linalg.inv(energy.linearize(shape, x).hessian).mean(0)
    return replace(energy, pull=energy.pull - np.linalg.solve(compliance, drift)), x


def fit_stretch(
    subject: Subject, levels: list[Level], cuts: Sequence[U8], rows: Index, x: F64, smoothness: Smoothness
) -> tuple[F64, F64, F64]:
    """Frames `rows`, from x [n, U] on; returns x and their deviation [n, 2] (see `deviation`) before and after."""
    seen, basis = subject.look(rows, x)
    shape = subject.energy.shape(subject.identity.astype(np.float64))
    start = x
    for level in levels:
        energy = subject.photometric(cuts, rows, seen, level.blur_px)
        expected = _expected(energy.grey(x), level, basis, seen)
        energy = replace(energy, expected=expected, noise=level.noise, pull=level.pull)
        x = solve_frames(energy, shape, x, smoothness, steps=subject.photometry.steps)
    return x, deviation(energy, start), deviation(energy, x)


def _expected(grey: F32, level: Level, basis: F32, seen: F32) -> F32:
    """[n, P] under the light of each frame, which what covers the skin must not dim."""
    light = frame_light(grey, level.albedo, basis, seen, level.light)
    error = (grey - shaded(level.albedo, basis, light)) / (3 * level.noise)
    light = frame_light(grey, level.albedo, basis, seen / (1 + error**2), level.light)
    return shaded(level.albedo, basis, light)


def deviation(energy: PhotometricEnergy, x: F64) -> F64:
    """[n, 2] mean absolute deviation of the grey levels seen, in sd: of all points and the mouth's, NaN of none."""
    error = np.minimum(np.abs(energy.grey(x) - energy.expected) / energy.noise, FARTHEST)
    parts = np.stack([energy.seen, energy.seen * energy.skin.mouth])
    count = parts.sum(2)
    mean = (parts * error).sum(2) / np.maximum(count, 1e-9)
    return np.where(count > 0, mean, np.nan).T.astype(np.float64)
