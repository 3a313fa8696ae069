# SPDX-License-Identifier: Apache-2.0
"""Losses of bone lengths, handedness and depth, from the edges and corners of a keypoint layout.

Not of the paper, and without 3D labels: a layout file gives edges and handedness in words. Views
from one side only contain little about depth: the direction of each limb, and the depth of
keypoints that hardly move, are then a matter of chance without this loss
(`recipe.LayoutLossWeights`).
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights

_FRONT_MARGIN = 0.1
"""Least height of a front keypoint over its plane, in RMS radii: at 0 it would lie in the plane."""
_SYMMETRY_WEIGHT = 4.0
"""Turns ((l - r) / (l + r))^2 of left and right into ((l - r) / mean)^2."""


class LayoutLoss:
    """The weighted sum of the terms, of shapes in the network's axes.

    Attributes:
        weights: of the terms; at least one is not zero.
    """

    def __init__(
        self, weights: LayoutLossWeights, layout: KeypointLayout, *, mirrored_axes: bool = False
    ) -> None:
        """Take edges, their partners on the other side and the handedness from the layout.

        Args:
            weights: of the terms.
            layout: of the shapes.
            mirrored_axes: whether the network's axes are a reflection of the object's, as they may
                be in a model that a training starts from.

        Raises:
            ValueError: a weight is set, and the layout has nothing for its term.
        """
        weights.check(layout)
        self.weights = weights
        self._side = -1.0 if mirrored_axes else 1.0  # of the plane on which the front belongs
        p, edges = len(layout), layout.edge_indices()
        partners = layout.partners() or range(p)
        places = {frozenset(edge): i for i, edge in enumerate(edges)}
        other = [
            places.get(frozenset((partners[a], partners[b])), i) for i, (a, b) in enumerate(edges)
        ]
        # Differences of keypoints are products with matrices: torch gathers rows more slowly, and
        # far more slowly in the backward pass.
        self._edges = _differences(p, edges)
        one = np.eye(len(edges), dtype=np.float32)
        self._partners = torch.from_numpy(np.concatenate([one - one[other], one + one[other]]))
        corners = [[layout.index(name) for name in four] for four in layout.handedness]
        self._corners = _differences(p, [(four[i], four[1]) for i in (0, 2, 3) for four in corners])

    def __call__(self, S: Tensor, M: Tensor) -> Tensor:
        """Return the loss of shapes S (b, p, 3) seen by cameras M (b, 3, 2).

        It has a gradient by S alone.
        """
        weights, losses = self.weights, []
        if weights.bone_length_weight:
            variation = _BoneVariation.apply(  # type: ignore[no-untyped-call]
                S, self._edges.to(S), self._partners.to(S)
            )
            losses.append(weights.bone_length_weight * variation)
        if weights.handedness_weight:
            losses.append(weights.handedness_weight * self._front(S))
        if weights.depth_penalty:
            losses.append(weights.depth_penalty * self._depth(S, M.detach()))
        loss: Tensor = functools.reduce(torch.add, losses)
        return loss

    def _front(self, S: Tensor) -> Tensor:
        """Return by how much keypoints fail to be in front, in RMS radii; `handedness.votes`."""
        left, up, front = _product(S, self._corners).chunk(3, -1)  # (b, 3, votes), from the right
        normal = torch.linalg.cross(left, up, dim=1)
        heights = self._side * (front * normal).sum(1) / normal.norm(dim=1).clamp(min=1e-6)
        X = S - S.mean(1, keepdim=True)
        radius = (X * X).sum(-1).mean(1, keepdim=True).add(1e-12).sqrt()
        return torch.relu(_FRONT_MARGIN - heights / radius).mean()

    @staticmethod
    def _depth(S: Tensor, M: Tensor) -> Tensor:
        """Return the extent in depth over the extent in the image, squares."""
        X = S - S.mean(1, keepdim=True)
        projected = X @ M
        depth = X - projected @ M.mT
        image = (projected * projected).sum((1, 2)).clamp(min=1e-9)
        return ((depth * depth).sum((1, 2)) / image).mean()


class _BoneVariation(torch.autograd.Function):
    """The squared coefficient of variation of the relative edge lengths in the batch.

    A mean over the edges; the squared asymmetry of left and right is added. Its gradient is written
    out, in half of the operations that autograd takes: on arrays this small they are the time.
    """

    @staticmethod
    def forward(ctx: Any, S: Tensor, edges: Tensor, partners: Tensor) -> Tensor:
        """Return the loss of shapes S (b, p, 3).

        Args:
            ctx: keeps what `backward` needs.
            S: the shapes.
            edges: (p, e); the product with rows of p numbers is their differences.
            partners: (2 e, e); the product with e numbers is their differences from those of the
                other side, and the sums.
        """
        bones = _product(S, edges)
        x, y, z = bones.unbind(1)
        lengths = torch.addcmul(torch.addcmul(x * x, y, y), z, z).add_(1e-10).sqrt_()  # (b, e)
        total = lengths.sum(1, keepdim=True)
        shares = lengths / total
        mean = shares.mean(0)
        deviation = shares - mean
        relative_variance = (deviation * deviation).mean(0) / (mean * mean)
        difference, both = (partners @ mean).chunk(2)
        asymmetry = difference / both
        ctx.save_for_backward(edges, partners, bones, lengths, total, shares, mean, deviation)
        ctx.of_mean = relative_variance, asymmetry, both
        return (relative_variance + _SYMMETRY_WEIGHT * asymmetry * asymmetry).mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient by S, by the chain rule from the last line of `forward` to the first.

        Each `d_x` is the gradient of the loss by x, times b e.
        """
        edges, partners, bones, lengths, total, shares, mean, deviation = ctx.saved_tensors
        relative_variance, asymmetry, both = ctx.of_mean
        d_difference = 2 * _SYMMETRY_WEIGHT * asymmetry / both
        d_mean = torch.cat((d_difference, -d_difference * asymmetry)) @ partners
        d_mean = d_mean - 2 * relative_variance / mean
        # The deviations of a batch sum to 0, so their own dependence on the mean adds nothing.
        d_shares = torch.addcmul(d_mean, deviation, 2 / (mean * mean))
        d_lengths = (d_shares - (d_shares * shares).sum(1, keepdim=True)) / total
        d_bones = bones * (d_lengths / lengths)[:, None]
        d_S = (d_bones.view(-1, bones.shape[-1]) @ edges.T).view(len(bones), 3, -1).mT
        return d_S * (gradient / shares.numel()), None, None


def _differences(p: int, pairs: list[tuple[int, int]]) -> Tensor:
    """Return the matrix (p, pairs) whose product with rows of p numbers is a - b of each pair."""
    matrix: NDArray[np.float32] = np.zeros((p, len(pairs)), np.float32)
    for i, (a, b) in enumerate(pairs):
        matrix[a, i] += 1
        matrix[b, i] -= 1
    return torch.from_numpy(matrix)


def _product(S: Tensor, A: Tensor) -> Tensor:
    """Return S^T A (b, 3, k) for S (b, p, 3) and A (p, k), as one product of all rows."""
    return (S.mT.reshape(-1, S.shape[1]) @ A.to(S)).view(len(S), 3, -1)
