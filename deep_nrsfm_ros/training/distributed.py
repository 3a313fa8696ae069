# SPDX-License-Identifier: Apache-2.0
"""Several processes that train one model, as torchrun starts them; one process alone pays nothing.

Each process reads its share of bags and files, or takes its shard of frames that all of them have,
and draws its share of every batch from it. Gradients are
summed after each step, so all processes have the same weights without sending them. Decisions for
all, to stop or that the time is up, are made every few steps, at the same steps everywhere. Only
the first process reports and writes files.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeVar

from deep_nrsfm_ros.data.share import WHOLE_SHARE, Share

if TYPE_CHECKING:
    from torch import Tensor

Value = TypeVar("Value")


class ProcessGroup:
    """The processes of a training; this class is the group of one process.

    Attributes:
        rank: index of this process, 0 = first.
        size: number of processes.
        stop_interval: steps from one `any_stop` to the next.
    """

    rank = 0
    size = 1
    stop_interval = 1

    def share(self, n: int) -> int:
        """Return this process's part of n items; the parts of all processes sum to n."""
        return n * (self.rank + 1) // self.size - n * self.rank // self.size

    def shard(self, frames: Tensor) -> Tensor:
        """Return this process's frames: every `size`-th, so that it has some of each recording."""
        return frames if self.size == 1 else frames[self.rank :: self.size].contiguous()

    def sum_in_place(self, *tensors: Tensor) -> None:
        """Replace each tensor by its sum over the processes."""

    def mean(self, values: tuple[float, float]) -> tuple[float, float]:
        """Return the means over the processes."""
        return values

    def any_stop(self, stop: bool, time_fraction: float) -> tuple[bool, float]:
        """Return whether any process wants to stop, and the largest fraction of time elapsed."""
        return stop, time_fraction

    def broadcast(self, value: Value) -> Value:
        """Return the value of the first process."""
        return value

    def close(self) -> None:
        """Close the connection to the other processes."""


ALONE = ProcessGroup()


class _TorchrunGroup(ProcessGroup):
    """Several processes that torchrun has started."""

    stop_interval = 16  # each decision costs a message, and a stop may wait for so many steps

    def __init__(self) -> None:
        import torch
        import torch.distributed

        # Its functions keep the group that exists when they are imported, at the latest by
        # torch.optim, as a default argument: imported later, its threads would outlive `close`
        # and might abort the process.
        import torch.distributed.nn

        self._torch, self._group = torch, torch.distributed
        gpu = torch.cuda.is_available()
        if gpu:
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        self._device = torch.device("cuda" if gpu else "cpu")
        self._group.init_process_group("nccl" if gpu else "gloo")
        self.rank, self.size = self._group.get_rank(), self._group.get_world_size()

    def sum_in_place(self, *tensors: Tensor) -> None:
        for tensor in tensors:
            self._group.all_reduce(tensor)

    def mean(self, values: tuple[float, float]) -> tuple[float, float]:
        first, second = self._reduced(values, self._group.ReduceOp.SUM)
        return first / self.size, second / self.size

    def any_stop(self, stop: bool, time_fraction: float) -> tuple[bool, float]:
        any_stop, latest = self._reduced((float(stop), time_fraction), self._group.ReduceOp.MAX)
        return bool(any_stop), latest

    def broadcast(self, value: Value) -> Value:
        values = [value]
        self._group.broadcast_object_list(values)
        return values[0]

    def close(self) -> None:
        self._group.destroy_process_group()

    def _reduced(self, values: tuple[float, float], operation: object) -> list[float]:
        tensor = self._torch.tensor(values, dtype=self._torch.float64, device=self._device)
        self._group.all_reduce(tensor, operation)
        return [float(value) for value in tensor]


def own_share() -> Share:
    """Return the share of the data that this process reads: all of it, unless there are several."""
    return Share(rank(), int(os.environ["WORLD_SIZE"])) if _started_by_torchrun() else WHOLE_SHARE


def rank() -> int:
    """Return the rank that this process will have in its group, 0 for the first or only one."""
    return int(os.environ["RANK"]) if _started_by_torchrun() else 0


def join() -> ProcessGroup:
    """Return the group that torchrun has started this process for, or the group of one."""
    if _started_by_torchrun() and int(os.environ["WORLD_SIZE"]) > 1:
        return _TorchrunGroup()
    return ALONE


def _started_by_torchrun() -> bool:
    """Return whether torchrun started this process.

    Other launchers set variables of the same names with another meaning.
    """
    return "TORCHELASTIC_RUN_ID" in os.environ
