"""The losses of a batch and their gradient as one compiled call: `kernel/`, as in `compiled`.

Without it, and for what it does not know, `gradient` does the same some three times slower.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deep_nrsfm_ros.kernel import _kernel, supports
from deep_nrsfm_ros.nrsfm.losses import Losses, Objective, Task
from deep_nrsfm_ros.nrsfm.network import Network

_FRAMES_AT_A_TIME = 16  # so that their codes stay in the cache
_LEAST_SHARE = 8  # frames of a thread: it also lays out all weights
_MOST_WEIGHTS = 2_000_000  # that are read anew for every few frames; torch is faster beyond


def fits(objective: Objective, net: Network) -> bool:
    """Tell whether there is a kernel, and it knows this loss and this network."""
    known = supports(net) and net.L.device.type == "cpu" and net.L.dtype == torch.float32
    small = sum(weight.numel() for _, weight in net.trainable_weights()) <= _MOST_WEIGHTS
    return known and small and objective.whitened and not objective.layout_loss


class CompiledGradient:
    """The losses of one kind of network and their gradient, shared out to the threads of torch."""

    def __init__(self, objective: Objective, net: Network, batch: int) -> None:
        """Prepare for networks like `net` and batches of so many frames, or about."""
        self._cycle, widths = objective.recipe.cycle, net.architecture.widths
        threads = max(1, min(torch.get_num_threads(), batch // _LEAST_SHARE))
        header = [net.p, len(widths), bool(net.architecture.whitening), _FRAMES_AT_A_TIME, threads]
        self._workers = _kernel.workers(
            np.array([*header, *widths], np.int32), *_arrays(net.L, net.L_inverse)
        )

    def __call__(self, weights: Tensor, task: Task) -> tuple[Losses, Tensor]:
        """Return the losses of an answer to the task, and the gradient (n,) of their total.

        weights: (n,) all that the network has learned, in the order of `Network.learned`.
        """
        losses = np.empty(2)
        shapes, gradient = torch.empty((*task.W.shape[:2], 3)), torch.empty_like(weights)
        T = torch.empty(0) if task.T is None else task.T
        given = _arrays(weights, task.x, task.W, task.mask, T)
        found = losses, *_arrays(shapes, gradient)
        _kernel.gradient(self._workers, self._cycle, *given, *found)
        reprojection, cycle = torch.from_numpy(losses).float()
        return Losses(reprojection, cycle, reprojection + self._cycle * cycle, shapes), gradient


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Leave the processors to the kernel's threads for a while.

    Those of torch go on asking for work for milliseconds after each operation that they share.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _arrays(*tensors: Tensor) -> list[NDArray[np.float32]]:
    return [tensor.contiguous().numpy() for tensor in tensors]
