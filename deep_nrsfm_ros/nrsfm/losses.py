# SPDX-License-Identifier: Apache-2.0
"""What training minimises: "Loss function" of the paper, the cycle loss, and the layout's losses.

The losses of bone lengths, handedness and depth are in `layout_loss.py`.

The cycle loss needs no 3D label: a reconstructed shape, seen by another camera, must be
reconstructed as the same shape. It keeps the network from explaining half of the frames by a
mirrored depth.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from deep_nrsfm_ros.nrsfm.geometry import centre_visible, polar, spectral_norm
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.network import Network, forward
from deep_nrsfm_ros.nrsfm.normalisation import Normalised, Normaliser, normalise
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
    """The network's input of a batch, and the output that the losses compare with.

    Targets have the points last, as the network computes.
    """

    x: Tensor  # (b + c, p, 2) input: b frames, then c known shapes seen by random cameras
    W: Tensor  # (b, 2, p) target of M^T S of the frames, centred on the visible points
    mask: Tensor | None  # (b, 1, p), 1 visible, 0 missing; None: every point is visible
    T: Tensor | None = None  # (c, 3, p) the known shapes, centred: targets of S


def frobenius(X: Tensor) -> Tensor:
    """Return the Frobenius norm (b,) of X (b, p, d), with a finite gradient at zero."""
    return ((X * X).sum((-2, -1)) + 1e-12).sqrt()


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
        self,
        net: Network,
        batch: Batch,
        known: Tensor | None,
        generator: torch.Generator,
        cameras: Tensor | None = None,
    ) -> Task:
        """Return input and targets of a batch, and of known shapes (c, p, 3) by random cameras.

        Args and `generator` as in `__call__`; only the whitening of `net` is used. `cameras`
        (k, 2, 3) are M^T of the first k known shapes, in place of random ones.
        """
        b, points, mask = len(batch.points), batch.points, batch.mask
        complete = bool(mask.all())
        if complete:
            mask = mask[:1]  # serves all objects
        T = known.mT.contiguous() if known is not None and self.recipe.cycle else None
        if T is not None:
            M = _random_cameras(T, generator)
            if cameras is not None:
                M[: len(cameras)] = cameras
            points = torch.cat((points.mT, M @ T)).mT
            mask = mask if complete else torch.cat((mask, torch.ones_like(T[:, :1]).mT))
        visible = self._observe(net, Batch(points, mask), generator)
        unit = visible.unit.expand(len(points), 1, 1)
        if complete and not (self.recipe.added_noise or self.recipe.mask):
            W = visible.W[:b]  # the target is the input
        else:
            W = centre_visible((points[:b] - visible.origin[:b]) / unit[:b], mask[:b])
        return Task(
            visible.W * visible.gain,
            W.mT,
            None if complete else mask[:b].mT,
            None if T is None else T / unit[b:],
        )

    def losses(self, net: Network, task: Task, S: Tensor, M: Tensor) -> Losses:
        """Return the losses of the network's output S (b + c, p, 3) and M (b + c, 3, 2) of a task.

        Only the whitening and the architecture of `net` are used.
        """
        # In few operations and with the points last, as the network computes: on arrays this small
        # the number of operations is the time.
        b = len(task.W)
        frames, again = torch.split(S.mT, [b, len(S) - b])
        M = M[:b]
        difference = torch.baddbmm(task.W, M.mT, frames, beta=-1)  # M^T S - W, (b, 2, p)
        if task.mask is not None:
            difference = centre_visible(difference.mT, task.mask.mT).mT
        total = reprojection = self._relative_error(
            net, difference, task.W, centred=task.mask is not None
        )
        if net.architecture.camera == "free":
            total = total + self.recipe.spectral * spectral_norm(M.mT).mean()
        cycle = torch.zeros_like(reprojection)
        if task.T is not None:
            cycle = self._relative_error(net, again - task.T, task.T, centred=False)
            total = torch.add(total, cycle, alpha=self.recipe.cycle)
        if self.layout_loss:
            total = total + self.layout_loss(frames.mT, M)
        with torch.no_grad():
            shapes = torch.baddbmm(frames, M, difference, alpha=-1)
            shapes = (shapes - shapes.mean(-1, keepdim=True)).mT
        return Losses(reprojection, cycle, total, shapes)

    def _relative_error(
        self, net: Network, difference: Tensor, X: Tensor, *, centred: bool
    ) -> Tensor:
        """Return the mean of ||C difference|| / ||X||, both (b, d, p) and weighed.

        C subtracts the mean of all points, unless the difference is `centred` on the visible ones.
        """
        error, size = self._weighed_norm(net, difference, centred), self._weighed_norm(net, X, True)
        # A frame without an extent has no error either.
        return (error / size.clamp(min=1e-6)).mean()

    def _weighed_norm(self, net: Network, X: Tensor, centred: bool) -> Tensor:
        """Return ||L C X^T|| (b,), or ||C X^T||, for X (b, d, p); C as in `_relative_error`."""
        rows = X.reshape(-1, X.shape[-1])
        if self.whitened and net.architecture.whitening:
            rows = rows @ (net.L if centred else net.L - net.L.mean(0))
        elif not centred:
            rows = rows - rows.mean(-1, keepdim=True)
        norm: Tensor = torch.linalg.vector_norm(rows.reshape(len(X), -1), dim=1)
        return norm

    def _observe(self, net: Network, batch: Batch, generator: torch.Generator) -> Normalised:
        """Return the network's input, noisy and incomplete by the recipe.

        A mask (1, p, 1) serves all objects.
        """
        points, mask = batch
        device = points.device
        if self.recipe.added_noise:
            noise = torch.randn(points.shape, generator=generator, device=device)
            level = torch.rand(len(points), generator=generator, device=device)
            size = frobenius(centre_visible(points, mask)) / frobenius(noise)
            points = points + (self.recipe.added_noise * level * size)[:, None, None] * noise
        if self.recipe.mask:
            level = self.recipe.mask * torch.rand(
                (len(points), 1, 1), generator=generator, device=device
            )
            hidden = torch.rand((*points.shape[:2], 1), generator=generator, device=device) < level
            mask = mask * ~hidden
        return normalise(net, self.normaliser, points, mask)


def _random_cameras(like: Tensor, generator: torch.Generator) -> Tensor:
    """Return a uniformly random M^T (c, 2, 3) for each of c objects, on the device of `like`."""
    A = torch.randn(len(like), 2, 3, generator=generator, device=like.device)
    # NumPy needs half of torch's time for arrays this small.
    return torch.from_numpy(polar(A.numpy())) if A.device.type == "cpu" else polar(A)
