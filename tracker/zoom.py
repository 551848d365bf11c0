"""Shots whose picture is enlarged: from one cut to the next a face gets larger, and the camera comes no nearer.

Editors show every other shot larger, and a second camera stands where the first one does, with a longer lens. Taken for
a head that comes nearer under one focal length, it would have to be seen in another perspective than it is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracker.head import HeadModel
from tracker.landmark_indices import of_rigid_face
from tracker.lens import never
from tracker.similarity import similarity
from tracker.track import F32, Landmarks

# Of the logarithm of a face's size: by more than this a shot's differs from most. People who lean forward between two
# shots differ by .03 usually, .11 at most (40 shots of two speakers).
ENLARGED = 0.14


def zoom_of_shots(landmarks: Landmarks, segment: NDArray[np.int32], head: HeadModel) -> F32:
    """[T, 3] times that each frame's picture is enlarged, and x, y px of the place that stays; [0, 3] if none is.

    segment: [T], number of the uninterrupted shot. Nothing in a face tells a longer lens from a shorter way, so where
    it is larger or smaller than in most frames it is taken to be as far away as there. What stays is the picture's
    middle, of editors as of lenses, or the face's where a smaller one would come to lie beyond the picture's edge.
    """
    embedding = head.landmark_embedding
    rigid = of_rigid_face(embedding.landmarks)
    seen = landmarks.points[:, embedding.landmarks[rigid]].astype(np.float64)
    known = np.flatnonzero(np.isfinite(seen).all((1, 2)))
    if not len(known):
        return never()
    nothing = np.zeros(len(head.identity_basis)), np.zeros(len(head.expression_basis))
    size = np.log(similarity(head.landmark_positions(*nothing)[rigid].astype(np.float64), seen[known])[0])
    shots, shot = np.unique(segment[known], return_inverse=True)
    larger = np.array([np.median(size[shot == number]) for number in range(len(shots))])
    larger -= np.sort(larger[shot])[len(known) // 2]
    enlarged = np.abs(larger) > ENLARGED
    if not enlarged.any():
        return never()
    zoom = np.zeros((len(segment), 3))
    zoom[:, 0] = 1.0
    end = np.array(landmarks.size) - 1
    for number in np.flatnonzero(enlarged):
        times, faces = np.exp(larger[number]), landmarks.points[known[shot == number]]
        faces = faces[:, embedding.landmarks, :2]
        low, high = faces.min((0, 1)), faces.max((0, 1))
        within = (np.abs(np.stack([low, high]) - end / 2) <= times * end / 2).all()
        zoom[segment == shots[number]] = times, *(end / 2 if within else (low + high) / 2)
    return zoom.astype(np.float32)
