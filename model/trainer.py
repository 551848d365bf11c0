"""Training: METHOD's objective in the vertex metric, averaged weights, candidates, and exact continuation."""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Iterator
from collections.abc import Sequence as Many
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from model.checkpoint import Checkpoint, State, read_tensors, serialize, write_atomically
from model.dataset import Batch, Crops, Sequence
from model.diffusion import Diffusion, Progress
from model.errors import ModelError
from model.network import Network

STATE_FILE = "state.safetensors"
LOG_FILE = "log.csv"


@dataclass(frozen=True)
class TrainingConfig:
    """The paper's settings; what the paper is silent about says so."""

    iterations: int = 30_000
    batch: int = 64
    frames: int = 30
    """Length of a crop."""
    learning_rate: float = 1e-3
    """The paper's is 1e-4, in vertex space; standardized coefficients bear more and need it (docs/method.md)."""
    unconditional: float = 0.1
    """Share of the batch whose audio condition is zeroed."""
    velocity: float = 10.0
    """Weight of the velocity term."""
    metric_power: float = 0.5
    """A coefficient weighs scale^power: 2 is the paper's vertex metric; see `coefficient_weights` (ours)."""
    ema: float = 0.999
    """Decay of the averaged weights (ours)."""
    candidates: int = 10
    """Checkpoints kept on the way, evenly spaced, for the choice on validation."""
    seed: int = 0
    threads: int = 2
    """For torch, while training (ours)."""
    save_seconds: float = 20.0
    """A killed run loses at most this much (ours)."""
    log_every: int = 50


class TrainingDivergedError(ModelError):
    """The loss became infinite or rose far above what predicting nothing costs."""


def coefficient_weights(scale: Tensor, power: float) -> Tensor:
    """[K]: what a standardized squared residual weighs in the loss, scale^power, summing to 1.

    Power 2 is the vertex metric: the basis is orthonormal, so sum_k scale_k^2 r_k^2 is the squared vertex distance.
    There the small coefficients get no gradient to speak of, and are sampled as white noise that shakes the face; a
    power of 1/2 measured best (docs/method.md). A loss of 1 is what predicting the mean motion costs.
    """
    weights = scale**power
    return weights / weights.sum()


def objective(x0: Tensor, predicted: Tensor, weights: Tensor, velocity: float) -> Tensor:
    """METHOD 4: ||x0 - x0hat||^2 + velocity ||dx0 - dx0hat||^2, each a mean over its frames; [N, B, K] ->
    scalar.
    """
    residual = x0 - predicted
    change = residual[1:] - residual[:-1]
    frames, batch = x0.shape[0], x0.shape[1]
    position = (residual.square() @ weights).sum() / (frames * batch)
    return position + velocity * (change.square() @ weights).sum() / ((frames - 1) * batch)


