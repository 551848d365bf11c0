"""The identity from the skin's grey levels in key frames: a turn shows how deep a face is by how its texture shifts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from tracker.appearance import appearance, frame_light, shaded
from tracker.energy import POSE, Energy, LandmarkModel, Quadratic, Weights, left_jacobian, rotation_matrix
from tracker.fit import at_ease
from tracker.jacobian import fill_rows
from tracker.key_frames import KeyFrames
from tracker.photometric import PhotometricEnergy
from tracker.skin_fit import Subject, grey_noise
from tracker.solver import PosesHeld, Smoothness, solve_frames, solve_subject
from tracker.track import F32, F64
from tracker.view import U8, Index

EVIDENCE = 3.0  # of the grey levels, times theirs in the fit of one frame
STEPS = 1  # of Gauss and Newton at each blur: a second one tells no more
# As the logarithm of how much it differs from frame to frame: chance alone makes such a difference.
LESS_ALIKE = 0.07
REFITTING = 3  # steps of expressions under poses that are held
BLOCK = 256  # points whose rows of all key frames are held at once


@dataclass(frozen=True)
class SubjectEnergy:
    """Landmarks and grey levels of n key frames as functions of the identity and of what the frames show.

    skin: what it expects is not read. moves: [P, 3, Ki] m, of its points by the identity. light: [n, P], how bright
    white skin would be. weight: [n, P], how much each frame counts for a point's albedo. The albedo follows: it is
    always the weighted mean of what the frames show, so that only what differs between them tells.
    """

    landmarks: Energy
    skin: PhotometricEnergy
    moves: F32
    light: F32
    weight: F32

    @classmethod
    def at(cls, skin: PhotometricEnergy, moves: F32, basis: F32, identity: F64, x: F64) -> SubjectEnergy:
        """With the light of the frames, and how far each point is believed in each, as they are at identity and x.

        skin: of the mean head. basis: [n, P, 9], `harmonics` of the points' normals.
        """
        nothing = np.zeros_like(skin.seen)
        energy = cls(skin.landmarks, skin, moves, nothing, nothing)
        grey = energy._of(energy.shape(identity))[1].grey(x)
        albedo, usual = appearance(grey, basis, skin.seen)
        light = frame_light(grey, albedo, basis, skin.seen, usual)
        bright = shaded(np.ones_like(albedo), basis, light)
        error = grey - bright * albedo
        skin = replace(skin, noise=grey_noise(error, skin.seen > 0, skin.skin.mouth))
        return replace(energy, skin=skin, light=bright, weight=skin.loss(error)[1])

    @property
    def model(self) -> LandmarkModel:
        """The head at the landmarks."""
        return self.landmarks.model

    @property
    def weights(self) -> Weights:
        """Of the landmarks; the identity's prior among them."""
        return self.landmarks.weights

    def shape(self, identity: F64) -> F64:
        """[L+P, 3] m, landmarks and skin points at rest."""
        skin = self.skin.skin.rest + self.moves @ identity
        return np.concatenate([self.landmarks.shape(identity), skin])

    def value(self, shape: F64, x: F64) -> F64:
        """[n] the energy at x [n, U] of the subject `shape`."""
        return self.landmarks.value(self._of(shape)[0], x) + self.skin_loss(shape, x)

    def skin_loss(self, shape: F64, x: F64) -> F64:
        """[n] the part of the grey levels."""
        skin = self._of(shape)[1]
        grey = skin.grey(x)
        return skin.loss(grey - self.light * self._albedo(grey))[0]

    def linearize(self, shape: F64, x: F64, with_identity: bool = False) -> Quadratic:
        """Gauss-Newton model at x [n, U]; with identity the unknowns are [identity (Ki), x].

        What a frame's own x does to the albedo, a share of one in n, is left out.
        """
        landmarks, skin = self._of(shape)
        known = self.landmarks.linearize(landmarks, x, with_identity)
        turned, camera = skin.points(x)
        grey, slope = skin.read(camera)
        residual = grey - self.light * self._albedo(grey)
        loss, precision = skin.loss(residual)
        root = np.sqrt(precision)
        pose = rotation_matrix(x[:, -6:-3]).astype(np.float32), left_jacobian(x[:, -6:-3]).astype(np.float32)
        identity = self.moves if with_identity else self.moves[:, :, :0]
        moves = np.concatenate([identity, skin.skin.expression], axis=2)
        count, gradient, hessian = identity.shape[2], known.gradient.copy(), known.hessian.copy()
        for start in range(0, len(moves), BLOCK):
            part = np.s_[:, start : start + BLOCK]
            rows = np.empty((*residual[part].shape, 1, moves.shape[2] + POSE), np.float32)
            fill_rows(turned[part], slope[part][:, :, None], *pose, moves[start : start + BLOCK], rows)
            rows = rows[:, :, 0]
            rows[..., :count] -= self.light[part][..., None] * self._albedo(rows[..., :count], part)
            rows *= root[part][..., None]
            weighted = (root * residual)[part][..., None]
            gradient += (rows.transpose(0, 2, 1) @ weighted)[..., 0]
            hessian += rows.transpose(0, 2, 1) @ rows
        return Quadratic(known.value + loss, gradient, hessian)

    def _of(self, shape: F64) -> tuple[F64, PhotometricEnergy]:
        """The landmarks [L, 3] and the skin of a subject."""
        count = len(self.model.mean)
        rest = shape[count:].astype(np.float32)
        return shape[:count], replace(self.skin, skin=replace(self.skin.skin, rest=rest))

    def _albedo(self, grey: F32, part: tuple[slice, slice] = np.s_[:, :]) -> F32:
        """[p, ..] of some points from their grey levels, or derivatives of these, [n, p, ..]."""
        light, weight = self.light[part], self.weight[part]
        share = weight * light / np.maximum((weight * light**2).sum(0), 1e-6)
        return np.einsum("np,np...->p...", share, grey)


