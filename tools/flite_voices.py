"""Synthetic speech with phone times from flite (build time only), varied so that no two talkers sound alike."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve, resample_poly

from personalize.sound import SPEECH_RATE, read_audio
from personalize.talkers.visemes import SILENCE, VISEMES, Phone

F32 = NDArray[np.float32]
VOICES = ("rms", "slt", "awb", "kal16")
STEPS = 100  # of the resampling ratio


@dataclass(frozen=True)
class Speech:
    """Sound [S] f32 at 16 kHz and its phones."""

    audio: F32
    phones: list[Phone]


def speak(sentence: str, voice: str, stretch: float) -> Speech:
    """One sentence by flite; `stretch` > 1 speaks more slowly. Needs the program `flite` (Debian: flite)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "speech.wav"
        command = ["flite", "-voice", voice, "-psdur", "--setf", f"duration_stretch={stretch:.3f}"]
        result = subprocess.run(
            [*command, "-o", str(path), "-t", sentence], check=True, capture_output=True, text=True
        )
        audio, _ = read_audio(path)
    phones, start = [], 0.0
    for word in result.stdout.split():
        name, end = word.split(":")
        name = SILENCE if name == "pau" else name.upper()
        assert name in VISEMES, name
        phones.append(Phone(name, start, float(end)))
        start = float(end)
    return Speech(audio, phones)


def monologue(sentences: Sequence[str], voice: str, seed: int) -> Speech:
    """Sentences with pauses, by one speaker: tempo, pitch and size of the throat are drawn from `seed`."""
    random = np.random.default_rng(seed)
    stretch, size = random.uniform(0.85, 1.25), random.uniform(0.86, 1.18)
    # Played faster by `size`, a voice is higher and its throat shorter; the stretch keeps the tempo its own.
    up, down = STEPS, round(STEPS * size)
    sounds: list[F32] = []
    phones: list[Phone] = []
    now = 0.0

    def pause(length: float) -> None:
        nonlocal now
        sounds.append(np.zeros(round(length * SPEECH_RATE), np.float32))
        phones.append(Phone(SILENCE, now, now + len(sounds[-1]) / SPEECH_RATE))
        now = phones[-1].end

    pause(random.uniform(0.3, 1.0))
    for sentence in sentences:
        speech = speak(sentence, voice, stretch * size * random.uniform(0.93, 1.07))
        audio = resample_poly(speech.audio, up, down).astype(np.float32)
        scale = up / down
        phones += [Phone(p.name, now + p.start * scale, now + p.end * scale) for p in speech.phones]
        sounds.append(audio / max(float(np.abs(audio).max()), 1e-6) * random.uniform(0.5, 1.0))
        now += len(audio) / SPEECH_RATE
        pause(random.uniform(0.1, 0.9))
    return Speech(np.concatenate(sounds), phones)


def record(audio: F32, seed: int) -> F32:
    """The same speech through another room, microphone and noise floor, drawn from `seed`."""
    random = np.random.default_rng(seed)
    length = round(random.uniform(0.05, 0.4) * SPEECH_RATE)
    tail = random.standard_normal(length) * np.exp(-6.0 * np.arange(length) / length)
    tail *= random.uniform(0.0, 0.4) / np.linalg.norm(tail)
    tail[0] += 1.0
    heard = fftconvolve(audio, tail)[: len(audio)]
    # A tilt and a few broad bumps of the spectrum.
    knots = np.cumsum(random.normal(0, 3.0, 9))
    bins = np.fft.rfftfreq(len(heard))
    gain_db = np.interp(bins, np.linspace(0, 0.5, 9), knots - knots.mean())
    heard = np.fft.irfft(np.fft.rfft(heard) * 10 ** (gain_db / 20), len(heard))
    hiss = np.fft.rfft(random.standard_normal(len(heard))) / np.maximum(bins, 1e-3) ** random.uniform(0, 0.5)
    noise = np.fft.irfft(hiss, len(heard))
    noise *= heard.std() / noise.std() * 10 ** (-random.uniform(15, 45) / 20)
    return (heard + noise).astype(np.float32)
