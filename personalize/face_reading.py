"""One pass over a video's pictures: the landmarks of the face, and what else is learned of it meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from personalize.pictures import FrameReader
from personalize.shots import Frames
from tracker.feature_tracks import FeatureFollower, FeatureTracks
from tracker.landmark_bias import landmark_bias
from tracker.landmarker import track_landmarks
from tracker.occlusion import Appearance, FaceWatch
from tracker.track import Landmarks


def read_face(
    video: Path, frames: Frames, progress: Callable[[int, int], None] | None = None
) -> tuple[Landmarks, Appearance, FeatureTracks]:
    """Landmarks of the main person in all frames, how the face looks in each, and patches of the rigid upper face."""
    watch, follower = FaceWatch(), FeatureFollower(frames.time, frames.usable, frames.segment, frames.box)
    landmarks = track_landmarks(
        FrameReader(video),
        len(frames.time),
        cuts=set(np.flatnonzero(np.diff(frames.segment)) + 1),
        boxes=frames.box,
        progress=progress,
        watchers=(watch, follower),
    )
    landmarks = replace(landmarks, points=landmark_bias().taken_out(landmarks.points, frames.usable))
    return landmarks, watch.appearance(frames.usable), follower.tracks()