def fit_identity_to_skin(subject: Subject, cuts: Mapping[int, U8], keys: KeyFrames, x: F64) -> F64:
    """Identity [Ki] from key frames at their landmark fit x [n, U]; the subject's where that brings the skin no nearer.

    What poses and expressions gain meanwhile counts for the new one. cuts: the faces of those that there are, by rows.
    """
    keys = keys.among(np.array(list(cuts)))
    rows = keys.rows
    if not len(rows):
        return subject.identity.astype(np.float64)
    landmarks = at_ease(subject.energy.select(rows), keys)
    identity, x = start = subject.identity.astype(np.float64), x[rows]
    seen, basis = subject.look(rows, x)
    moves = _movements(subject)
    mean = replace(subject.skin, rest=subject.skin.rest - moves @ subject.identity)
    for blur in subject.blurs_px:
        skin = subject.photometric([cuts[row] for row in rows.tolist()], rows, seen, blur)
        skin = replace(skin, landmarks=landmarks, skin=mean, seen=skin.seen * EVIDENCE)
        energy = SubjectEnergy.at(skin, moves, basis, identity, x)
        solution = solve_subject(energy, identity, x, steps=STEPS)
        identity, x = solution.identity, solution.x
    before, after = (energy.skin_loss(energy.shape(shape), at).sum() for shape, at in (start, (identity, x)))
    return identity if after < before else start[0]


def nearer_to_skin(subject: Subject, cuts: Mapping[int, U8], rows: Index, x: F64, other: F64) -> float:
    """0..1, how surely skin in the frames `rows` looks as much alike under the poses in `other` [n, U] as under x's.

    1 if it does, 0 from LESS_ALIKE on. cuts: the frames' faces, by rows. The skin above the mouth is asked, and where
    each pose has it: with expressions that fit the landmarks under that pose. Each of the two is asked what it believes
    of light and noise, and both are judged by either.
    """
    identity, moves = subject.identity.astype(np.float64), _movements(subject)
    landmarks = subject.energy.select(rows)
    held, alone = PosesHeld(landmarks), Smoothness.none(len(rows), x.shape[1])
    shape = landmarks.shape(identity)
    both = tuple(solve_frames(held, shape, at[rows], alone, steps=REFITTING) for at in (x, other))
    upper = subject.skin.rest[:, 1] > landmarks.model.upper_face[:, 1].min()
    mean = replace(subject.skin, rest=subject.skin.rest - moves @ subject.identity)
    loss = np.zeros(2)
    for at in both:
        seen, basis = subject.look(rows, at)
        skin = subject.photometric(
            [cuts[row] for row in rows.tolist()], rows, seen * upper, subject.blurs_px[-1]
        )
        skin = replace(skin, landmarks=landmarks, skin=mean)
        energy = SubjectEnergy.at(skin, moves, basis, identity, at)
        loss += [energy.skin_loss(energy.shape(identity), where).sum() for where in both]
    seen = loss.min() > 0  # black frames look alike under whatever poses
    return float(np.clip(1 - np.log(loss[1] / loss[0]) / LESS_ALIKE, 0, 1)) if seen else 0.0


def _movements(subject: Subject) -> F32:
    """[P, 3, Ki] m, of the skin's points by the identity."""
    corners = subject.head.faces[subject.skin.triangles]
    basis = np.asarray(subject.head.identity_basis, np.float32)[:, corners]
    return np.ascontiguousarray(np.einsum("pc,kpcx->pxk", subject.skin.barycentric, basis))
