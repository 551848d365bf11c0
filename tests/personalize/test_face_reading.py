"""What is read of a face in one pass: each part is tested on its own; here, how they hang together."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from personalize import face_reading
from personalize.face_reading import read_face
from personalize.shots import Frames
from tracker.landmark_bias import landmark_bias
from tracker.landmark_indices import POINTS
from tracker.track import Landmarks

FRAMES = 6


def test_watchers_see_what_is_read_and_the_landmarks_are_rid_of_what_they_err_by(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    random = np.random.default_rng(1)
    points = np.zeros((FRAMES, POINTS, 3), np.float32)
    learned = landmark_bias()
    points[:, learned.landmarks] = 2000 * learned.mean * [1, -1, -1] + random.normal(size=(FRAMES, 1, 3))
    points += random.normal(size=points.shape).astype(np.float32)
    read = Landmarks(
        time=np.arange(FRAMES) / 25,
        points=points,
        presence=np.ones(FRAMES, np.float32),
        blendshapes=np.zeros((FRAMES, 52), np.float32),
        blendshape_names=(),
        size=(640, 480),
    )
    tracked = Mock(return_value=read)
    usable = np.array([True, False, True, True, False, True])
    monkeypatch.setattr(face_reading, "FrameReader", Mock())
    watch, follower = Mock(), Mock()
    for name, fake in (("track_landmarks", tracked), ("FaceWatch", watch), ("FeatureFollower", follower)):
        monkeypatch.setattr(face_reading, name, fake)
    frames = Mock(spec=Frames, time=read.time, usable=usable, segment=np.array([0, 0, 0, 1, 1, 1]), box=None)
    landmarks, _, _ = read_face(Path("film.mp4"), frames)
    np.testing.assert_array_equal(landmarks.points, learned.taken_out(points, usable))
    assert np.abs(landmarks.points - points).max() > 0.1
    called = tracked.call_args.kwargs
    assert called["cuts"] == {3}
    assert called["watchers"] == (watch.return_value, follower.return_value)
