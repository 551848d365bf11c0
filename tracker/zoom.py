"""Shots whose picture is enlarged: a face gets larger at once, and the camera comes no nearer.

Editors show every other shot larger, or let it grow in a third of a second, and a second camera stands where the first
one does, with a longer lens. Taken for a head that comes nearer under one focal length, it would have to be seen in
another perspective than it is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracker.feature_tracks import turned_as_usual
from tracker.head import HeadModel
from tracker.landmark_indices import of_rigid_face
from tracker.lens import never
from tracker.similarity import similarity
from tracker.track import F32, F64, Landmarks

# Of the logarithm of a face's size: by more than this a shot's differs from most. People who lean forward between two
# shots differ by .03 usually, .11 at most (40 shots of two speakers); in QUICK_S by .08 (116 films, four people).
ENLARGED, QUICK_S = 0.14, 0.5


def zoom_of_frames(
    landmarks: Landmarks, seen: NDArray[np.bool_], segment: NDArray[np.int32], head: HeadModel
) -> F32:
    """[T, 3] times that each frame's picture is enlarged, and x, y px of the place that stays; [0, 3] if none is.

    seen: [T], frames that show the person, usable or not. segment: [T], number of the uninterrupted shot. Nothing in a
    face tells a longer lens from a shorter way, so where it is larger or smaller than in most frames it is taken to be
    as far away as there. What stays is the picture's middle, of editors as of lenses, or the face's where a smaller one
    would come to lie beyond the picture's edge.
    """
    size = _sizes(landmarks, seen, head)
    known = np.flatnonzero(np.isfinite(size))
    if not len(known):
        return never()
    quick = _quickly(size, landmarks.time, segment)
    # Stretches of one size, and frames in which it changes.
    stretch = np.cumsum(np.diff(segment, prepend=segment[0]).astype(bool) | quick | np.roll(quick, 1))
    stretches, number = np.unique(stretch[known], return_inverse=True)
    larger = np.array([np.median(size[known[number == n]]) for n in range(len(stretches))])
    larger -= np.sort(larger[number])[len(known) // 2]
    enlarged = np.abs(larger) > ENLARGED
    enlarged[number[quick[known]]] = True
    zoom = np.zeros((len(segment), 3))
    zoom[:, 0] = 1.0
    for n in np.flatnonzero(enlarged):
        faces = landmarks.points[known[number == n]][:, head.landmark_embedding.landmarks, :2]
        zoom[stretch == stretches[n]] = _about(np.exp(larger[n]), faces, landmarks.size)
    return zoom.astype(np.float32) if enlarged.any() else never()


def _sizes(landmarks: Landmarks, seen: NDArray[np.bool_], head: HeadModel) -> F64:
    """[T] logarithms of px per metre of the person's upper face; NaN unseen, or turned far aside."""
    embedding = head.landmark_embedding
    rigid = of_rigid_face(embedding.landmarks)
    nothing = np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_basis))
    mean = head.landmark_positions(*nothing)[rigid].astype(np.float64)
    size = np.full(len(landmarks.time), np.nan)
    known = np.flatnonzero(seen & np.isfinite(landmarks.points).all((1, 2)))
    if len(known):
        known = known[turned_as_usual(landmarks.points[known])]
        points = landmarks.points[known][:, embedding.landmarks[rigid]].astype(np.float64)
        size[known] = np.log(similarity(mean, points)[0])
    return size


def _quickly(size: F64, time: F64, segment: NDArray[np.int32]) -> NDArray[np.bool_]:
    """[T] frames about which the size changes too quickly for somebody who moves."""
    first, last = np.searchsorted(segment, segment), np.searchsorted(segment, segment, "right") - 1
    before = np.maximum(np.searchsorted(time, time - QUICK_S / 2), first)
    after = np.minimum(np.searchsorted(time, time + QUICK_S / 2, "right") - 1, last)
    return np.isfinite(size) & (np.abs(size[after] - size[before]) > ENLARGED)


def _about(times: float, faces: F32, size: tuple[int, int]) -> tuple[float, float, float]:
    """The zoom of a stretch that shows faces [n, L, 2] px so many times larger."""
    middle = (np.array(size) - 1) / 2
    low, high = faces.min((0, 1)), faces.max((0, 1))
    within = (np.abs(np.stack([low, high]) - middle) <= times * middle).all()
    x, y = middle if within else (low + high) / 2
    return times, float(x), float(y)
