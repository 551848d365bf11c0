"""Encoders that a user gives, on small random models: rows, times, windows, and what is refused."""

import dataclasses
import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from model.errors import ModelError
from model.speech import load_encoder
from model.speech_windows import SAMPLE_RATE, SpeechError
from model.transformers_encoder import Framing, TransformersEncoder, find_folder, user_encoder
from model.whisper_encoder import embedded_encoder

transformers = pytest.importorskip("transformers", reason="needs pip install -e '.[encoders]'")

WIDTH, LAYERS = 32, 3
MODELS = ("wav2vec2", "wav2vec2-stable", "hubert", "wavlm", "whisper")
WAVEFORM = MODELS[:-1]


def waveform_model(name: str) -> tuple[Any, Any]:
    family = {"wav2vec2": "Wav2Vec2", "hubert": "Hubert", "wavlm": "WavLM"}[name.split("-")[0]]
    config = getattr(transformers, f"{family}Config")(
        hidden_size=WIDTH,
        num_hidden_layers=LAYERS,
        num_attention_heads=2,
        intermediate_size=48,
        conv_dim=(16,) * 7,
        num_conv_pos_embeddings=16,
        num_conv_pos_embedding_groups=4,
        # The large models: norms before the blocks and one behind the last, no norm over time.
        **({"do_stable_layer_norm": True, "feat_extract_norm": "layer"} if name.endswith("-stable") else {}),
    )
    return getattr(transformers, f"{family}Model")(config), transformers.Wav2Vec2FeatureExtractor()


def whisper_model(width: int = WIDTH, layers: int = LAYERS, heads: int = 2) -> tuple[Any, Any]:
    config = transformers.WhisperConfig(
        vocab_size=60,
        **dict(zip(("pad_token_id", "bos_token_id", "eos_token_id", "decoder_start_token_id"), range(4))),
        d_model=width,
        encoder_layers=layers,
        encoder_attention_heads=heads,
        encoder_ffn_dim=4 * width,
        decoder_layers=1,
        decoder_attention_heads=heads,
        decoder_ffn_dim=width,
    )
    return transformers.WhisperModel(config), transformers.WhisperFeatureExtractor()


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a folder per model."""
    root = tmp_path_factory.mktemp("models")
    for name in MODELS:
        torch.manual_seed(0)
        for part in whisper_model() if name == "whisper" else waveform_model(name):
            part.save_pretrained(root / name)
    return root


@pytest.fixture
def damaged(models: Path, tmp_path: Path) -> Path:
    """A copy of the first model, to be damaged."""
    shutil.copytree(models / "wav2vec2", tmp_path / "model")
    return tmp_path / "model"


def noise(seconds: float, seed: int = 0) -> np.ndarray:
    sound = np.random.default_rng(seed).standard_normal(round(seconds * SAMPLE_RATE)).astype(np.float32)
    return sound / np.abs(sound).max()


def user(source: str | Path) -> TransformersEncoder:
    encoder = load_encoder(source)
    assert isinstance(encoder, TransformersEncoder)
    return encoder


@pytest.mark.parametrize("name", MODELS)
def test_rows_width_and_name(models: Path, name: str) -> None:
    encoder = user(models / name)
    features, times = encoder.encode(noise(3.0))
    assert (encoder.width, encoder.rate) == (WIDTH, 50.0)
    assert features.shape == (150, WIDTH) and features.dtype == np.float32 and np.isfinite(features).all()
    np.testing.assert_allclose(np.diff(times), 0.02)
    family, digest = encoder.name.split("@")
    assert family == f"{name.split('-')[0]}#layer={LAYERS}" and len(digest) == 64


@pytest.mark.parametrize("layer", [1, 2, LAYERS])
@pytest.mark.parametrize("name", MODELS)
def test_it_is_the_model_as_everybody_uses_it(models: Path, name: str, layer: int) -> None:
    """Against processor and whole model of transformers, on sound that rows cover without a rest."""
    sound = noise(2.0 if name == "whisper" else 2.005)
    batch = transformers.AutoFeatureExtractor.from_pretrained(models / name)(
        sound, sampling_rate=SAMPLE_RATE, return_tensors="pt"
    )
    model = transformers.AutoModel.from_pretrained(models / name).eval()
    with torch.inference_mode():
        model = model.get_encoder() if name == "whisper" else model
        output = model(next(iter(batch.values())), output_hidden_states=True)
    expected = output.last_hidden_state if layer == LAYERS else output.hidden_states[layer]
    features, _ = user(f"{models / name}#layer={layer}").encode(sound)
    np.testing.assert_allclose(features, expected[0, : len(features)].numpy(), atol=2e-5)


@pytest.mark.parametrize("convolutions", [None, ((10, 4, 3), (5, 3, 2)), ((8, 2), (4, 2))])
@pytest.mark.parametrize("name", ["wav2vec2", "hubert", "wavlm"])
def test_times_are_the_centres_of_what_the_convolutions_hear(name: str, convolutions: Any) -> None:
    """Row k changes with the samples of its field and with no others: found by the gradient."""
    model, _ = waveform_model(name)
    config = model.config
    if convolutions:
        config.conv_kernel, config.conv_stride = convolutions
        config.conv_dim = (16,) * len(convolutions[0])
        config.num_feat_extract_layers = len(convolutions[0])
    config.feat_extract_norm = "layer"  # a norm over time would hear everything
    convolve = type(model)(config).double().eval().feature_extractor
    framing, row = Framing.of(config), 4
    sound = torch.randn(1, framing.samples(12), dtype=torch.float64, requires_grad=True)
    heard = convolve(sound)
    assert heard.shape[-1] == 12
    heard[0, :, row].sum().backward()
    assert sound.grad is not None
    support = sound.grad[0].nonzero()[:, 0]
    assert support[0] == row * framing.hop and support[-1] == row * framing.hop + framing.field - 1
    assert framing.centre + row * framing.hop == support.double().mean()


@pytest.mark.parametrize("name", MODELS)
def test_a_click_moves_the_row_of_its_time_most(models: Path, name: str) -> None:
    encoder = user(f"{models / name}#layer=1")
    sound = 0.3 * noise(2.0)
    sound[0] = 1.0  # the peak stays where it is
    quiet, times = encoder.encode(sound)
    sound[round(times[60] * SAMPLE_RATE)] = 1.0
    change = np.linalg.norm(encoder.encode(sound)[0] - quiet, axis=1)
    assert change.argmax() == 60


@pytest.mark.parametrize("name", WAVEFORM)
def test_windows_are_the_whole(models: Path, name: str) -> None:
    """40 s in four windows against one; attention sees other context, and the base models' first norm other times."""
    encoder = user(models / name)
    sound = noise(40.0) * np.repeat(0.2 + np.random.default_rng(1).random(400), 1600).astype(np.float32)
    features, _ = encoder.encode(sound)
    framing = dataclasses.replace(encoder.framing, window=10_000)
    whole, _ = dataclasses.replace(encoder, framing=framing).encode(sound)
    error = np.linalg.norm(features - whole, axis=1) / np.linalg.norm(whole, axis=1)
    mean, largest = (0.001, 0.01) if name == "wav2vec2-stable" else (0.05, 0.25)
    assert error.mean() < mean and error.max() < largest


