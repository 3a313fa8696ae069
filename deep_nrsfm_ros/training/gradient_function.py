# SPDX-License-Identifier: Apache-2.0
"""The gradient of a training's loss by the weight vector."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from deep_nrsfm_ros.nrsfm.losses import Batch, Losses, Objective
from deep_nrsfm_ros.nrsfm.network import Network, forward
from deep_nrsfm_ros.training.compiled_network import (
    CompiledNetwork,
    supports,
    torch_on_one_thread,
)


class GradientFunction:
    """The losses of batches and their gradient, for one objective and one kind of network.

    The losses are torch's; the network is compiled where the kernel supports it, and torch's
    otherwise.
    """

    def __init__(self, objective: Objective, net: Network, batch: int) -> None:
        """Prepare for the architecture and the whitening of `net` and `batch` frames a call."""
        self._objective, self._net = objective, net
        self._compiled = CompiledNetwork(net, batch) if supports(net) else None

    @property
    def compiled(self) -> bool:
        """Return whether the network is compiled."""
        return self._compiled is not None

    def threads(self) -> AbstractContextManager[None]:
        """Return a context for steps, in which torch has the number of threads that suits them."""
        return torch_on_one_thread() if self._compiled else nullcontext()

    def __call__(
        self,
        weights: Tensor,
        batch: Batch,
        known: Tensor | None,
        generator: torch.Generator,
        cameras: Tensor | None = None,
    ) -> tuple[Losses, Tensor]:
        """Return the losses of `Objective` and the gradient of their total.

        Args:
            weights: (n,) what the network has learned, in the order of `Network.trainable_weights`.
            batch: the frames.
            known: (c, p, 3) shapes of an earlier call for the cycle loss, or None.
            generator: source of all random numbers.
            cameras: (k, 2, 3) M^T of the first k known shapes, in place of random ones.

        Returns:
            The losses, detached, and the gradient (n,) by the weights.
        """
        task = self._objective.task(self._net, batch, known, generator, cameras)
        weights = weights.detach().requires_grad_()
        S, M = self._network(weights, task.x)
        losses = self._objective.losses(self._net, task, S, M)
        (gradient,) = torch.autograd.grad(losses.total, weights)
        return Losses(*(term.detach() for term in losses)), gradient

    def _network(self, weights: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        if self._compiled:
            return self._compiled(weights, x)
        return forward(with_weights(self._net, weights), x)


def weight_vector(net: Network) -> Tensor:
    """Return a copy (n,) of all `Network.trainable_weights`, one after the other."""
    return torch.cat([weight.flatten() for _, weight in net.trainable_weights()])


def with_weights(net: Network, weights: Tensor) -> Network:
    """Return the network with learned weights that are views of a vector (n,)."""
    learned = dict(net.trainable_weights())
    parts = torch.split(weights, [weight.numel() for weight in learned.values()])
    views = (part.view(w.shape) for part, w in zip(parts, learned.values(), strict=True))
    named = dict(net.named_weights()) | dict(zip(learned, views, strict=True))
    return Network.from_named_weights(net.architecture, named)
