"""Speech encoders that the user gives: wav2vec2, HuBERT, WavLM or Whisper, through the optional package transformers.

A source is a folder as `save_pretrained` writes it (config.json, preprocessor_config.json, weights) or the name of a
model of the Hugging Face hub, `owner/name`; `#layer=6` behind it takes the output of the sixth transformer block
instead of the last hidden state, which is the paper's choice for wav2vec2. Only a hub name reaches for the network.
Nothing is unpickled and no code that comes with a model is run.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.errors import ModelError
from model.speech_windows import OVERLAP, SAMPLE_RATE, WINDOW, in_windows, peak_normalized

WAVEFORM_FAMILIES = ("wav2vec2", "hubert", "wavlm")
FAMILIES = (*WAVEFORM_FAMILIES, "whisper")
SOURCE = re.compile(r"(?P<place>.+?)(#layer=(?P<layer>\d+))?")
HUB_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
# What transformers reads, in its order of preference; the second of each pair are shards.
SAFETENSORS = ("model.safetensors", "model-*.safetensors")
TORCH_FILES = ("pytorch_model.bin", "pytorch_model-*.bin")
PROCESSORS = ("preprocessor_config.json", "processor_config.json")
CONFIGS = ("config.json", *PROCESSORS, "*.index.json")
# No code that a model brings, and no network once there is a folder.
LOCAL = {"local_files_only": True, "trust_remote_code": False}


@dataclass(frozen=True)
class Framing:
    """Where rows lie in sound: row k comes from samples [k hop, k hop + field) and is centred at k hop + centre.

    column: samples a column of the model's input. window, overlap: rows encoded together, and shared by neighbours.
    """

    hop: int
    field: int
    centre: float
    column: int
    window: int
    overlap: int

    @classmethod
    def of(cls, config: Any) -> Framing:
        """The framing that a model's configuration says.

        A stack of convolutions with kernels k_i and strides s_i has the hop prod s_i and sees
        1 + sum (k_i - 1) prod_{j < i} s_j samples: 320 and 400 for wav2vec2, so its rows are centred at 12.5 ms,
        32.5 ms, ... Whisper's row k is centred on mel frame 2 k, at 20 k ms.
        """
        if config.model_type == "whisper":
            return cls(320, 320, 0.0, 160, WINDOW, OVERLAP)
        hop, field = 1, 1
        for kernel, stride in zip(config.conv_kernel, config.conv_stride, strict=True):
            field += (kernel - 1) * hop
            hop *= stride
        # Half of Whisper's windows: these models were trained on crops of up to 16 s.
        return cls(hop, field, (field - 1) / 2, 1, WINDOW // 2, OVERLAP // 2)

    def rows(self, samples: int) -> int:
        """Rows that cover sound of so many samples; the last may look into the silence behind it."""
        return 1 + -(-max(0, samples - self.field) // self.hop)

    def samples(self, rows: int) -> int:
        """Samples that so many rows are computed from."""
        return (rows - 1) * self.hop + self.field


@dataclass(frozen=True)
class TransformersEncoder:
    """A SpeechEncoder made of a model in `folder`; its weights are read when the first sound is encoded."""

    name: str
    width: int
    rate: float
    folder: Path
    config: Any
    extractor: Any
    layer: int
    framing: Framing

    @torch.inference_mode()
    def encode(self, audio: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Features [M, width] f32 of mono sound [S] f32 at 16 kHz, and the times [M] s of the rows' centres.

        The peak is normalized, then the model's own processor sees the whole clip (mean and variance, or log-mel).
        Windows of 15 s (Whisper: 30 s) share a third and fade into each other. Raises SpeechError on empty or
        non-finite sound, ModelError on weights that cannot be used.
        """
        framing = self.framing
        rows = framing.rows(audio.size)
        columns = self._columns(peak_normalized(audio, framing.samples(rows)))
        # More than `rows` where Whisper's processor fills short sound to 30 s, the only length Whisper takes.
        encoded = framing.rows(columns.shape[-1] * framing.column)

        def encode(first: int, stop: int) -> Tensor:
            start = first * framing.hop // framing.column
            length = framing.samples(stop - first) // framing.column
            return self._hidden(columns[..., start : start + length])

        features = in_windows(encoded, self.width, encode, framing.window, framing.overlap)[:rows]
        return features.numpy(), framing.centre / SAMPLE_RATE + np.arange(rows) / self.rate

    @cached_property
    def _model(self) -> Any:
        return load_model(self.folder, self.config, self.layer)

    def _columns(self, sound: Tensor) -> Tensor:
        """Sound [S] as the model's input: [S], or mel bands [80, >= 3000]."""
        whisper = (
            {"padding": "max_length", "truncation": False} if self.config.model_type == "whisper" else {}
        )
        batch = self.extractor(sound.numpy(), sampling_rate=SAMPLE_RATE, return_tensors="pt", **whisper)
        columns: Tensor = batch[self.extractor.model_input_names[0]][0]
        return columns

    def _hidden(self, columns: Tensor) -> Tensor:
        """Hidden state [rows, width] of one window of input."""
        last = self.layer == self.config.num_hidden_layers
        output = self._model(columns[None], output_hidden_states=not last)
        hidden: Tensor = output.last_hidden_state if last else output.hidden_states[self.layer]
        return hidden[0]


