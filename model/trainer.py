"""Training: METHOD's objective, averaged weights, candidates, exact continuation; on one process or several."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from collections.abc import Sequence as Many
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from model.architectures import build_network
from model.checkpoint import Checkpoint, State, read_tensors, serialize, write_atomically
from model.dataset import Batch, Crops, Sequence
from model.denoiser import Denoiser
from model.diffusion import Diffusion, Progress
from model.errors import ModelError
from model.training_log import TrainingLog

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
    feature_dropout: float = 0.3
    """Share of the speech channels zeroed in a crop: less is learned by heart (ours; docs/method.md)."""
    weight_decay: float = 0.3
    """AdamW's, decoupled from the gradient: keeps samples from agreeing too much (ours; docs/method.md)."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the matrix products; weights, loss and sums stay in float32. auto: bfloat16 where it is fast (ours)."""
    device: str = "cpu"
    """`cpu`, `cuda`, `cuda:1`, … ; one device and one seed repeat to the byte (ours)."""
    candidates: int = 10
    """Checkpoints kept on the way, evenly spaced, for the choice on validation."""
    seed: int = 0
    threads: int = 0
    """For torch, while training; 0: two, or one in bfloat16, which gains nothing from a second (ours)."""
    save_seconds: float = 20.0
    """A killed run loses at most this much (ours)."""
    log_every: int = 50


def settled(config: TrainingConfig) -> TrainingConfig:
    """The settings with this machine's answer where they leave it open: precision, then threads."""
    precision = config.precision
    if precision == "auto":
        cuda = available_device(config.device).type == "cuda"
        fast = torch.cuda.is_bf16_supported() if cuda else _multiplies_bfloat16()
        precision = "bfloat16" if fast else "float32"
    return replace(
        config, precision=precision, threads=config.threads or (1 if precision == "bfloat16" else 2)
    )


def _multiplies_bfloat16() -> bool:
    """Whether the processor has tiles for it (AMX); elsewhere it is slower than float32."""
    return bool(torch.cpu.get_capabilities().get("amx_bf16"))


def available_device(name: str) -> torch.device:
    """The device of that name. Raises ModelError where this machine has none."""
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ModelError(f"device {name!r} is not known; use cpu or cuda") from None
    if device.type not in ("cpu", "cuda") or (device.type == "cuda" and not torch.cuda.is_available()):
        raise ModelError(f"device {name!r} is not there; use cpu")
    return device


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


@dataclass(frozen=True)
class Draws:
    """The randomness of one step but the crops: t [B] diffusion steps, noise [N, B, K], keep [B], channels [B, W or 1].

    keep: 0 where the speech is zeroed. channels: 0 where a speech channel is, the rest scaled to the same mean.
    """

    t: Tensor
    noise: Tensor
    keep: Tensor
    channels: Tensor

    def part(self, rows: slice) -> Draws:
        """Of some of the batch."""
        return Draws(self.t[rows], self.noise[:, rows], self.keep[rows], self.channels[rows])

    def to(self, device: str) -> Draws:
        """On a device."""
        return Draws(*(value.to(device) for value in vars(self).values()))

    @classmethod
    def of(cls, batch: Batch, steps: int, config: TrainingConfig, generator: torch.Generator) -> Draws:
        """For a batch, from the generator."""
        count, width = batch.audio.shape[1:]
        t = torch.randint(steps, (count,), generator=generator)
        keep = (torch.rand(count, generator=generator) >= config.unconditional).float()
        noise = torch.randn(batch.motion.shape, generator=generator)
        channels = torch.ones(count, 1)
        if config.feature_dropout:
            channels = (torch.rand((count, width), generator=generator) >= config.feature_dropout).float()
            channels = channels / (1 - config.feature_dropout)
        return cls(t, noise, keep, channels)


