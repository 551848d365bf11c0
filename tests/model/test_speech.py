"""Speech features behind one interface: which encoder a source means, and features at other times."""

import sys
from pathlib import Path

import numpy as np
import pytest

from model.errors import ModelError
from model.speech import load_encoder, resample


def test_no_source_is_the_embedded_encoder() -> None:
    encoder = load_encoder()
    assert encoder is load_encoder(None)
    assert (encoder.width, encoder.rate) == (384, 50.0)
    assert encoder.name.startswith("whisper-tiny.en-block3@")


def test_without_transformers_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ModelError, match=r"pip install -c constraints.txt -e '\.\[encoders\]'") as caught:
        load_encoder(tmp_path)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_resample_is_linear_and_holds_the_ends() -> None:
    times = np.arange(5) * 0.02
    features = np.stack([times, 1 - 2 * times], axis=1).astype(np.float32)
    at = np.array([-1.0, 0.0, 0.013, 0.05, 0.08, 9.0])
    held = np.clip(at, 0.0, 0.08)
    expected = np.stack([held, 1 - 2 * held], axis=1)
    np.testing.assert_allclose(resample(features, times, at), expected, atol=1e-6)
