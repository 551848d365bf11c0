"""The checkpoint file: everything that turns speech features into a person's motion, as safetensors."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from model.architectures import build_network
from model.dataset import Standardization
from model.denoiser import Architecture, Denoiser, NetworkConfig
from model.diffusion import Diffusion, Parametrization, Schedule
from model.errors import ModelError
from model.files import write_bytes
from model.motion import FPS, topology_hash

SCHEMA = "1"
Kind = Literal["base", "subject"]
State = dict[str, Tensor]
# Without these nothing can be measured, drawn or kept.
NEEDED_REGIONS = ("lips", "face", "inner_lip_upper", "inner_lip_lower")


@dataclass(frozen=True)
class Checkpoint:
    """A model of one person (`subject`) or of several (`base`).

    encoder: name of the speech encoder its features come from. styles: a name for each row of the style
    table.
    guidance: the default s. network, ema: parameters by name, as trained and averaged.
    basis [K, D, 3] f32 orthonormal, template [D, 3] f32 m, faces [F, 3] i32.
    regions: vertex indices by name (int32), e.g. lips, face, inner_lip_upper.
    """

    kind: Kind
    encoder: str
    styles: tuple[str, ...]
    config: NetworkConfig
    network: State
    ema: State
    basis: NDArray[np.float32]
    template: NDArray[np.float32]
    faces: NDArray[np.int32]
    standardization: Standardization
    regions: dict[str, NDArray[np.int32]] = field(default_factory=dict)
    schedule: Schedule = "cosine"
    parametrization: Parametrization = "skip"
    fps: float = FPS
    guidance: float = 0.5
    provenance: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def initial(
        cls,
        *,
        kind: Kind,
        encoder: str,
        styles: tuple[str, ...],
        basis: NDArray[np.float32],
        template: NDArray[np.float32],
        faces: NDArray[np.int32],
        standardization: Standardization,
        regions: dict[str, NDArray[np.int32]],
        seed: int = 0,
        schedule: Schedule = "cosine",
        parametrization: Parametrization = "skip",
        architecture: Architecture = "conv",
        provenance: dict[str, Any] | None = None,
    ) -> Checkpoint:
        """An untrained model, its weights drawn from `seed`; ModelError for an unknown architecture."""
        config = NetworkConfig(
            len(basis), len(standardization.audio_mean), len(styles), architecture=architecture
        )
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            state = build_network(config).state_dict()
        return cls(
            kind=kind,
            encoder=encoder,
            styles=styles,
            config=config,
            network=state,
            ema={name: value.clone() for name, value in state.items()},
            basis=basis,
            template=template,
            faces=faces,
            standardization=standardization,
            regions=regions,
            schedule=schedule,
            parametrization=parametrization,
            provenance=provenance or {},
        )

    @property
    def topology(self) -> str:
        """sha256 of D and the faces."""
        return topology_hash(len(self.template), self.faces)

    def diffusion(self) -> Diffusion:
        """The diffusion that it was trained with."""
        return Diffusion(
            self.schedule, self.parametrization, spread=torch.from_numpy(self.standardization.spread)
        )

    def model(self) -> Denoiser:
        """The network with its averaged weights, ready to evaluate."""
        network = build_network(self.config)
        network.load_state_dict(self.ema)
        return network.eval().requires_grad_(False)

    def style(self, name: str | None) -> int:
        """Row of the style table; None is the last one, which in a subject's checkpoint is the subject."""
        if name is None:
            return len(self.styles) - 1
        if name not in self.styles:
            raise ModelError(f"style {name!r} is not in this checkpoint; it has {', '.join(self.styles)}")
        return self.styles.index(name)

    def with_weights(self, network: State, ema: State, **changes: Any) -> Checkpoint:
        """A copy with other weights (and other fields)."""
        return replace(self, network=network, ema=ema, **changes)

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        arrays = {"basis": self.basis, "template": self.template, "faces": self.faces.astype(np.int32)}
        arrays |= {f"standardization.{name}": value for name, value in asdict(self.standardization).items()}
        arrays |= {f"regions.{name}": value.astype(np.int32) for name, value in self.regions.items()}
        tensors = {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in arrays.items()}
        tensors |= {f"network.{name}": value.contiguous() for name, value in self.network.items()}
        tensors |= {f"ema.{name}": value.contiguous() for name, value in self.ema.items()}
        metadata = {
            "schema": SCHEMA,
            "kind": self.kind,
            "topology": self.topology,
            "encoder": self.encoder,
            "styles": json.dumps(self.styles),
            "fps": repr(self.fps),
            "guidance": repr(self.guidance),
            "provenance": json.dumps(self.provenance),
            "network": json.dumps(asdict(self.config)),
            "schedule": self.schedule,
            "parametrization": self.parametrization,
        }
        write_bytes(path, serialize(tensors, metadata))

    @classmethod
    def load(cls, path: Path, *, topology: str | None = None, encoder: str | None = None) -> Checkpoint:
        """Read a checkpoint; where given, it must be of this topology (sha256) and this speech encoder.

        Raises ModelError, in one line, for a file that is missing, broken, no checkpoint, or of another kind.
        """
        tensors, metadata = read_tensors(path)
        if metadata.get("schema") != SCHEMA:
            found = metadata.get("schema", "no schema at all")
            raise ModelError(f"{path} is not a checkpoint of schema {SCHEMA} (it has {found}); make it again")
        try:
            checkpoint = _assemble(tensors, metadata)
        except (KeyError, ValueError, TypeError, RuntimeError, ZeroDivisionError) as error:
            reason = " ".join(str(error).split())[:120]
            raise ModelError(
                f"{path} is damaged or incomplete as a checkpoint ({reason}); make it again"
            ) from error
        if checkpoint.topology != metadata.get("topology"):
            raise ModelError(f"{path} is damaged: its mesh is not the one its topology names; make it again")
        if topology is not None and checkpoint.topology != topology:
            raise ModelError(
                f"{path} is for the mesh topology {checkpoint.topology[:12]}, and {topology[:12]} is needed:"
                " register the motion to the checkpoint's mesh, or give a checkpoint of this one"
            )
        if encoder is not None and checkpoint.encoder != encoder:
            raise ModelError(
                f"{path} needs the speech encoder {checkpoint.encoder!r} that it was trained with, and got"
                f" {encoder!r}: give that one's folder or hub name with --encoder (without it, the embedded one"
                " is taken), or another checkpoint"
            )
        return checkpoint


