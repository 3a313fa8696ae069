"""The gradient of the loss, written out: torch's own bookkeeping costs more than the sums.

What follows runs the network's own layers and walks back through them, symbols as in the
package's legend; X_bar is the gradient of the loss by X. Options of the network that the default
recipe does not use take torch's own gradient.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from deep_nrsfm_ros.nrsfm.losses import Frames, Losses, Objective, Task
from deep_nrsfm_ros.nrsfm.network import (
    Network,
    decode,
    encode,
    recover,
    unwhiten,
    whiten,
)
from deep_nrsfm_ros.training.compiled_gradient import CompiledGradient, fits, torch_on_one_thread


class GradientFunction:
    """Losses of batches and their gradients, for one objective and one kind of network."""

    def __init__(self, objective: Objective, net: Network, batch: int) -> None:
        """Prepare for networks like `net` and batches of so many frames, or about."""
        self._objective = objective
        self._compiled = CompiledGradient(objective, net, batch) if fits(objective, net) else None

    def threads(self) -> AbstractContextManager[None]:
        """Return a context to take steps in, where torch has the threads that suit them."""
        return torch_on_one_thread() if self._compiled else nullcontext()

    def __call__(
        self, net: Network, frames: Frames, known: Tensor | None, generator: torch.Generator
    ) -> tuple[Losses, Tensor]:
        """Return the losses, as the objective does, and the gradient (n,) of their total.

        The gradient is by what the network has learned, in the order of `Network.learned`.
        """
        if not net.architecture.is_default_variant:
            return _by_torch(self._objective, net, frames, known, generator)
        with torch.inference_mode():
            task = self._objective.task(net, frames, known, generator)
            if self._compiled:
                return self._compiled(joined(weight for _, weight in net.trainable_weights()), task)
            return written_out(self._objective, net, task)


def written_out(objective: Objective, net: Network, task: Task) -> tuple[Losses, Tensor]:
    """Return the losses of an answer to a task and their gradient, as `GradientFunction` does."""
    Psi = encode(net, task.x)
    psi_n, M = recover(net, Psi[-1])
    S, psi = decode(net, psi_n)
    left = objective.differences(net, task, S, M)
    S_bar, M_bar = objective.gradient(net, task, S, M, left)
    D_bar, b__bar, psi_bar = _through_decoder(net, psi, S_bar)
    heads_bar, Psi_bar = _through_recovery(net, Psi[-1], M, psi_bar, M_bar)
    b_bar = _through_encoder(net, task.x, Psi, Psi_bar, D_bar)
    gradient = joined([*D_bar, *b_bar, *b__bar, *heads_bar])
    return objective.losses(net, S, M, left), gradient


def joined(parts: Iterable[Tensor]) -> Tensor:
    """Return weights, or gradients by them, as one vector."""
    return torch.cat([part.flatten() for part in parts])


def _by_torch(
    objective: Objective,
    net: Network,
    frames: Frames,
    known: Tensor | None,
    generator: torch.Generator,
) -> tuple[Losses, Tensor]:
    """Return what a `GradientFunction` does, by torch's autograd."""
    weights = {name: weight.detach() for name, weight in net.named_weights()}
    learned = [weights[name].requires_grad_() for name, _ in net.trainable_weights()]
    net = Network.from_named_weights(net.architecture, weights)
    losses = objective(net, frames, known, generator)
    bars = torch.autograd.grad(losses.total, learned, materialize_grads=True)
    return Losses(*(term.detach() for term in losses)), joined(bars)


def _through_decoder(
    net: Network, psi: list[Tensor], S_bar: Tensor
) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Return the gradients by D, by b' and by psi_n of one by S (b, p, 3)."""
    s_bar = unwhiten(net, S_bar).reshape(len(S_bar), -1)
    b__bar = [s_bar.sum(0).neg_().view(net.b_[0].shape)]
    D_bar = [(s_bar.T @ psi[0]).view(net.D[0].shape)]
    psi_bar = s_bar @ net.D[0].reshape(s_bar.shape[1], -1)
    for i, D in enumerate(net.D[1:]):
        psi_bar = _relu_gradient(psi_bar, psi[i])
        b__bar.append(psi_bar.sum(0).neg_())
        D_bar.append(psi_bar.T @ psi[i + 1])
        psi_bar = psi_bar @ D
    return D_bar, b__bar, psi_bar


def _through_recovery(
    net: Network, Psi: Tensor, M: Tensor, psi_bar: Tensor, M_bar: Tensor
) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Return the gradients by the heads and by Psi_n (b, 2, 3, k_n) of those by psi_n and M."""
    flat = Psi.reshape(len(Psi), -1)
    rows_bar = polar_gradient((Psi @ net.camera_head)[..., 0], M.mT, M_bar.mT)
    heads_bar = flat.T @ psi_bar, Psi.reshape(-1, Psi.shape[-1]).T @ rows_bar.reshape(-1, 1)
    Psi_bar = (psi_bar @ net.code_head.T).view(Psi.shape)
    return heads_bar, Psi_bar.addcmul_(rows_bar[..., None], net.camera_head[:, 0])


def _through_encoder(
    net: Network, W: Tensor, Psi: list[Tensor], Psi_bar: Tensor, D_bar: list[Tensor]
) -> list[Tensor]:
    """Add to the gradients by D, and return those by b, of one by Psi_n."""
    b_bar: list[Tensor] = []
    for i in reversed(range(len(Psi))):
        Psi_bar = _relu_gradient(Psi_bar, Psi[i])
        rows = Psi_bar.view(-1, Psi_bar.shape[-1])
        b_bar.insert(0, rows.sum(0).neg_())
        if i:
            D_bar[i].addmm_(Psi[i - 1].view(len(rows), -1).T, rows)
            Psi_bar = (rows @ net.D[i].T).view(Psi[i - 1].shape)
    W = whiten(net, W).mT.reshape(2 * len(W), -1)
    D_bar[0].view(net.p, -1).addmm_(W.T, Psi_bar.view(len(W), -1))
    return b_bar


def _relu_gradient(bar: Tensor, result: Tensor) -> Tensor:
    """Put 0 in `bar` where the result of a ReLU is none, and return it: faster than by a mask."""
    masked: Tensor = torch.ops.aten.threshold_backward.grad_input(bar, result, 0, grad_input=bar)
    return masked


def polar_gradient(A: Tensor, R: Tensor, R_bar: Tensor) -> Tensor:
    """Return the gradient by A (..., 2, 3) of one by its orthonormal factor R = `polar(A)`.

    With A = P R, P symmetric, a change of A turns the rows of R within their plane by
    (dA R^T - R dA^T) / tr P and moves them out of it by P^-1 dA (I - R^T R); this is its adjoint.
    """
    P, X = A @ R.mT, R_bar @ R.mT
    trace = (P[..., 0, 0] + P[..., 1, 1])[..., None, None]
    determinant = (P[..., 0, 0] * P[..., 1, 1] - P[..., 0, 1] * P[..., 1, 0])[..., None, None]
    # Where A has no camera in it, any finite gradient will do; see `polar`.
    determinant = determinant.maximum(1e-6 * trace**2 + 1e-30)
    within = (X - X.mT) @ R / trace.clamp(min=1e-15)
    out = R_bar - X @ R
    # P^-1 = (tr P - P) / det P for 2 x 2.
    return within + (trace * out - P @ out) / determinant
