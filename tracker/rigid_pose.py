"""Head poses held on the rigid upper face: what the bundle's feature tracks say against the landmarks' own poses.

Landmarks err in blocks that move with the head, so a pose fitted to them swings by a degree. The bundle's poses do
not, but they stand in a head frame of their own and exist on every third frame or so; the difference to the
landmarks' poses, one similarity for the clip taken out, is carried over to the frames between.

A large turn of a flat face moves a point as a small one of a deep face does. Where a short clip, or a long lens, leaves
open how deep the points lie, all turns of the bundle out of the picture's plane are too large or too small by one
factor, which landmarks, fitted by a head of usual depth, tell, unless they are led astray themselves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d
from scipy.spatial.transform import Rotation

from tracker.energy import rotation_matrix, rotation_vector
from tracker.track import F64, Bundle

Rows = NDArray[np.int64]
Corrections = list[tuple[F64, F64]]  # times [k] s and corrections [k, 6] of a stretch of frames

MIN_FRAMES = 8  # fewer do not tell how the two head frames lie to each other
CERTAIN = np.array([[1.0], [1.0], [0.1]])  # of a landmark pose's place: depth is seen ten times less well
LEAST_SEEN = 0.3  # of the points that a frame of the bundle usually sees: with fewer its pose may be anything
# Standard deviations of the logarithm of how far a head is found to turn. By the bundle: a share of its focal length's.
BUNDLE_TURN = 0.4
# By landmarks, and that of their poses (rad), which err in blocks that move with the head, however many there are.
LANDMARK_TURN, LANDMARK_POSE = 0.06, 0.006
# By landmarks led astray, and how likely these are: of a head with hair to the brows they may see two thirds of a turn.
ASTRAY_TURN, ASTRAY = 0.4, 0.2
MOST_TURN = 2.0  # that factor, or its inverse
LEAST_FOCAL_SD = 0.08  # a focal length that is given leaves open how deep the points lie, too
ROUNDS, FAR = 8, 2.0  # of telling which frames are far off, in times of what is usual
FADE_S = 0.48  # beyond the last frame known: the time over which its correction fades


def turned_as_far(bundle: Bundle, x: F64, good: Rows, sound: Rows, focal_sd_log: float) -> Bundle:
    """The bundle whose heads turn as far from their mean pose as it and the poses in x [n, P] tell together.

    good: [n], frames of x. sound: its rows that are believed. focal_sd_log: of the bundle's focal length. Where
    the two differ by more than that allows, landmarks have been led astray. Points and observations stay as they were,
    and so does what is turned in the picture's plane, which does not hang on how deep the points lie.
    """
    known = np.isin(bundle.frame, good[sound]) & _well_seen(bundle)
    if known.sum() < MIN_FRAMES:
        return bundle
    rotation = Rotation.from_rotvec(bundle.rotation)
    own = Rotation.from_matrix(rotation_matrix(x[np.searchsorted(good, bundle.frame[known]), -6:-3]))
    weight = np.ones(int(known.sum()))
    for _ in range(ROUNDS):  # a frame whose patches were led astray tells nothing
        middle = rotation[known].mean(weight)
        turn = (rotation * middle.inv()).as_rotvec()
        seen, told = turn[known, :2], (own * own.mean(weight).inv()).as_rotvec()[:, :2]
        square = max(float(weight @ (seen**2).sum(1)), 1e-9)
        factor = float(np.clip(weight @ (told * seen).sum(1) / square, 1 / MOST_TURN, MOST_TURN))
        away = np.linalg.norm(told - factor * seen, axis=1)
        weight = 1 / (1 + (away / max(FAR * float(np.median(away)), 1e-6)) ** 2)
    certain = LANDMARK_TURN**2 + LANDMARK_POSE**2 * weight.sum() / square
    factor **= _share(np.log(factor), certain, max(focal_sd_log, LEAST_FOCAL_SD))
    turned = Rotation.from_rotvec((factor, factor, 1.0) * turn) * middle
    # The face turns in its place.
    centre = bundle.points.mean(0, dtype=np.float64) if len(bundle.points) else np.zeros(3)
    return replace(
        bundle,
        rotation=turned.as_rotvec().astype(np.float32),
        translation=(bundle.translation + rotation.apply(centre) - turned.apply(centre)).astype(np.float32),
    )


def _share(apart: float, certain: float, focal_sd_log: float) -> float:
    """0..1, how far to go from the bundle's to the landmarks' turns, whose logarithms lie `apart`.

    certain: variance of the landmarks'. The expectation over what these may be: as good as usual, or led astray.
    """
    own = (BUNDLE_TURN * focal_sd_log) ** 2
    whole = own + certain + np.array([0.0, ASTRAY_TURN**2])
    likely = np.array([1 - ASTRAY, ASTRAY]) * np.exp(-0.5 * apart**2 / whole) / np.sqrt(whole)
    return float(own * (likely / whole).sum() / max(float(likely.sum()), 1e-300))


def hold_poses(
    x: F64,
    bundle: Bundle,
    good: Rows,
    run: NDArray[np.int64],
    time: F64,
    sound: Rows,
    middle: F64,
    share: float = 1.0,
) -> F64:
    """The unknowns x [n, P] of the frames good [n] with their poses moved by a share of the way to the bundle's.

    run: [n], frames of one number follow each other without a break; nothing is carried from one to another.
    time: [n] s. sound: rows of x whose poses tell how the two head frames lie to each other, and where the
    difference is known. middle: [3] m, of the rigid upper face in the model's head frame: there the two agree, since
    what the rest of a face does, and a beard on it, tells nothing of where the skull is.
    """
    known = np.isin(bundle.frame, good[sound]) & _well_seen(bundle)
    row = np.searchsorted(good, bundle.frame[known])
    if not share or len(row) < MIN_FRAMES:
        return x
    rotation = Rotation.from_rotvec(bundle.rotation[known]).as_matrix()
    change = _corrections(x[row], rotation, bundle.translation[known].astype(np.float64), middle)
    step = np.diff(time[row])
    ends = np.flatnonzero((step > 1.5 * np.median(step)) | (np.diff(run[row]) != 0)) + 1
    stretches: dict[int, Corrections] = {}
    for part in np.split(np.arange(len(row)), ends):
        # Landmarks drift slowly; what changes from one known frame to the next is noise of either.
        smooth = convolve1d(change[part], [0.25, 0.5, 0.25], axis=0, mode="nearest")
        stretches.setdefault(int(run[row[part[0]]]), []).append((time[row[part]], smooth))
    out = x.copy()
    for number, found in stretches.items():
        mine = np.flatnonzero(run == number)
        moved = share * _between(found, time[mine])
        turned = Rotation.from_rotvec(moved[:, :3]).as_matrix() @ rotation_matrix(x[mine, -6:-3])
        out[mine, -6:-3] = rotation_vector(turned)
        out[mine, -3:] += moved[:, 3:]
    return out


def _well_seen(bundle: Bundle) -> NDArray[np.bool_]:
    """[M] frames of the bundle that see as many of its points as it is usual: a blurred one loses most."""
    seen = np.bincount(np.searchsorted(bundle.frame, bundle.observations[:, 0]), minlength=len(bundle.frame))
    return seen >= LEAST_SEEN * (np.median(seen) if len(seen) else 0.0)


def _corrections(x: F64, rotation: F64, translation: F64, middle: F64) -> F64:
    """[m, 6] turn (axis-angle, rad, camera frame) and shift (m) from the poses in x [m, P] to the bundle's.

    The bundle's head frame is taken to the model's by the similarity under which the two are closest.
    """
    own = rotation_matrix(x[:, -6:-3])
    place = x[:, -3:] + own @ middle
    u, _, vt = np.linalg.svd((own.transpose(0, 2, 1) @ rotation).mean(0))
    target = rotation @ (u @ vt).T
    # The face's middle stands still in the bundle's frame, whose scale is its own: place = rotation c + s translation.
    system = np.concatenate([rotation, translation[..., None]], axis=2)
    told = np.linalg.lstsq((CERTAIN * system).reshape(-1, 4), (CERTAIN[:, 0] * place).reshape(-1), rcond=None)
    moved = system @ told[0] - target @ middle
    turn = Rotation.from_matrix(target @ own.transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([turn, moved - x[:, -3:]], axis=1)


def _between(stretches: Corrections, time: F64) -> F64:
    """[len(time), 6] corrections at all times of one run: linear between those known, none far from all of them."""
    known = np.concatenate([moment for moment, _ in stretches])
    change = np.concatenate([part for _, part in stretches])
    far = [edge for moment, _ in stretches for edge in (moment[0] - FADE_S, moment[-1] + FADE_S)]
    far = [
        edge for edge in far if np.abs(known - edge).min() > 0.999 * FADE_S
    ]  # its own end, rounded, is no nearer
    moments = np.concatenate([known, far])
    values = np.concatenate([change, np.zeros((len(far), 6))])
    order = np.argsort(moments)
    return np.stack([np.interp(time, moments[order], column) for column in values[order].T], axis=1)
