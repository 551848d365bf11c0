"""The camera of a clip without cuts."""

from __future__ import annotations

from typing import Any

import numpy as np

from tracker import camera
from tracker.feature_tracks import FeatureTracks
from tracker.head import HeadModel
from tracker.track import Bundle, Camera, Landmarks


def estimate_camera(
    landmarks: Landmarks, features: FeatureTracks, head: HeadModel, **given: Any
) -> tuple[Camera, Bundle]:
    everywhere, one_shot = np.ones(len(landmarks.time), bool), np.zeros(len(landmarks.time), np.int32)
    return camera.estimate_camera(landmarks, features, head, everywhere, one_shot, **given)
