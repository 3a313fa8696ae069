"""What training minimises: "Loss function" of the paper, and the cycle loss.

The cycle loss needs no 3D label: a reconstructed shape, seen by another camera, must be
reconstructed as the same shape. It keeps the network from explaining half of the frames by a
mirrored depth.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from deep_nrsfm_ros.nrsfm.geometry import polar, spectral_norm
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.network import Network, forward
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser, normalise
from deep_nrsfm_ros.nrsfm.recipe import Recipe


class Losses(NamedTuple):
    """Terms of the training loss, means over a batch, and the shapes of the batch."""

    reprojection: Tensor
    cycle: Tensor
    total: Tensor
    shapes: Tensor  # (b, p, 3) centred and back-projected, without gradient


class Batch(NamedTuple):
    """Frames as tensors."""

    points: Tensor  # (b, p, 2), 0 where missing
    mask: Tensor  # (b, p, 1), 1 visible, 0 missing


class Task(NamedTuple):
    """The network's input of a batch, and the output that the losses compare with."""

    x: Tensor  # (b + c, p, 2) input: b frames, then c known shapes seen by random cameras
    W: Tensor  # (b, p, 2) target of S M of the frames, centred on the visible points
    mask: Tensor  # (b, p, 1)
    T: Tensor | None = None  # (c, p, 3) the known shapes, targets of S


def frobenius(X: Tensor) -> Tensor:
    """Return the Frobenius norm (b,) of X (b, p, d), with a finite gradient at zero."""
    return ((X * X).sum((-2, -1)) + 1e-12).sqrt()


def visible_centre(X: Tensor, mask: Tensor) -> Tensor:
    """Return X (b, p, d) less its mean over the visible points, and 0 where a point is missing."""
    return (X - visible_share(mask).mT @ X) * mask


def visible_share(mask: Tensor) -> Tensor:
    """Return the weights (b, p, 1) of the points in the mean over the visible ones."""
    return mask / mask.sum(-2, keepdim=True).clamp(min=1)


class Objective:
    """The loss of a network on a batch, with its augmentation and its random cameras."""

    def __init__(
        self,
        normaliser: Normaliser,
        recipe: Recipe,
        *,
        whitened: bool = True,
        layout_loss: LayoutLoss | None = None,
    ) -> None:
        """Set up the loss.

        Args:
            normaliser: of the network's input.
            recipe: weights of the losses and of the augmentation.
            whitened: weigh differences by the network's whitening; otherwise by plain distance.
            layout_loss: another term, of the shapes of the frames.
        """
        self.normaliser, self.recipe, self.whitened = normaliser, recipe, whitened
        self.layout_loss = layout_loss

    def __call__(
        self, net: Network, batch: Batch, known: Tensor | None, generator: torch.Generator
    ) -> Losses:
        """Return the losses of a network; autograd gets their gradient by its weights.

        Args:
            net: the network, of tensors.
            batch: the frames.
            known: (c, p, 3) shapes for the cycle loss, which an earlier call returned; without
                them the cycle loss is 0. One pass of the network serves both losses, in half the
                time of two.
            generator: source of all random numbers.
        """
        task = self.task(net, batch, known, generator)
        return self.losses(net, task, *forward(net, task.x))

    @torch.no_grad()
    def task(
        self, net: Network, batch: Batch, known: Tensor | None, generator: torch.Generator
    ) -> Task:
        """Return input and targets of a batch, and of known shapes (c, p, 3) by random cameras.

        Args and `generator` as in `__call__`; only the whitening of `net` is used.
        """
        if not self.recipe.cycle:
            known = None
        b = len(batch.points)
        if known is not None:
            Q = polar(torch.randn(len(known), 2, 3, generator=generator, device=known.device))
            replay = known @ Q.mT, torch.ones_like(known[..., :1])
            batch = Batch(*(torch.cat(pair) for pair in zip(batch, replay, strict=True)))
        x, W, unit = self._observe(net, batch, generator)
        mask = batch.mask[:b]
        T = None if known is None else known / unit[b:]
        return Task(x, visible_centre(W[:b], mask), mask, T)

    def losses(self, net: Network, task: Task, S: Tensor, M: Tensor) -> Losses:
        """Return the losses of the network's output S (b + c, p, 3) and M (b + c, 3, 2) of a task.

        Only the whitening and the architecture of `net` are used.
        """
        # In few operations and with the points last, as the network computes: on arrays this small
        # the number of operations is the time.
        b = len(task.W)
        frames, again = torch.split(S.mT, [b, len(S) - b])
        M, W = M[:b], task.W.mT
        projected = M.mT @ frames  # (b, 2, p)
        mean = projected @ visible_share(task.mask)
        residual = torch.addcmul(W, projected - mean, task.mask.mT, value=-1)
        total = reprojection = self._relative_error(net, residual, W)
        if net.architecture.camera == "free":
            total = total + self.recipe.spectral * spectral_norm(M.mT).mean()
        cycle = torch.zeros_like(reprojection)
        if task.T is not None:
            T = task.T.mT
            cycle = self._relative_error(net, again - again.mean(-1, keepdim=True) - T, T)
            total = total + self.recipe.cycle * cycle
        if self.layout_loss:
            total = total + self.layout_loss(frames.mT, M)
        with torch.no_grad():
            shapes = frames + M @ residual
            # Contiguous, as a checkpoint keeps it: the layout decides the last bit of a product.
            shapes = (shapes - shapes.mean(-1, keepdim=True)).mT.contiguous()
        return Losses(reprojection, cycle, total, shapes)

    def _relative_error(self, net: Network, difference: Tensor, X: Tensor) -> Tensor:
        """Return the mean of ||difference|| / ||X||, both (b, d, p) and weighed."""
        error, size = self._weighed_norm(net, difference), self._weighed_norm(net, X)
        # A frame without an extent has no error either.
        return (error / size.clamp(min=1e-6)).mean()

    def _weighed_norm(self, net: Network, X: Tensor) -> Tensor:
        """Return ||L X^T|| (b,), or ||X||, for X (b, d, p)."""
        rows = X.reshape(-1, X.shape[-1])
        if self.whitened and net.architecture.whitening:
            rows = rows @ net.L
        norm: Tensor = torch.linalg.vector_norm(rows.reshape(len(X), -1), dim=1)
        return norm

    def _observe(
        self, net: Network, batch: Batch, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the network's input, the target of its reprojection, and the unit (b, 1, 1).

        The input is noisy and incomplete by the recipe; the target is the frame itself.
        """
        points, mask = batch
        device = points.device
        if self.recipe.noise:
            noise = torch.randn(points.shape, generator=generator, device=device)
            level = torch.rand(len(points), generator=generator, device=device)
            size = frobenius(visible_centre(points, mask)) / frobenius(noise)
            points = points + (self.recipe.noise * level * size)[:, None, None] * noise
        if self.recipe.mask:
            level = self.recipe.mask * torch.rand(
                (len(points), 1, 1), generator=generator, device=device
            )
            mask = mask * (torch.rand(mask.shape, generator=generator, device=device) >= level)
        visible = normalise(net, self.normaliser, points, mask)
        return (
            visible.W * visible.gain,
            (batch.points - visible.origin) / visible.unit,
            visible.unit,
        )
