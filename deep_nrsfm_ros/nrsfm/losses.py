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
from deep_nrsfm_ros.nrsfm.network import Network, forward, whiten
from deep_nrsfm_ros.nrsfm.normaliser import Normaliser
from deep_nrsfm_ros.nrsfm.recipe import Recipe


class Losses(NamedTuple):
    """Terms of the training loss, means over a batch."""

    reprojection: Tensor
    cycle: Tensor
    total: Tensor


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

    def __call__(self, net: Network, frames: Frames, generator: torch.Generator) -> Losses:
        """Return the losses; all randomness comes from `generator`."""
        x, W, _ = self._observe(frames, generator)
        S, M = forward(net, x)
        W = visible_centre(W, frames.mask)
        residual = W - visible_centre(S @ M, frames.mask)
        reprojection = self._relative(net, residual, W)
        total = reprojection
        if net.architecture.camera == "free":
            total = total + self.recipe.spectral * spectral_norm(M.swapaxes(-1, -2)).mean()
        if not self.recipe.cycle:
            return Losses(reprojection, torch.zeros(()), total)
        cycle = self._cycle(net, S, M, residual, generator)
        return Losses(reprojection, cycle, total + self.recipe.cycle * cycle)

    def _cycle(
        self, net: Network, S: Tensor, M: Tensor, residual: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Return the relative error of S, back-projected, seen by a random camera and lifted."""
        with torch.no_grad():
            T = S + residual @ M.swapaxes(-1, -2)
            T = T - T.mean(-2, keepdim=True)
            Q = polar(torch.randn(len(T), 2, 3, generator=generator, device=T.device))
            seen = Frames(T @ Q.swapaxes(-1, -2), torch.ones_like(T[..., :1]))
            x, _, unit = self._observe(seen, generator)
            T = T / unit
        again, _ = forward(net, x)
        again = again - again.mean(-2, keepdim=True)
        return self._relative(net, again - T, T)

    def _relative(self, net: Network, error: Tensor, X: Tensor) -> Tensor:
        """Return the mean of ||error|| / ||X|| over a batch, both whitened."""
        if self.whitened:
            error, X = whiten(net, error), whiten(net, X)
        return (frobenius(error) / frobenius(X)).mean()

    def _observe(self, frames: Frames, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
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
        seen = self.normaliser.encode(points, mask)
        return seen.W * seen.gain, (frames.points - seen.origin) / seen.unit, seen.unit