class Objective(nn.Module):
    """The loss of a batch under given draws: one module, so that it can be spread over processes as a whole."""

    def __init__(
        self, network: Denoiser, diffusion: Diffusion, weights: Tensor, config: TrainingConfig
    ) -> None:
        super().__init__()
        self.network = network
        self._diffusion, self._velocity, self._precision = diffusion, config.velocity, config.precision
        self.weights: Tensor
        self.register_buffer("weights", weights, persistent=False)

    def forward(self, batch: Batch, draws: Draws) -> Tensor:
        """Scalar; see `objective`."""
        kind = batch.motion.device.type
        with torch.autocast(kind, torch.bfloat16, enabled=self._precision == "bfloat16"):
            x_t = self._diffusion.add_noise(batch.motion, draws.t, draws.noise)
            condition = self.network.condition(batch.audio * draws.channels, draws.keep)
            output = self.network(x_t, draws.t, condition, batch.style).float()
        predicted = self._diffusion.x0(output, x_t, draws.t)
        return objective(batch.motion, predicted, self.weights, self._velocity)


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
        self.config = settled(config or TrainingConfig())
        self.folder = folder
        self.folder.mkdir(parents=True, exist_ok=True)
        self._checkpoint = checkpoint
        self._tensorboard = tensorboard
        self._crops = Crops(sequences, checkpoint.standardization, self.config.frames)
        weights = coefficient_weights(
            torch.from_numpy(checkpoint.standardization.scale), self.config.metric_power
        )
        self._diffusion: Diffusion = checkpoint.diffusion()
        self._network = build_network(checkpoint.config)
        self._network.load_state_dict(checkpoint.network)
        self._objective: nn.Module = Objective(self._network, self._diffusion, weights, self.config)
        self._objective.to(available_device(self.config.device))
        self._rank, self._world = (0, 1)
        if distributed.is_initialized():
            self._rank, self._world = distributed.get_rank(), distributed.get_world_size()
            self._objective = DistributedDataParallel(self._objective)
        # In the network's own order, which a loaded file does not keep: the average follows tensor by tensor.
        self._average = {name: value.clone() for name, value in self._network.state_dict().items()}
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(),
            lr=self.config.learning_rate,
            weight_decay=self.config.weight_decay,
            fused=True,
        )
        self._parameters = [p for _, p in self._network.named_parameters()]
        self.step = 0
        self._losses: list[Tensor] = []
        if (self.folder / STATE_FILE).exists():
            self._restore()

    def train(self, progress: Progress | None = None) -> list[Path]:
        """Run to the end; the paths of the candidates, oldest first.

        Raises TrainingDivergedError, naming the iteration; the candidates up to then stay.
        """
        saved = time.monotonic()
        # Of several processes only the first writes.
        log_file = self.folder / LOG_FILE if self._rank == 0 else None
        with _threads(self.config.threads), TrainingLog(log_file, self.step, self._tensorboard) as log:
            while self.step < self.config.iterations:
                self._losses.append(self._iterate())
                self.step += 1
                if self.step % self.config.log_every == 0 or self.step == self.config.iterations:
                    log.write(self.step, self._checked_loss())
                    if progress is not None:
                        progress(self.step, self.config.iterations)
                if self._rank > 0:
                    continue
                if self.step in self._candidate_steps():
                    self.checkpoint().save(self._candidate(self.step))
                if time.monotonic() - saved > self.config.save_seconds:
                    self._save()
                    saved = time.monotonic()
            if self._rank == 0:
                self._save()
            if self._world > 1:
                distributed.barrier()
        return [self._candidate(step) for step in self._candidate_steps() if self._candidate(step).exists()]

    def checkpoint(self, **changes: Any) -> Checkpoint:
        """The model as it is now."""
        network = {name: value.detach().cpu().clone() for name, value in self._network.state_dict().items()}
        average = {name: value.cpu().clone() for name, value in self._average.items()}
        return self._checkpoint.with_weights(network, average, **changes)

    def _iterate(self) -> Tensor:
        """One step of Adam on one random batch; its loss.

        All randomness comes from (seed, step), so a continued run draws what the uninterrupted one does. Of several
        processes each draws all of it and takes its share: their mean gradient is the whole batch's.
        """
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.step)
        batch = self._crops.draw(self.config.batch, generator)
        draws = Draws.of(batch, self._diffusion.steps, self.config, generator)
        mine = slice(self._rank, None, self._world)
        device = self.config.device
        loss = self._objective(batch.part(mine).to(device), draws.part(mine).to(device))
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        self._follow()
        return loss.detach()

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
        """Mean loss since the last call, over all processes, so that they stop together."""
        mean = torch.stack(self._losses).mean()
        if self._world > 1:
            distributed.all_reduce(mean)
        loss = float(mean) / self._world
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
        settings |= {"crops": len(self._crops), "architecture": self._checkpoint.config.architecture}
        return json.dumps(settings, sort_keys=True)

    def _save(self) -> None:
        """State for a continuation, written atomically."""
        tensors: State = {f"network.{n}": v.detach() for n, v in self._network.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self._average.items()}
        for index, parameter in enumerate(self._parameters):
            for name, value in self._optimizer.state[parameter].items():
                tensors[f"adam.{index}.{name}"] = value
        tensors["losses"] = torch.stack(self._losses) if self._losses else torch.zeros(0)
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
        self._average = {n: tensors[f"average.{n}"].to(self.config.device) for n in self._average}
        for index, parameter in enumerate(self._parameters):
            names = ("step", "exp_avg", "exp_avg_sq")
            state = {name: tensors[f"adam.{index}.{name}"].to(self.config.device) for name in names}
            self._optimizer.state[parameter] = state
        self._losses = list(tensors["losses"].to(self.config.device))
        self.step = int(metadata["step"])


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """torch on so many threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