class Trainer:
    """Trains a checkpoint's weights on sequences, in a folder that holds all that a continuation needs."""

    def __init__(
        self,
        checkpoint: Checkpoint,
        sequences: Many[Sequence],
        folder: Path,
        config: TrainingConfig | None = None,
        *,
        tensorboard: Path | None = None,
    ) -> None:
        """Starts from `folder`'s saved state when there is one, else from the checkpoint's weights.

        Raises ModelError where there is too little motion, or the saved state is of another training.
        """
        self.config = config or TrainingConfig()
        self.folder = folder
        self.folder.mkdir(parents=True, exist_ok=True)
        self._checkpoint = checkpoint
        self._tensorboard = tensorboard
        self._crops = Crops(sequences, checkpoint.standardization, self.config.frames)
        self._weights = coefficient_weights(
            torch.from_numpy(checkpoint.standardization.scale), self.config.metric_power
        )
        self._diffusion: Diffusion = checkpoint.diffusion()
        self._network = Network(checkpoint.config)
        self._network.load_state_dict(checkpoint.network)
        # In the network's own order, which a loaded file does not keep: the average follows tensor by tensor.
        self._average = {name: checkpoint.network[name].clone() for name in self._network.state_dict()}
        self._optimizer = torch.optim.Adam(
            self._network.parameters(), lr=self.config.learning_rate, fused=True
        )
        self._parameters = [p for _, p in self._network.named_parameters()]
        self.step = 0
        self._losses: list[float] = []
        if (self.folder / STATE_FILE).exists():
            self._restore()

    def train(self, progress: Progress | None = None) -> list[Path]:
        """Run to the end; the paths of the candidates, oldest first.

        Raises TrainingDivergedError, naming the iteration; the candidates up to then stay.
        """
        saved = time.monotonic()
        with _threads(self.config.threads), _Log(self.folder / LOG_FILE, self.step, self._tensorboard) as log:
            while self.step < self.config.iterations:
                self._losses.append(self._iterate())
                self.step += 1
                if self.step % self.config.log_every == 0 or self.step == self.config.iterations:
                    log.write(self.step, self._checked_loss())
                    if progress is not None:
                        progress(self.step, self.config.iterations)
                if self.step in self._candidate_steps():
                    self.checkpoint().save(self._candidate(self.step))
                if time.monotonic() - saved > self.config.save_seconds:
                    self._save()
                    saved = time.monotonic()
            self._save()
        return [self._candidate(step) for step in self._candidate_steps() if self._candidate(step).exists()]

    def checkpoint(self, **changes: Any) -> Checkpoint:
        """The model as it is now."""
        network = {name: value.detach().clone() for name, value in self._network.state_dict().items()}
        average = {name: value.clone() for name, value in self._average.items()}
        return self._checkpoint.with_weights(network, average, **changes)

    def _iterate(self) -> float:
        """One step of Adam on one random batch; its loss.

        All randomness comes from (seed, step), so a continued run draws what the uninterrupted one does.
        """
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.step)
        loss = self._loss(self._crops.draw(self.config.batch, generator), generator)
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        self._follow()
        return loss.item()

    def _loss(self, batch: Batch, generator: torch.Generator) -> Tensor:
        """The objective at random diffusion steps, with some audio conditions zeroed."""
        count = batch.motion.shape[1]
        t = torch.randint(self._diffusion.steps, (count,), generator=generator)
        keep = (torch.rand(count, generator=generator) >= self.config.unconditional).float()
        noise = torch.randn(batch.motion.shape, generator=generator)
        x_t = self._diffusion.add_noise(batch.motion, t, noise)
        output = self._network(x_t, t, self._network.condition(batch.audio, keep), batch.style)
        predicted = self._diffusion.x0(output, x_t, t)
        return objective(batch.motion, predicted, self._weights, self.config.velocity)

    @torch.no_grad()
    def _follow(self) -> None:
        """The averaged weights follow the trained ones; a short memory first, so that the start is
        forgotten.
        """
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
        torch._foreach_lerp_(
            list(self._average.values()), list(self._network.state_dict().values()), 1 - decay
        )

    def _checked_loss(self) -> float:
        """Mean loss since the last call."""
        loss = sum(self._losses) / len(self._losses)
        self._losses = []
        limit = 3 * (1 + 2 * self.config.velocity)
        if not math.isfinite(loss) or loss > limit:
            raise TrainingDivergedError(
                f"training diverged at iteration {self.step} (loss {loss:.3g}): the data holds outliers or is"
                " too short; look at the overlay for frames that are tracked wrongly, or lower the learning rate"
            )
        return loss

    def _candidate_steps(self) -> list[int]:
        count = min(self.config.candidates, self.config.iterations)
        return [round(self.config.iterations * (i + 1) / count) for i in range(count)]

    def _candidate(self, step: int) -> Path:
        return self.folder / f"candidate_{step:08d}.safetensors"

    def _settings(self) -> str:
        """What must agree for a continuation to be the same training: all but where it is saved, logged,
        run.
        """
        settings = asdict(self.config)
        for name in ("threads", "save_seconds", "log_every"):
            del settings[name]
        return json.dumps(settings | {"crops": len(self._crops)}, sort_keys=True)

    def _save(self) -> None:
        """State for a continuation, written atomically."""
        tensors: State = {f"network.{n}": v.detach() for n, v in self._network.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self._average.items()}
        for index, parameter in enumerate(self._parameters):
            for name, value in self._optimizer.state[parameter].items():
                tensors[f"adam.{index}.{name}"] = value
        tensors["losses"] = torch.tensor(self._losses, dtype=torch.float64)
        metadata = {"step": str(self.step), "settings": self._settings()}
        write_atomically(self.folder / STATE_FILE, serialize(tensors, metadata))

    def _restore(self) -> None:
        path = self.folder / STATE_FILE
        tensors, metadata = read_tensors(path)
        if metadata.get("settings") != self._settings():
            raise ModelError(
                f"{path} belongs to a training with other settings or data; remove its folder to start anew"
            )
        self._network.load_state_dict({n: tensors[f"network.{n}"] for n in self._network.state_dict()})
        self._average = {name: tensors[f"average.{name}"] for name in self._average}
        for index, parameter in enumerate(self._parameters):
            names = ("step", "exp_avg", "exp_avg_sq")
            self._optimizer.state[parameter] = {name: tensors[f"adam.{index}.{name}"] for name in names}
        self._losses = tensors["losses"].tolist()
        self.step = int(metadata["step"])


class _Log:
    """`step,loss` lines in a CSV file, rows beyond a continuation's start removed; TensorBoard beside it."""

    def __init__(self, path: Path, step: int, tensorboard: Path | None) -> None:
        rows = []
        if path.exists():
            with path.open(newline="") as stream:
                rows = [row for row in csv.reader(stream) if len(row) == 2 and row[0].isdigit()]
        lines = ["step,loss", *(",".join(row) for row in rows if int(row[0]) <= step)]
        write_atomically(path, ("\n".join(lines) + "\n").encode())
        self._stream = path.open("a")
        self._writer: Any = None
        if tensorboard is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(tensorboard), purge_step=step + 1)

    def __enter__(self) -> _Log:
        return self

    def write(self, step: int, loss: float) -> None:
        self._stream.write(f"{step},{loss:.6g}\n")
        self._stream.flush()
        if self._writer is not None:
            self._writer.add_scalar("loss", loss, step)

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        if self._writer is not None:
            self._writer.close()


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """torch on so many threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
