"""Training by several processes at once, as `torchrun` starts them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import distributed


@contextmanager
def joined(device: str) -> Iterator[tuple[int, str]]:
    """Inside the block the processes that torchrun started train together: (rank, device of this one).

    device: `cpu`, or `cuda` for one card a process. Started in any other way, a process is alone, with rank 0.
    """
    if "LOCAL_RANK" not in os.environ:
        yield 0, device
        return
    if device.startswith("cuda"):
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(device)
    distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield distributed.get_rank(), device
        distributed.barrier()  # nobody leaves while another may still hear from it
    finally:
        distributed.destroy_process_group()