@pytest.mark.parametrize("name", ["wav2vec2", "whisper"])
def test_long_sound_goes_through_the_model_in_bounded_pieces(
    models: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pieces: list[int] = []
    hidden = TransformersEncoder._hidden

    def spy(self: TransformersEncoder, columns: torch.Tensor) -> torch.Tensor:
        pieces.append(columns.shape[-1])
        return hidden(self, columns)

    monkeypatch.setattr(TransformersEncoder, "_hidden", spy)
    features, times = user(models / name).encode(noise(95.0))
    assert features.shape == (4750, WIDTH) and times[-1] == pytest.approx(95.0, abs=0.03)
    assert max(pieces) <= (3000 if name == "whisper" else 749 * 320 + 400) and len(pieces) <= 10


@pytest.mark.parametrize("name", MODELS)
def test_level_changes_nothing(models: Path, name: str) -> None:
    encoder = user(models / name)
    sound = noise(1.0)
    np.testing.assert_allclose(encoder.encode(0.05 * sound)[0], encoder.encode(sound)[0], atol=1e-3)


@pytest.mark.parametrize("name", MODELS)
def test_short_and_silent_sound_encode_and_unusable_sound_is_refused(models: Path, name: str) -> None:
    encoder = user(models / name)
    assert encoder.encode(noise(1.0)[:10])[0].shape == (1, WIDTH)
    assert np.isfinite(encoder.encode(np.zeros(8000, np.float32))[0]).all()
    for sound in (np.zeros(0, np.float32), np.full(900, np.nan, np.float32), np.zeros((2, 900), np.float32)):
        with pytest.raises(SpeechError, match="one channel of finite samples"):
            encoder.encode(sound)


def test_the_embedded_weights_in_transformers_whisper_give_the_embedded_features(tmp_path: Path) -> None:
    """Two programs, one encoder: 30 s is one window for both, without other edges."""
    embedded = embedded_encoder()
    model, processor = whisper_model(embedded.width, 4, 6)
    state = {}
    for name, value in embedded.tensors.items():
        if not name.startswith("blocks."):
            state[name] = value
            continue
        _, block, part, kind = name.split(".")
        layer = f"layers.{block}."
        if part == "qkv":
            for letter, third in zip("qkv", value.chunk(3)):
                state[f"{layer}self_attn.{letter}_proj.{kind}"] = third
            if kind == "bias":
                assert not state.pop(f"{layer}self_attn.k_proj.bias").any()
            continue
        places = {"attention_norm": "self_attn_layer_norm", "out": "self_attn.out_proj"}
        places |= {"mlp_norm": "final_layer_norm", "up": "fc1", "down": "fc2"}
        state[f"{layer}{places[part]}.{kind}"] = value
    left = model.encoder.load_state_dict(state, strict=False)
    assert not left.unexpected_keys
    assert all(key.startswith(("embed_positions", "layers.3", "layer_norm")) for key in left.missing_keys)
    model.save_pretrained(tmp_path)
    processor.save_pretrained(tmp_path)
    sound = noise(30.0) * np.repeat(np.random.default_rng(2).random(300), 1600).astype(np.float32)
    features, times = load_encoder(f"{tmp_path}#layer=3").encode(sound)
    expected, expected_times = embedded.encode(sound)
    np.testing.assert_allclose(times, expected_times)
    assert np.linalg.norm(features - expected) / np.linalg.norm(expected) < 1e-5


def test_the_name_is_bound_to_the_weights(models: Path, damaged: Path) -> None:
    before = user(damaged).name
    assert before == user(models / "wav2vec2").name
    state = load_file(damaged / "model.safetensors")
    state["feature_projection.projection.bias"][0] += 1
    save_file(state, damaged / "model.safetensors", metadata={"format": "pt"})
    user_encoder.cache_clear()
    assert user(damaged).name != before


def test_torch_files_are_read_without_unpickling(models: Path, damaged: Path) -> None:
    state = load_file(damaged / "model.safetensors")
    (damaged / "model.safetensors").unlink()
    torch.save(state, damaged / "pytorch_model.bin")
    sound = noise(1.0)
    expected = user(models / "wav2vec2").encode(sound)[0]
    np.testing.assert_array_equal(user(damaged).encode(sound)[0], expected)

    class Malice:
        def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
            return os.mkdir, (str(damaged / "executed"),)

    for content in (pickle.dumps(state | {"x": Malice()}), None):
        if content is None:
            torch.save(state | {"x": Malice()}, damaged / "pytorch_model.bin")
        else:
            (damaged / "pytorch_model.bin").write_bytes(content)
        user_encoder.cache_clear()
        with pytest.raises(ModelError, match="transformers can read"):
            user(damaged).encode(sound)
    assert not (damaged / "executed").exists()


def rewrite(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def drop_a_tensor(folder: Path) -> None:
    state = load_file(folder / "model.safetensors")
    del state["encoder.layers.1.attention.out_proj.weight"]
    save_file(state, folder / "model.safetensors", metadata={"format": "pt"})


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda folder: (folder / "config.json").unlink(), "transformers can read"),
        (lambda folder: (folder / "preprocessor_config.json").unlink(), r"no preprocessor_config\.json"),
        (lambda folder: (folder / "model.safetensors").unlink(), r"no weights there \(model\.safetensors"),
        (lambda folder: os.truncate(folder / "model.safetensors", 5000), "transformers can read"),
        (drop_a_tensor, r"lack 1 tensors, e\.g\. encoder\.layers\.1\.attention\.out_proj\.weight"),
        (lambda folder: rewrite(folder / "config.json", intermediate_size=64), "transformers can read"),
        (lambda folder: rewrite(folder / "config.json", model_type="bert"), "'bert'; give one of wav2vec2"),
        (lambda folder: rewrite(folder / "preprocessor_config.json", sampling_rate=8000), "at 8000 Hz"),
    ],
)
def test_a_damaged_folder_is_refused_in_one_line(
    damaged: Path, damage: Callable[[Path], None], says: str
) -> None:
    damage(damaged)
    user_encoder.cache_clear()
    with pytest.raises(ModelError, match=says) as caught:
        load_encoder(damaged).encode(noise(0.5))
    assert str(damaged) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("{models}/wav2vec2#layer=4", "no layer 4; this model has layers 1 to 3"),
        ("{models}/wav2vec2#layer=0", "no layer 0"),
        ("{models}/nowhere", "no such folder"),
        ("./owner/name", "no such folder"),
        ("", "empty name"),
    ],
)
def test_what_names_no_encoder_is_refused(
    models: Path, source: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import huggingface_hub

    monkeypatch.setattr(huggingface_hub, "snapshot_download", None)  # none of these may ask the network
    with pytest.raises(ModelError, match=says):
        load_encoder(source.format(models=models))


def test_a_hub_name_is_fetched_weights_as_safetensors_first(
    models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import huggingface_hub

    asked: list[list[str]] = []

    def snapshot(name: str, allow_patterns: list[str]) -> str:
        assert name == "owner/name"
        asked.append(allow_patterns)
        return str(models / "hubert") if len(asked) == 1 else str(tmp_path)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot)
    assert find_folder("owner/name") == models / "hubert"
    assert len(asked) == 1 and "model.safetensors" in asked[0] and "pytorch_model.bin" not in asked[0]
    assert find_folder("owner/name") == tmp_path
    assert len(asked) == 3 and "pytorch_model.bin" in asked[2]


def test_a_hub_that_does_not_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub

    def fail(name: str, allow_patterns: list[str]) -> str:
        raise OSError("connection\nrefused")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", fail)
    with pytest.raises(ModelError, match=r"owner/name: neither a folder .*\(connection refused\)"):
        load_encoder("owner/name")
