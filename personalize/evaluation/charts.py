"""The report's plots, as SVG text for a page."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib

matplotlib.use("svg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from numpy.typing import NDArray

BLUE, ORANGE, GREY, GREEN, RED = "#2f6fb3", "#d9822b", "#9aa0a6", "#3c9a5f", "#c8443a"
LABEL_PX = 16  # apart, or one would cover the other


def _axes(width: float = 10.4, height: float = 2.4) -> tuple[Figure, Axes]:
    figure, axes = plt.subplots(figsize=(width, height), layout="constrained")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    return figure, axes


def _svg(figure: Figure) -> str:
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    plt.close(figure)
    text = stream.getvalue()
    return text[text.index("<svg") :]


def timeline(time: NDArray[np.floating], confidence: NDArray[np.floating], valid: NDArray[np.bool_]) -> str:
    """Confidence over the clip; frames left out are shaded."""
    figure, axes = _axes(height=1.8)
    axes.plot(time, np.where(valid, confidence, np.nan), color=BLUE, lw=0.8)
    edges = np.append(time, time[-1] + (np.median(np.diff(time)) if len(time) > 1 else 1.0))
    first, end = edges[np.flatnonzero(np.diff(~valid, prepend=False, append=False))].reshape(-1, 2).T
    axes.broken_barh(list(zip(first, end - first)), (0, 1), color=RED, alpha=0.25, lw=0.8, label="left out")
    axes.set(ylim=(0, 1.02), xlim=(edges[0], edges[-1]), xlabel="s", ylabel="confidence")
    if not valid.all():
        axes.legend(loc="lower right", frameon=False)
    return _svg(figure)


def loss_curve(steps: Sequence[float], losses: Sequence[float]) -> str:
    """Training loss over fine-tuning steps, logarithmic."""
    figure, axes = _axes()
    axes.semilogy(steps, losses, color=BLUE, lw=1)
    axes.yaxis.set_major_formatter(LogFormatter())
    axes.yaxis.set_minor_formatter(LogFormatter())
    axes.set(xlabel="iteration", ylabel="loss")
    return _svg(figure)


def lip_opening(
    time: NDArray[np.floating], reference: NDArray[np.floating], samples: NDArray[np.floating]
) -> str:
    """Lip opening in mm over test frames: reference [N] and samples [S, N]."""
    figure, axes = _axes()
    for index, sample in enumerate(samples):
        axes.plot(time, sample, color=ORANGE, lw=0.7, alpha=0.5, label="synthesized" if index == 0 else None)
    axes.plot(time, reference, color="black", lw=1.2, label="tracked")
    axes.set(xlabel="s", ylabel="lip opening, mm", xlim=(time[0], time[-1]))
    axes.legend(loc="upper right", frameon=False, ncols=2)
    return _svg(figure)


def guidance_curve(sweep: Sequence[dict[str, float]], chosen: float) -> str:
    """Diversity against lip synchrony for each guidance scale of the sweep (the paper's figure 3)."""
    figure, axes = _axes(width=5.0, height=3.0)
    axes.plot([row["div_e"] for row in sweep], [row["lip_sync"] for row in sweep], color=GREY, lw=1)
    axes.autoscale_view()  # else places in the plot are not known yet
    labelled: list[NDArray[np.floating]] = []
    for row in sorted(sweep, key=lambda row: abs(row["s"] - chosen)):
        is_chosen = not labelled
        place = row["div_e"], row["lip_sync"]
        axes.scatter(*place, color=GREEN if is_chosen else BLUE, s=40 if is_chosen else 16)
        seen = axes.transData.transform(place)
        if all(np.abs(seen - other).max() > LABEL_PX for other in labelled):
            labelled.append(seen)
            axes.annotate(f"{row['s']:.1f}", place, fontsize=8, xytext=(4, 3), textcoords="offset points")
    axes.set(xlabel="diversity over samples (div_e), mm", ylabel="lip_sync, mm (lower is better)")
    return _svg(figure)
