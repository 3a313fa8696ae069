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
from deep_nrsfm_ros.nrsfm.gradient import differentiable
from deep_nrsfm_ros.nrsfm.network import Network, whiten
from deep_nrsfm_ros.nrsfm.normaliser import Normaliser, observe
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


def frobenius(X: Tensor) -> Tensor:
    """Return the Frobenius norm (b,) of X (b, p, d), with a finite gradient at zero."""
    return ((X * X).sum((-2, -1)) + 1e-12).sqrt()


def visible_centre(X: Tensor, mask: Tensor) -> Tensor:
    """Return C X for C = diag(mask)(I - 1 mask^T / visible points), X (b, p, d)."""
    mean = (X * mask).sum(-2, keepdim=True) / mask.sum(-2, keepdim=True).clamp(min=1)
    return (X - mean) * mask


class Objective:
    """The loss of a network on a batch, with its augmentation and its random cameras."""

    def __init__(self, normaliser: Normaliser, recipe: Recipe, *, whitened: bool = True) -> None:
        """Take what the loss depends on besides network and data.

        Differences are weighed by the network's whitening, or by plain distance if not `whitened`.
        """
        self.normaliser, self.recipe, self.whitened = normaliser, recipe, whitened

    def __call__(
        self, net: Network, frames: Frames, known: Tensor | None, generator: torch.Generator
    ) -> Losses:
        """Return the losses; all randomness comes from `generator`.

        The cycle loss is that of the shapes `known` (c, p, 3), which an earlier call returned: so
        one pass of the network serves both losses, and takes half the time of two. It is 0 for
        None.
        """
        if not self.recipe.cycle:
            known = None
        b = len(frames.points)
        if known is not None:
            Q = polar(torch.randn(len(known), 2, 3, generator=generator, device=known.device))
            replay = known @ Q.mT, torch.ones_like(known[..., :1])
            frames = Frames(*(torch.cat(pair) for pair in zip(frames, replay, strict=True)))
        x, W, unit = self._observe(net, frames, generator)
        S, M = differentiable(net, x)
        S, again, M, W, mask = S[:b], S[b:], M[:b], W[:b], frames.mask[:b]
        W = visible_centre(W, mask)
        residual = W - visible_centre(S @ M, mask)
        total = reprojection = self._relative(net, residual, W)
        if net.architecture.camera == "free":
            total = total + self.recipe.spectral * spectral_norm(M.mT).mean()
        cycle = torch.zeros_like(reprojection)
        if known is not None:
            T = known / unit[b:]
            cycle = self._relative(net, again - again.mean(-2, keepdim=True) - T, T)
            total = total + self.recipe.cycle * cycle
        with torch.no_grad():
            shapes = S + residual @ M.mT
            # Contiguous, as a checkpoint keeps it: the layout decides the last bit of a product.
            shapes = (shapes - shapes.mean(-2, keepdim=True)).contiguous()
        return Losses(reprojection, cycle, total, shapes)

    def _relative(self, net: Network, error: Tensor, X: Tensor) -> Tensor:
        """Return the mean of ||error|| / ||X|| over a batch, both whitened."""
        if self.whitened:
            error, X = whiten(net, error), whiten(net, X)
        return (frobenius(error) / frobenius(X)).mean()

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
        seen = observe(net, self.normaliser, points, mask)
        return seen.W * seen.gain, (frames.points - seen.origin) / seen.unit, seen.unit
