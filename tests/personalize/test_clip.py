"""The film of the report: the video, the tracked motion and a sample side by side, in step with the sound."""

from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from model.checkpoint import Checkpoint
from model.motion import Motion
from personalize.evaluation import clip
from personalize.sound import FILM_RATE
from personalize.subject_data import BASE_CHECKPOINT

FRAMES, FIRST_S, CLICK_S = 15, 0.5, 0.9


@pytest.mark.parametrize(("late_s", "of"), [(0.2, "the video's"), (0.2, "another's"), (0.0, "the video's")])
def test_the_sound_lies_where_registration_found_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late_s: float, of: str
) -> None:
    base = Checkpoint.load(BASE_CHECKPOINT)
    still = np.zeros((FRAMES, len(base.basis)), np.float32)
    told = {"av_offset_s": late_s, "av_offset_of": [of]}
    motion = Motion(30.0, 0.0, base.template, base.faces, base.basis, still, np.ones(FRAMES, bool), told)
    click = np.zeros(2 * FILM_RATE, np.float32)
    click[round(CLICK_S * FILM_RATE)] = 1.0
    film, run = MagicMock(), SimpleNamespace(video=tmp_path / "talk.mp4", video_sha256="the video's")
    monkeypatch.setattr(clip, "VideoWriter", film)
    monkeypatch.setattr(clip, "read_audio", lambda path, rate: (click, 0.0))
    width, height = clip.PANEL
    pictures = [np.zeros((height, width, 3), np.uint8)] * FRAMES
    monkeypatch.setattr(clip, "_face_pictures", lambda run, time: pictures)
    time = FIRST_S + np.arange(FRAMES) / 30
    clip.write_clip(run, tmp_path / "test.mp4", motion, base, time, still, still)
    heard = film.call_args.args[3]
    applied = late_s if of == "the video's" else 0.0
    assert np.argmax(heard) / FILM_RATE == pytest.approx(CLICK_S - FIRST_S - applied, abs=1e-3)
    assert film.return_value.__enter__.return_value.write.call_count == FRAMES
