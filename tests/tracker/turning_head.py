"""A head that turns a little and opens its mouth, as a track, its landmarks, and pictures of it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tracker.head import HeadModel
from tracker.raster import render
from tracker.scene import place
from tracker.track import Landmarks, Track

SIZE, FOCAL = (360, 300), 700.0


def turning_track(head: HeadModel, frames: int) -> Track:
    turn = Rotation.from_euler("y", np.linspace(-12, 12, frames)[:, None], degrees=True)
    expression = np.zeros((frames, len(head.expression_names)), np.float32)
    expression[:, head.expression_names.index("jawOpen")] = np.linspace(0, 0.4, frames)
    still = np.zeros((frames, 3), np.float32)
    facing = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    return Track(
        time=np.arange(frames) / 25,
        valid=np.ones(frames, bool),
        confidence=np.ones(frames, np.float32),
        identity=np.zeros(len(head.identity_basis), np.float32),
        expression=expression,
        jaw=still,
        neck=still,
        eyes=np.zeros((frames, 2, 3), np.float32),
        rotation=(turn * facing).as_rotvec().astype(np.float32),
        translation=np.tile(np.array([0, 0, 0.75], np.float32), (frames, 1)),
        focal=FOCAL,
        principal=np.array([179.5, 149.5], np.float32),
        distortion=np.zeros(0, np.float32),
        size=SIZE,
        head=head.name,
        lip_gap_mm=np.zeros(frames, np.float32),
        reprojection_px=np.zeros(frames, np.float32),
    )


def shifted_landmarks(track: Track, head: HeadModel, shift_px: float) -> Landmarks:
    """Detected points to the right of the fitted ones."""
    frames = len(track.time)
    points = np.full((frames, 478, 3), np.nan, np.float32)
    for frame in range(frames):
        at = place(track, frame, head)[1]
        flat = FOCAL * at[:, :2] / at[:, 2:] + track.principal + (shift_px, 0)
        points[frame, head.landmark_embedding.landmarks, :2] = flat
    return Landmarks(track.time, points, track.confidence, np.zeros((frames, 52), np.float32), (), SIZE)


def picture(track: Track, head: HeadModel, frame: int) -> np.ndarray:
    vertices, _ = place(track, frame, head)
    x, y = track.principal.tolist()
    return render(vertices, head.faces, head.albedo, FOCAL, (x, y), SIZE)


def first_hits(rays: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[n] m, how far from the camera unit rays [n, 3] first meet a mesh (Moeller and Trumbore); inf if they do not."""
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    along, out = np.cross(-a, b - a), np.full(len(rays), np.inf)
    for n, ray in enumerate(rays.astype(np.float64)):
        across = np.cross(ray, c - a)
        size = (across * (b - a)).sum(1)
        size = np.where(np.abs(size) < 1e-14, np.nan, size)
        u, v, far = -(across * a).sum(1) / size, along @ ray / size, (along * (c - a)).sum(1) / size
        hit = (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1 + 1e-6) & (far > 0)
        out[n] = far[hit].min(initial=np.inf)
    return out