@lru_cache(maxsize=1)
def user_encoder(source: str) -> TransformersEncoder:
    """The encoder that `source` names, bound to the sha256 of its weight files.

    Raises ModelError, in one line, where transformers is missing or the source is no model of these families.
    """
    match = SOURCE.fullmatch(source)
    if match is None:
        raise ModelError("an empty name for the speech encoder; give a model's folder or hub name")
    transformers = import_transformers(source)
    folder = find_folder(match["place"])
    weights = weight_files(folder)
    if not any((folder / name).is_file() for name in PROCESSORS):
        raise ModelError(f"{folder}: no {PROCESSORS[0]} there; copy it from where the model came from")
    try:
        config = transformers.AutoConfig.from_pretrained(folder, **LOCAL)
        extractor = transformers.AutoFeatureExtractor.from_pretrained(folder, **LOCAL)
    except Exception as error:  # whatever a reader of the user's files raises, the files are what is wrong
        raise unusable(folder, error) from error
    family, layers = config.model_type, config.num_hidden_layers
    if family not in FAMILIES:
        raise ModelError(f"{folder}: a model of type {family!r}; give one of {', '.join(FAMILIES)}")
    if extractor.sampling_rate != SAMPLE_RATE:
        raise ModelError(
            f"{folder}: a model for sound at {extractor.sampling_rate} Hz; {SAMPLE_RATE} Hz is needed"
        )
    layer = int(match["layer"] or layers)
    if not 1 <= layer <= layers:
        raise ModelError(f"{source}: there is no layer {layer}; this model has layers 1 to {layers}")
    framing = Framing.of(config)
    return TransformersEncoder(
        name=f"{family}#layer={layer}@{content_hash(weights)}",
        width=config.hidden_size,
        rate=SAMPLE_RATE / framing.hop,
        folder=folder,
        config=config,
        extractor=extractor,
        layer=layer,
        framing=framing,
    )


def import_transformers(source: str) -> Any:
    """The package, silent. Raises ModelError where it is not installed."""
    try:
        import transformers
    except ImportError as error:
        raise ModelError(
            f"{source}: a speech encoder other than the embedded one needs the package transformers: "
            "in the program's folder, .venv/bin/python -m pip install -c constraints.txt -e '.[encoders]'"
        ) from error
    transformers.logging.set_verbosity_error()
    transformers.logging.disable_progress_bar()
    return transformers


def find_folder(place: str) -> Path:
    """The user's folder, or the local copy of a model of the hub, fetched where it is not there yet."""
    folder = Path(place).expanduser()
    if folder.is_dir():
        return folder
    if not HUB_NAME.fullmatch(place):
        raise ModelError(
            f"{place}: no such folder; give a model's folder, or a hub name like facebook/wav2vec2-base-960h"
        )
    from huggingface_hub import snapshot_download  # comes with transformers

    try:
        folder = Path(snapshot_download(place, allow_patterns=[*CONFIGS, *SAFETENSORS]))
        if not any(folder.glob("*.safetensors")):
            snapshot_download(place, allow_patterns=[*TORCH_FILES])
    except (OSError, ValueError) as error:
        reason = one_line(error)
        raise ModelError(
            f"{place}: neither a folder nor a model that the hub gives ({reason}); check the spelling, go online, "
            "or give a model's folder"
        ) from error
    return folder


def weight_files(folder: Path) -> list[Path]:
    """The files that transformers takes the weights from: safetensors where there are any."""
    for pattern in (*SAFETENSORS, *TORCH_FILES):
        if files := sorted(folder.glob(pattern)):
            return files
    raise ModelError(f"{folder}: no weights there ({SAFETENSORS[0]} or {TORCH_FILES[0]})")


def content_hash(files: list[Path]) -> str:
    """sha256 of the files' bytes one after the other; of a single file its sha256sum."""
    digest = hashlib.sha256()
    for path in files:
        with path.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def load_model(folder: Path, config: Any, layer: int) -> Any:
    """The encoder, in float32, up to what layer `layer` needs.

    Raises ModelError where the weight files are broken, lack tensors, or do not fit the configuration.
    """
    import transformers

    config.add_adapter = False  # wav2vec2's adapter would thin the rows out behind the last layer
    try:
        model, found = transformers.AutoModel.from_pretrained(
            folder,
            config=config,
            dtype=torch.float32,
            use_safetensors=weight_files(folder)[0].suffix == ".safetensors",
            weights_only=True,
            output_loading_info=True,
            **LOCAL,
        )
    except Exception as error:  # as above
        raise unusable(folder, error) from error
    # transformers fills what a file lacks with random numbers. The mask is for training, the decoder is not used.
    missing = [key for key in found["missing_keys"] if not key.startswith(("masked_spec_embed", "decoder."))]
    if missing:
        raise ModelError(f"{folder}: its weights lack {len(missing)} tensors, e.g. {sorted(missing)[0]}")
    whisper = config.model_type == "whisper"
    encoder = (model.get_encoder() if whisper else model).eval()
    # One block more than needed: only behind the last block stands a norm.
    del (encoder.layers if whisper else encoder.encoder.layers)[layer + 1 :]
    return encoder


def unusable(folder: Path, error: Exception) -> ModelError:
    """The one line for files that transformers cannot read."""
    return ModelError(f"{folder}: not a speech encoder that transformers can read ({one_line(error)})")


def one_line(error: Exception) -> str:
    """The start of what a library says."""
    return " ".join(str(error).split())[:160]