def _assemble(tensors: dict[str, Tensor], metadata: dict[str, str]) -> Checkpoint:
    """The checkpoint of a file's content; KeyError, ValueError, TypeError, RuntimeError or ZeroDivisionError if it does
    not fit.
    """

    def group(prefix: str) -> State:
        return {
            name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)
        }

    for name, known in (("kind", Kind), ("schedule", Schedule), ("parametrization", Parametrization)):
        if metadata[name] not in get_args(known):
            raise ValueError(f"{name} {metadata[name]!r}")
    config = NetworkConfig(**json.loads(metadata["network"]))
    statistics = {name: value.numpy() for name, value in group("standardization.").items()}
    # Before there was a spread, the skip took it as one.
    standardization = Standardization(**{"spread": np.ones_like(statistics["scale"])} | statistics)
    basis, template, faces = (tensors[name].numpy() for name in ("basis", "template", "faces"))
    styles = tuple(json.loads(metadata["styles"]))
    if (
        basis.shape != (config.coefficients, *template.shape)
        or template.shape[1:] != (3,)
        or faces.shape[1:] != (3,)
    ):
        raise ValueError(f"shapes {basis.shape}, {template.shape}, {faces.shape} of basis, template, faces")
    if len(styles) != config.styles:
        raise ValueError(f"{len(styles)} style names for {config.styles} styles")
    shapes = {standardization.scale.shape, standardization.spread.shape, standardization.mean.shape}
    if shapes != {(config.coefficients,)} or not (standardization.scale > 0).all():
        raise ValueError("mean, scale or spread of the coefficients")
    shapes = {standardization.audio_mean.shape, standardization.audio_scale.shape}
    if shapes != {(config.audio_width,)} or not (standardization.audio_scale > 0).all():
        raise ValueError("mean or scale of the speech features")
    checkpoint = Checkpoint(
        kind="base" if metadata["kind"] == "base" else "subject",
        encoder=metadata["encoder"],
        styles=styles,
        config=config,
        network=group("network."),
        ema=group("ema."),
        basis=basis,
        template=template,
        faces=faces,
        standardization=standardization,
        regions={name: value.numpy() for name, value in group("regions.").items()},
        schedule="linear" if metadata["schedule"] == "linear" else "cosine",
        parametrization="plain" if metadata["parametrization"] == "plain" else "skip",
        fps=float(metadata["fps"]),
        guidance=float(metadata["guidance"]),
        provenance=json.loads(metadata["provenance"]),
    )
    _check_values(checkpoint)
    with torch.device("meta"):  # a file may claim sizes that no memory holds
        network = build_network(config)
    for state in (checkpoint.network, checkpoint.ema):
        network.load_state_dict(state, assign=True)  # every weight is there and has its shape
    return checkpoint


def _check_values(checkpoint: Checkpoint) -> None:
    """ValueError where a mesh names what is not there, a region is missing, or a number is none."""
    indices = {"faces": checkpoint.faces, **checkpoint.regions}
    for name, values in indices.items():
        if values.dtype.kind not in "iu" or not ((values >= 0) & (values < len(checkpoint.template))).all():
            raise ValueError(f"{name} must name vertices, of which there are {len(checkpoint.template)}")
    if missing := [name for name in NEEDED_REGIONS if not len(checkpoint.regions.get(name, ()))]:
        raise ValueError(f"region {missing[0]} is missing")
    numbers = [checkpoint.basis, checkpoint.template, *asdict(checkpoint.standardization).values()]
    if not all(np.isfinite(values).all() for values in (*numbers, checkpoint.guidance, checkpoint.fps)):
        raise ValueError("values that are not finite")
    if not all(torch.isfinite(values).all() for values in checkpoint.ema.values()):
        raise ValueError("weights that are not finite")
    if checkpoint.fps <= 0:
        raise ValueError(f"fps {checkpoint.fps}")


def serialize(tensors: State, metadata: dict[str, str]) -> bytes:
    """A safetensors file whose bytes depend on its content only: the library writes metadata in any order."""
    content = save(tensors, metadata)
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8:start]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[start:]


def is_checkpoint(path: Path) -> bool:
    """Whether a file is a checkpoint, of whatever schema."""
    try:
        with safe_open(path, framework="pt") as stream:
            return "schema" in (stream.metadata() or {})
    except (SafetensorError, OSError):
        return False


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file; ModelError, in one line, where it is not one."""
    if not path.is_file():
        raise ModelError(f"there is no file {path}")
    if not os.access(path, os.R_OK):
        raise ModelError(f"{path} may not be read; check its permissions")
    try:
        with safe_open(path, framework="pt") as stream:
            return {name: stream.get_tensor(name) for name in stream.keys()}, stream.metadata() or {}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{path} is not a readable safetensors file ({error}); make it again") from error
