"""Several processes that train one model, as torchrun starts them; a process alone pays nothing.

Each has its shard of the frames and draws its share of every batch from it. Gradients are summed
after each step, so all processes have the same weights without ever sending them. What one
decides for all (to stop, that the time is up) is settled every few steps, at the same ones
everywhere. The first process alone reports and writes files.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from torch import Tensor

Value = TypeVar("Value")


class ProcessGroup:
    """The processes of a training; this one is alone, and all its word is the team's."""

    rank = 0
    size = 1
    settle_every = 1  # steps from one `agree` to the next

    def share(self, whole: int) -> int:
        """Return this process's part of `whole`; the parts of all add up to it."""
        return whole * (self.rank + 1) // self.size - whole * self.rank // self.size

    def shard(self, frames: Tensor) -> Tensor:
        """Return this process's frames of all: every n-th, so that each sees every recording."""
        return frames if self.size == 1 else frames[self.rank :: self.size].contiguous()

    def total(self, *tensors: Tensor) -> None:
        """Replace each tensor by its sum over the processes."""

    def mean(self, values: tuple[float, float]) -> tuple[float, float]:
        """Return the means over the processes."""
        return values

    def agree(self, stop: bool, time_gone: float) -> tuple[bool, float]:
        """Return whether anybody wants to stop, and the share of the time that is gone."""
        return stop, time_gone

    def tell(self, value: Value) -> Value:
        """Return what the first process passed."""
        return value

    def leave(self) -> None:
        """End the connection; the process is on its own from here."""


ALONE = ProcessGroup()


class _Torchrun(ProcessGroup):
    """A process of several."""

    settle_every = 16  # a stop can wait so long, and messages cost time

    def __init__(self) -> None:
        import torch
        import torch.distributed

        # Its functions keep, as their default, the group that there is when they are imported, at
        # the latest by torch.optim; its threads would outlive `leave`, and may abort the process.
        import torch.distributed.nn

        self._torch, self._group = torch, torch.distributed
        gpu = torch.cuda.is_available()
        if gpu:
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        self._device = torch.device("cuda" if gpu else "cpu")
        self._group.init_process_group("nccl" if gpu else "gloo")
        self.rank, self.size = self._group.get_rank(), self._group.get_world_size()

    def total(self, *tensors: Tensor) -> None:
        for tensor in tensors:
            self._group.all_reduce(tensor)

    def mean(self, values: tuple[float, float]) -> tuple[float, float]:
        first, second = self._reduced(values, self._group.ReduceOp.SUM)
        return first / self.size, second / self.size

    def agree(self, stop: bool, time_gone: float) -> tuple[bool, float]:
        anyone, latest = self._reduced((float(stop), time_gone), self._group.ReduceOp.MAX)
        return bool(anyone), latest

    def tell(self, value: Value) -> Value:
        held = [value]
        self._group.broadcast_object_list(held)
        return held[0]

    def leave(self) -> None:
        self._group.destroy_process_group()

    def _reduced(self, values: tuple[float, float], how: object) -> list[float]:
        tensor = self._torch.tensor(values, dtype=self._torch.float64, device=self._device)
        self._group.all_reduce(tensor, how)
        return [float(value) for value in tensor]


def rank() -> int:
    """Return which process of a team this will be, before it joins: 0 for the first, or alone."""
    return int(os.environ["RANK"]) if _started_by_torchrun() else 0


def join() -> ProcessGroup:
    """Return the team that torchrun has started this process for, or the process alone."""
    if _started_by_torchrun() and int(os.environ["WORLD_SIZE"]) > 1:
        return _Torchrun()
    return ALONE


def _started_by_torchrun() -> bool:
    """Tell torchrun from other launchers, whose variables look alike and mean something else."""
    return "TORCHELASTIC_RUN_ID" in os.environ
