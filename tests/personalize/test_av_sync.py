"""The sound's offset is found where mouth and speech belong together, and not claimed where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from personalize.av_sync import estimate_av_offset
from personalize.sound import SPEECH_RATE
from tracker.track import F32, F64

SECONDS = 20.0


def speech(seed: int = 0) -> tuple[F64, F64, F32]:
    """Times [T] at 25 fps, opening [T] and sound of syllables whose loudness follows the opening, in sync."""
    rng = np.random.default_rng(seed)
    fine = np.arange(round(SECONDS * SPEECH_RATE)) / SPEECH_RATE
    opening = np.zeros(len(fine))
    at = 0.3
    while at < SECONDS - 0.3:
        opening += rng.uniform(3, 9) * np.exp(-0.5 * ((fine - at) / rng.uniform(0.035, 0.06)) ** 2)
        at += rng.uniform(0.14, 0.4)
    times = np.arange(0, SECONDS, 0.04)
    sound = opening / 10 * rng.normal(size=len(fine)) + 1e-3 * rng.normal(size=len(fine))
    measured = np.interp(times, fine, opening) + 0.3 * rng.normal(size=len(times))
    return times, measured, sound.astype(np.float32)


@pytest.mark.parametrize("late", [-0.6, -0.2, 0.12, 0.5, 0.8])
def test_a_shift_is_found_and_sure(late: float) -> None:
    times, opening, sound = speech()
    found = estimate_av_offset(times, opening, np.ones(len(times), bool), sound, late)
    assert found.sure and found.offset_s == pytest.approx(late, abs=0.03)


def test_sync_is_not_corrected() -> None:
    times, opening, sound = speech()
    found = estimate_av_offset(times, opening, np.ones(len(times), bool), sound, 0.0)
    assert not found.sure and abs(found.offset_s) < 0.03


def test_gaps_in_what_is_usable_do_not_matter() -> None:
    times, opening, sound = speech()
    usable = (times % 5) > 1.0
    opening[~usable] = np.nan
    found = estimate_av_offset(times, opening, usable, sound, 0.3)
    assert found.offset_s == pytest.approx(0.3, abs=0.03)


def test_sound_that_does_not_belong_is_never_sure() -> None:
    times, opening, sound = speech()
    usable = np.ones(len(times), bool)
    for seed in range(1, 9):
        assert not estimate_av_offset(times, opening, usable, speech(seed)[2], 0.0).sure
    assert not estimate_av_offset(times, opening, usable, sound[::-1].copy(), 0.0).sure


def test_silence_and_no_face_give_no_estimate() -> None:
    times, opening, sound = speech()
    usable = np.ones(len(times), bool)
    for found in (
        estimate_av_offset(times, opening, usable, np.zeros_like(sound), 0.0),
        estimate_av_offset(times, opening, ~usable, sound, 0.0),
        estimate_av_offset(times, opening, usable, sound[:0], 0.0),
    ):
        assert found.offset_s == 0 and not found.sure
