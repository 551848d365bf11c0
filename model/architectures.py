"""The denoising networks by name: the paper's, and the two of its ablation (Table 3a)."""

from __future__ import annotations

from model.attention_network import AttentionNetwork
from model.denoiser import Architecture, Denoiser, NetworkConfig
from model.errors import ModelError
from model.network import Network
from model.transformer_network import TransformerNetwork

ARCHITECTURES: dict[Architecture, type[Denoiser]] = {
    "conv": Network,
    "attention": AttentionNetwork,
    "transformer": TransformerNetwork,
}


def build_network(config: NetworkConfig) -> Denoiser:
    """An untrained network of these sizes; ModelError for an unknown architecture."""
    if config.architecture not in ARCHITECTURES:
        known = ", ".join(ARCHITECTURES)
        raise ModelError(f"architecture {config.architecture!r} is not known; use one of {known}")
    return ARCHITECTURES[config.architecture](config)
