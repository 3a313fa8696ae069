# SPDX-License-Identifier: Apache-2.0
"""The network of a training as one torch operation, compiled and on several threads.

Without a compiler, and for the networks that `supports` refuses, `nrsfm.network.forward` and
torch's autograd compute the same, some five times slower.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.kernel import _kernel
from deep_nrsfm_ros.nrsfm.network import Network

_BLOCK = 16  # frames computed at a time, so that their codes stay in the cache
_FEWEST_FRAMES = 8  # of a thread, since each thread also lays out all weights
_MOST_WEIGHTS = 2_000_000  # a block reads all of them; torch is faster beyond


def supports(net: Network) -> bool:
    """Return whether the kernel was compiled and has this network: its variant, dtype and size."""
    float32_on_cpu = net.L.device.type == "cpu" and net.L.dtype == torch.float32
    weights = sum(weight.numel() for _, weight in net.trainable_weights())
    return kernel.supports(net) and float32_on_cpu and weights <= _MOST_WEIGHTS


class CompiledNetwork:
    """`nrsfm.network.forward` as a differentiable function of the weight vector."""

    def __init__(self, net: Network, batch: int) -> None:
        """Prepare the threads.

        Args:
            net: gives the architecture and the whitening, which does not change.
            batch: frames of a typical call; the number of threads is that of torch, or less for
                few frames.
        """
        widths = net.architecture.widths
        threads = max(1, min(torch.get_num_threads(), batch // _FEWEST_FRAMES))
        header = [net.p, len(widths), bool(net.architecture.whitening), _BLOCK, threads, *widths]
        self.pool = _kernel.worker_pool(
            np.array(header, np.int32), _array(net.L), _array(net.L_inverse)
        )
        self.activations_per_frame = _kernel.activations_per_frame(self.pool)

    def __call__(self, weights: Tensor, W: Tensor) -> tuple[Tensor, Tensor]:
        """Return shape S and camera M of keypoints; autograd gets the gradient by the weights.

        Args:
            weights: (n,) what the network has learned, in the order of `Network.trainable_weights`.
            W: (b, p, 2) the network's input, of which there is no gradient.

        Returns:
            S (b, p, 3) and M (b, 3, 2).

        Raises:
            ValueError: the shapes are not those of the network.
            RuntimeError: another call is running.
        """
        S, M_T = NetworkFunction.apply(weights, W.mT, self)  # type: ignore[no-untyped-call]
        return S.mT, M_T.mT


class NetworkFunction(torch.autograd.Function):
    """The network's forward and backward pass; its shapes have the points last.

    The codes of a call are in a tensor that autograd keeps until the backward pass, so that calls
    do not disturb each other.
    """

    @staticmethod
    def forward(
        ctx: Any, weights: Tensor, W_T: Tensor, network: CompiledNetwork
    ) -> tuple[Tensor, Tensor]:
        """Return S (b, 3, p) and M^T (b, 2, 3) of W^T (b, 2, p)."""
        b, p = len(W_T), W_T.shape[-1]
        S, M_T = W_T.new_empty(b, 3, p), W_T.new_empty(b, 2, 3)
        activations = W_T.new_empty(b, network.activations_per_frame)
        arrays = (_array(tensor) for tensor in (weights, W_T, activations, S, M_T))
        _kernel.network_forward(network.pool, *arrays)
        ctx.network = network
        ctx.save_for_backward(weights, activations)
        return S, M_T

    @staticmethod
    def backward(ctx: Any, S_bar: Tensor, M_T_bar: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient (n,) by the weights."""
        weights, activations = ctx.saved_tensors
        gradient = torch.empty_like(weights)
        arrays = (_array(tensor) for tensor in (weights, activations, S_bar, M_T_bar, gradient))
        _kernel.network_backward(ctx.network.pool, *arrays)
        return gradient, None, None


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Leave the processors to the kernel's threads within the context.

    A thread of torch that has finished its part of an operation waits for the next one for
    milliseconds without sleeping.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _array(tensor: Tensor) -> NDArray[np.float32]:
    """Return the contiguous array of a tensor; it shares memory with a contiguous tensor."""
    array: NDArray[np.float32] = tensor.detach().contiguous().numpy()
    return array
