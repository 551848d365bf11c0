"""The feature cache: content decides, broken files are made again, the bound holds, nothing else is touched."""

import os
from pathlib import Path

import numpy as np
import pytest

from model.speech import SpeechEncoder
from personalize import feature_cache
from personalize.feature_cache import cache_folder, cache_key, encode_cached
from tests.personalize.counting_encoder import CountingEncoder

SOUND = np.random.default_rng(0).standard_normal(16_000).astype(np.float32)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PERSONALIZE_CACHE", str(tmp_path))
    return tmp_path / "features"


def test_sound_is_encoded_once_and_comes_back_to_the_bit(cache: Path) -> None:
    encoder: SpeechEncoder = CountingEncoder()
    features, times = encode_cached(encoder, SOUND)
    again, times_again = encode_cached(encoder, SOUND.copy())
    assert isinstance(encoder, CountingEncoder) and encoder.calls == 1
    assert again.tobytes() == features.tobytes() and again.dtype == np.float32
    assert times_again.tobytes() == times.tobytes() and times_again.dtype == np.float64
    assert [path.name for path in cache.iterdir()] == [f"{cache_key(encoder.name, SOUND)}.npz"]


def test_other_sound_and_other_encoders_are_encoded(cache: Path) -> None:
    encoder, other = CountingEncoder(), CountingEncoder("other@1")
    encode_cached(encoder, SOUND)
    encode_cached(other, SOUND)
    assert other.calls == 1
    changed = SOUND.copy()
    changed[500] = np.nextafter(changed[500], 2, dtype=np.float32)
    for sound in (changed, SOUND[:-1], -SOUND):
        encode_cached(encoder, sound)
    assert encoder.calls == 4 and len(list(cache.iterdir())) == 5


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)


def swap(path: Path) -> None:
    np.savez(path, features=np.zeros((50, 3), np.float32), times=np.zeros(50))


@pytest.mark.parametrize(
    "damage", [flip, swap, lambda path: os.truncate(path, 900), lambda path: path.write_bytes(b"")]
)
def test_a_broken_file_is_made_again(cache: Path, damage: object) -> None:
    encoder = CountingEncoder()
    expected, _ = encode_cached(encoder, SOUND)
    (path,) = cache.iterdir()
    assert callable(damage)
    damage(path)
    for calls in (2, 2):
        assert encode_cached(encoder, SOUND)[0].tobytes() == expected.tobytes()
        assert encoder.calls == calls


def test_the_longest_unused_goes_first_and_other_files_stay(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder = CountingEncoder()
    sounds = [SOUND + shift for shift in range(3)]
    paths = [cache / f"{cache_key(encoder.name, sound)}.npz" for sound in sounds]
    for age, (sound, path) in enumerate(zip(sounds[:2], paths)):
        encode_cached(encoder, sound)
        os.utime(path, (1000 + age, 1000 + age))
    foreign = cache / "notes.txt"
    foreign.write_bytes(b"x" * 100_000)
    os.utime(foreign, (1, 1))
    encode_cached(encoder, sounds[0])  # used again: now the second is the oldest
    monkeypatch.setattr(feature_cache, "LIMIT_BYTES", 2 * paths[0].stat().st_size)
    encode_cached(encoder, sounds[2])
    assert [path.exists() for path in paths] == [True, False, True] and foreign.exists()
    monkeypatch.setattr(feature_cache, "LIMIT_BYTES", 100)
    encode_cached(encoder, sounds[1])
    assert not paths[1].exists(), "larger than the whole cache: not kept at all"


def test_a_cache_that_cannot_be_written_is_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("PERSONALIZE_CACHE", str(tmp_path / "file"))
    encoder = CountingEncoder()
    for _ in range(2):
        assert encode_cached(encoder, SOUND)[0].shape == (50, encoder.width)
    assert encoder.calls == 2


def test_where_the_cache_lies(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "PERSONALIZE_CACHE" in os.environ, "tests have a cache of their own"
    monkeypatch.setenv("PERSONALIZE_CACHE", "/a")
    monkeypatch.setenv("XDG_CACHE_HOME", "/b")
    monkeypatch.setenv("HOME", "/c")
    assert cache_folder() == Path("/a/features")
    monkeypatch.delenv("PERSONALIZE_CACHE")
    assert cache_folder() == Path("/b/personalize/features")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path("/c/.cache/personalize/features")
