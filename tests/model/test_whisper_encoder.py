"""The embedded speech encoder: log-mel, level, length and seams."""

import numpy as np
import pytest
import torch

from model import whisper_encoder
from model.speech_windows import SAMPLE_RATE, SpeechError, window_starts
from model.whisper_encoder import embedded_encoder


@pytest.fixture(scope="module")
def voice() -> np.ndarray:
    """40 s of a made-up voice: a gliding buzz with changing formants, syllables and pauses, [S] f32."""
    random = np.random.default_rng(0)
    time = np.arange(40 * SAMPLE_RATE) / SAMPLE_RATE
    pitch = 120 + 30 * np.sin(2 * np.pi * 0.4 * time)
    phase = 2 * np.pi * np.cumsum(pitch) / SAMPLE_RATE
    gains = np.repeat(random.random((10, 200)), len(time) // 200, axis=1)
    sound = sum(gain * np.sin((k + 1) * phase) / (k + 1) for k, gain in enumerate(gains))
    return (0.2 * sound * (np.sin(2 * np.pi * 3 * time) > -0.5)).astype(np.float32)


def test_shape_times_and_name(voice: np.ndarray) -> None:
    encoder = embedded_encoder()
    features, times = encoder.encode(voice[: 3 * SAMPLE_RATE])
    assert features.shape == (150, encoder.width) and features.dtype == np.float32
    np.testing.assert_allclose(times, 0.02 * np.arange(150))
    assert len(encoder.name.split("@")[1]) == 64


def test_level_changes_nothing(voice: np.ndarray) -> None:
    encoder = embedded_encoder()
    clip = voice[: 2 * SAMPLE_RATE]
    np.testing.assert_allclose(encoder.encode(0.05 * clip)[0], encoder.encode(clip)[0], atol=1e-3)


def test_a_row_is_centred_at_its_time() -> None:
    """A click at 1.00 s changes rows around row 50, symmetrically."""
    sound = np.zeros(2 * SAMPLE_RATE, np.float32)
    sound[SAMPLE_RATE] = 1.0
    mel = whisper_encoder.log_mel(torch.from_numpy(sound))
    loud = np.flatnonzero((mel.mean(0) > mel.mean(0).min() + 0.1).numpy())
    assert loud.mean() == 100.0


def test_the_spectrum_of_a_long_sound_is_made_in_parts_that_leave_no_seam(
    voice: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = torch.from_numpy(voice[: 3 * SAMPLE_RATE + 77])
    whole = whisper_encoder.log_mel(sound)
    monkeypatch.setattr(whisper_encoder, "TOGETHER", 7)
    torch.testing.assert_close(whisper_encoder.log_mel(sound), whole, atol=1e-5, rtol=0)


def test_windows_leave_no_seam(voice: np.ndarray) -> None:
    """Where windows begin and end, features move no more than elsewhere."""
    features, _ = embedded_encoder().encode(voice)
    step = np.linalg.norm(np.diff(features, axis=0), axis=1)
    starts = window_starts(len(features))
    assert starts == [0, 500]
    for seam in (500, 1500):
        assert step[seam - 5 : seam + 5].max() <= np.quantile(step, 0.995)


def test_very_short_and_silent_sound_encode() -> None:
    encoder = embedded_encoder()
    assert np.isfinite(encoder.encode(np.zeros(10, np.float32))[0]).all()
    assert np.isfinite(encoder.encode(np.zeros(16000, np.float32))[0]).all()


@pytest.mark.parametrize("sound", [np.zeros(0, np.float32), np.full(9, np.nan, np.float32), np.zeros((2, 9))])
def test_unusable_sound_is_refused(sound: np.ndarray) -> None:
    with pytest.raises(SpeechError, match="one channel of finite samples"):
        embedded_encoder().encode(sound)


def test_mel_filters_have_unit_area() -> None:
    """Slaney's normalization: every wide filter integrates to 1 over frequency."""
    area = whisper_encoder.mel_filters().sum(1) * (SAMPLE_RATE / whisper_encoder.N_FFT)
    np.testing.assert_allclose(area[40:].numpy(), 1.0, atol=0.1)
