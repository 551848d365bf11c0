"""Training: the objective, averaged weights, candidates, exact continuation; on one process or several."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Iterator
from collections.abc import Sequence as Many
from contextlib import contextmanager
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed
from torch.nn.parallel import DistributedDataParallel

from model.architectures import build_network
from model.blinks import independent_blinks
from model.checkpoint import Checkpoint, State, read_tensors, serialize
from model.dataset import Batch, Crops, Sequence
from model.diffusion import Diffusion, Progress
from model.errors import ModelError
from model.files import write_bytes
from model.objective import Draws, Gradient, Objective, coefficient_weights, gradient_of
from model.training_config import TrainingConfig, available_device, settled
from model.training_log import TrainingLog

STATE_FILE = "state.safetensors"
LOG_FILE = "log.csv"
# Training stops at this many times what noise as large as the motion costs. Predicting the mean costs much less, since
# motion changes slowly: of the demo's talker 1.7, where noise costs 21.
DIVERGED = 3.0


class TrainingDivergedError(ModelError):
    """The loss became infinite or rose far above what predicting the mean costs."""


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
        self._device = available_device(self.config.device)
        opened, blinks = independent_blinks(checkpoint, sequences, self.config.seed)
        standardization = checkpoint.standardization
        self._crops = Crops(opened, standardization, self.config.frames, self._device, blinks)
        scale, spread = map(torch.from_numpy, (standardization.scale, standardization.spread))
        weights = coefficient_weights(scale, spread, self.config.metric_power)
        self._diffusion: Diffusion = checkpoint.diffusion().to(self._device)
        self._network = build_network(checkpoint.config)
        self._network.load_state_dict(checkpoint.network)
        objective = Objective(self._network, self._diffusion, weights, self.config)
        objective.to(self._device)
        self._gradient: Gradient = gradient_of(objective, self.config.threads)
        self._rank, self._world = (0, 1)
        if distributed.is_initialized():
            self._rank, self._world = distributed.get_rank(), distributed.get_world_size()
            self._gradient = _averaged(DistributedDataParallel(objective))
        # In the network's own order, which a loaded file does not keep: the average follows tensor by tensor.
        self._average = {name: value.clone() for name, value in self._network.state_dict().items()}
        self._parameters = list(self._network.parameters())
        self._optimizer = torch.optim.AdamW(
            self._parameters,
            lr=self.config.learning_rate,
            weight_decay=self.config.weight_decay,
            fused=True,
        )
        # What a subject's model forgets of the subject's motion, it falls back to the base model's for.
        own = self._network.moving_parameters() if checkpoint.kind == "subject" else []
        self._moving: list[Tensor] = list(own)
        self._start = [parameter.detach().clone() for parameter in own]
        self.step = 0
        self._losses: list[Tensor] = []
        self._begun_with = _digest(checkpoint, opened)
        if (self.folder / STATE_FILE).exists():
            self._restore()

    def train(self, progress: Progress | None = None) -> list[Path]:
        """Run to the end; the paths of the candidates, oldest first.

        Raises TrainingDivergedError, naming the iteration; the candidates up to then stay.
        """
        saved = time.monotonic()
        # Of several processes only the first writes.
        log_file = self.folder / LOG_FILE if self._rank == 0 else None
        with _one_thread(), TrainingLog(log_file, self.step, self._tensorboard) as log:
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
        processes each draws all of it and takes its share: where their number divides the batch, their mean gradient
        is the whole batch's.
        """
        generator = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.step)
        batch = self._crops.draw(self.config.batch, generator)
        draws = Draws.of(batch, self._diffusion.steps, self.config, generator)
        mine = slice(self._rank, None, self._world)
        loss = self._gradient(batch.part(mine), draws.part(mine).to(self._device))
        self._optimizer.step()
        self._return()
        self._follow()
        return loss

    @torch.no_grad()
    def _return(self) -> None:
        """What makes the optimizer's decay, which leads to zero, lead a subject's motion to the anchor."""
        if self._moving:
            decay = self.config.weight_decay * self.config.learning_rate
            torch._foreach_add_(self._moving, self._start, alpha=decay * self.config.anchor)

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
        # What a residual costs that is as large as the motion and another in each frame, without any course in time.
        noise = 1 + 2 * self.config.velocity
        if not math.isfinite(loss) or loss > DIVERGED * noise:
            raise TrainingDivergedError(
                f"training diverged at iteration {self.step} (loss {loss:.3g}): the data holds outliers or is"
                " too short"
            )
        return loss

    def _candidate_steps(self) -> list[int]:
        count = min(self.config.candidates, self.config.iterations)
        return [round(self.config.iterations * (i + 1) / count) for i in range(count)]

    def _candidate(self, step: int) -> Path:
        return self.folder / f"candidate_{step:08d}.safetensors"

    def _settings(self) -> str:
        """What must agree for a continuation to be the same training: all but where it is saved, logged, run.

        Of several cards each process has its own.
        """
        settings = asdict(self.config) | {"device": torch.device(self.config.device).type}
        for name in ("threads", "save_seconds", "log_every"):
            del settings[name]
        settings |= {"architecture": self._checkpoint.config.architecture, "begun_with": self._begun_with}
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
        write_bytes(self.folder / STATE_FILE, serialize(tensors, metadata))

    def _restore(self) -> None:
        path = self.folder / STATE_FILE
        try:
            tensors, metadata = read_tensors(path)
        except ModelError as error:
            raise ModelError(f"{error}: remove its folder to train anew") from error
        if metadata.get("settings") != self._settings():
            raise ModelError(
                f"{path} belongs to a training with other settings, data or start, or on another kind of processor;"
                " remove its folder to start anew"
            )
        self._network.load_state_dict({n: tensors[f"network.{n}"] for n in self._network.state_dict()})
        self._average = {n: tensors[f"average.{n}"].to(self._device) for n in self._average}
        for index, parameter in enumerate(self._parameters):
            names = ("step", "exp_avg", "exp_avg_sq")
            state = {name: tensors[f"adam.{index}.{name}"].to(self._device) for name in names}
            self._optimizer.state[parameter] = state
        self._losses = list(tensors["losses"].to(self._device))
        self.step = int(metadata["step"])


def _digest(checkpoint: Checkpoint, sequences: Many[Sequence]) -> str:
    """sha256 of the weights at the start and of all that is learned from."""
    digest = hashlib.sha256()
    weights = (value.numpy() for value in checkpoint.network.values())
    learned = ((s.coefficients, s.features, s.valid, np.asarray(s.style)) for s in sequences)
    for values in chain(weights, asdict(checkpoint.standardization).values(), *learned):
        digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()


def _averaged(objective: DistributedDataParallel) -> Gradient:
    """Loss of this process's share of a batch; the gradients become the mean of all processes'."""

    def gradient(batch: Batch, draws: Draws) -> Tensor:
        objective.zero_grad()
        loss: Tensor = objective(batch, draws)
        loss.backward()
        return loss.detach()

    return gradient


@contextmanager
def _one_thread() -> Iterator[None]:
    """Within torch's own operations, inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
