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
from deep_nrsfm_ros.nrsfm.network import Network, forward, whiten
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser, normalise
from deep_nrsfm_ros.nrsfm.recipe import Recipe


class Losses(NamedTuple):
    """Terms of the training loss, means over a batch, and the shapes of the batch."""

    reprojection: Tensor
    cycle: Tensor
    total: Tensor
    shapes: Tensor  # (b, p, 3) centred and back-projected, without gradient


class Frames(NamedTuple):
    """A batch of frames as tensors."""

    points: Tensor  # (b, p, 2)
    mask: Tensor  # (b, p, 1), 1 visible, 0 missing


class Task(NamedTuple):
    """What a batch gives the network to see, and what it should make of it."""

    x: Tensor  # (b + c, p, 2) input: b frames, then c known shapes by random cameras
    W: Tensor  # (b, p, 2) what S M of the frames should be, centred on the visible points
    mask: Tensor  # (b, p, 1)
    T: Tensor | None = None  # (c, p, 3) the known shapes


class Relative(NamedTuple):
    """||E|| / ||X|| of each of a batch."""

    E: Tensor  # (b, p, d)
    error: Tensor  # (b,) ||E||_F
    size: Tensor  # (b,) ||X||_F

    def mean(self) -> Tensor:
        """Return the mean over the batch."""
        return (self.error / self.size).mean()

    def gradient(self) -> Tensor:
        """Return the gradient (b, p, d) of the mean by E."""
        return self.E / (len(self.E) * self.error * self.size)[:, None, None]


class Differences(NamedTuple):
    """What a reconstruction of a batch leaves, before it becomes numbers."""

    residual: Tensor  # (b, p, 2) of the reprojection, over the visible points
    reprojection: Relative
    cycle: Relative | None


def frobenius(X: Tensor) -> Tensor:
    """Return the Frobenius norm (b,) of X (b, p, d), with a finite gradient at zero."""
    return ((X * X).sum((-2, -1)) + 1e-12).sqrt()


def visible_centre(X: Tensor, mask: Tensor) -> Tensor:
    """Return C X for C = diag(mask)(I - 1 mask^T / visible points), X (b, p, d).

    C is symmetric, so a gradient goes back through it the same way.
    """
    mean = (X * mask).sum(-2, keepdim=True) / mask.sum(-2, keepdim=True).clamp(min=1)
    return (X - mean) * mask


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
        """Take what the loss depends on besides network and data.

        Differences are weighed by the network's whitening, or by plain distance if not `whitened`.
        `layout_loss` is a term of its own, of the shapes of the frames.
        """
        self.normaliser, self.recipe, self.whitened = normaliser, recipe, whitened
        self.layout_loss = layout_loss

    def __call__(
        self, net: Network, frames: Frames, known: Tensor | None, generator: torch.Generator
    ) -> Losses:
        """Return the losses; all randomness comes from `generator`.

        The cycle loss is that of the shapes `known` (c, p, 3), which an earlier call returned: so
        one pass of the network serves both losses, and takes half the time of two. It is 0 for
        None.
        """
        task = self.task(net, frames, known, generator)
        S, M = forward(net, task.x)
        return self.losses(net, S, M, self.differences(net, task, S, M))

    @torch.no_grad()
    def task(
        self, net: Network, frames: Frames, known: Tensor | None, generator: torch.Generator
    ) -> Task:
        """Return what the batch, and the shapes `known` by random cameras, ask of the network."""
        if not self.recipe.cycle:
            known = None
        b = len(frames.points)
        if known is not None:
            Q = polar(torch.randn(len(known), 2, 3, generator=generator, device=known.device))
            replay = known @ Q.mT, torch.ones_like(known[..., :1])
            frames = Frames(*(torch.cat(pair) for pair in zip(frames, replay, strict=True)))
        x, W, unit = self._observe(net, frames, generator)
        mask = frames.mask[:b]
        T = None if known is None else known / unit[b:]
        return Task(x, visible_centre(W[:b], mask), mask, T)

    def differences(self, net: Network, task: Task, S: Tensor, M: Tensor) -> Differences:
        """Return what S (b + c, p, 3) and M (b + c, 3, 2), the answer to a task, leave."""
        b = len(task.W)
        residual = task.W - visible_centre(S[:b] @ M[:b], task.mask)
        cycle = None
        if task.T is not None:
            again = S[b:]
            cycle = self._relative(net, again - again.mean(-2, keepdim=True) - task.T, task.T)
        return Differences(residual, self._relative(net, residual, task.W), cycle)

    def losses(self, net: Network, S: Tensor, M: Tensor, left: Differences) -> Losses:
        """Return the losses of what the answer S, M to a task has left."""
        M = M[: len(left.residual)]
        total = reprojection = left.reprojection.mean()
        if net.architecture.camera == "free":
            total = total + self.recipe.spectral * spectral_norm(M.mT).mean()
        cycle = torch.zeros_like(reprojection)
        if left.cycle is not None:
            cycle = left.cycle.mean()
            total = total + self.recipe.cycle * cycle
        if self.layout_loss:
            total = total + self.layout_loss(S[: len(M)], M)
        with torch.no_grad():
            shapes = S[: len(M)] + left.residual @ M.mT
            # Contiguous, as a checkpoint keeps it: the layout decides the last bit of a product.
            shapes = (shapes - shapes.mean(-2, keepdim=True)).contiguous()
        return Losses(reprojection, cycle, total, shapes)

    def gradient(
        self, net: Network, task: Task, S: Tensor, M: Tensor, left: Differences
    ) -> tuple[Tensor, Tensor]:
        """Return the gradients by S and by an orthonormal M of the total of `losses`."""
        b = len(task.W)
        S_bar, M_bar = torch.zeros_like(S), torch.zeros_like(M)
        residual_bar = self._weighed(net, left.reprojection.gradient())
        P_bar = visible_centre(residual_bar, task.mask).neg_()
        torch.matmul(P_bar, M[:b].mT, out=S_bar[:b])
        torch.matmul(S[:b].mT, P_bar, out=M_bar[:b])
        if self.layout_loss:
            S_bar[:b] += self.layout_loss.gradient(S[:b], M[:b])
        if left.cycle is not None:
            again_bar = self._weighed(net, self.recipe.cycle * left.cycle.gradient())
            torch.sub(again_bar, again_bar.mean(-2, keepdim=True), out=S_bar[b:])
        return S_bar, M_bar

    def _relative(self, net: Network, error: Tensor, X: Tensor) -> Relative:
        E = self._weighed(net, error)
        return Relative(E, frobenius(E), frobenius(self._weighed(net, X)))

    def _weighed(self, net: Network, X: Tensor) -> Tensor:
        """Return L X, or X; L is symmetric, so a gradient goes back through it the same way."""
        weighed: Tensor = whiten(net, X) if self.whitened else X
        return weighed

    def _observe(
        self, net: Network, frames: Frames, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the network's input, what it should reproject to, and the unit (b, 1, 1).

        The input is noisy and incomplete by the recipe; the target is the frame itself.
        """
        points, mask = frames
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
        seen = normalise(net, self.normaliser, points, mask)
        return seen.W * seen.gain, (frames.points - seen.origin) / seen.unit, seen.unit
