"""What a layout knows of an object, as a loss: bones keep their lengths, the front is in front.

Not of the paper, and no 3D label: edges and handedness are what a layout file says in words. Views
from one side only tell too little about depth: which way each limb goes, and how far what hardly
moves, is then a matter of chance, unless this is asked for (`recipe.LayoutLossWeights`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.nrsfm.recipe import LayoutLossWeights

_FRONT_MARGIN = 0.1
"""RMS radii by which a keypoint in front should be before its plane: at 0 it would lie in it."""
_ALIKE = 4.0
"""Left and right differ by twice what each differs from their mean, squared."""


class LayoutLoss:
    """The weighted sum of the terms, of shapes in the network's axes, and its gradient.

    One weight at least is not zero.
    """

    def __init__(self, weights: LayoutLossWeights, layout: KeypointLayout) -> None:
        """Find edges, their partners on the other side, and the votes on the handedness.

        Raises ValueError if the layout has nothing of what the weights ask for.
        """
        weights.check(layout)
        self.weights = weights
        edges = layout.edge_indices()
        self._ends = [list(ends) for ends in zip(*edges, strict=True)]
        partners = layout.partners() or range(len(layout))
        places = {frozenset(edge): i for i, edge in enumerate(edges)}
        self._partners = [
            places.get(frozenset((partners[a], partners[b])), i) for i, (a, b) in enumerate(edges)
        ]
        fours = [[layout.index(name) for name in four] for four in layout.handedness]
        self._votes = [list(corner) for corner in zip(*fours, strict=True)]

    def __call__(self, S: Tensor, M: Tensor) -> Tensor:
        """Return the loss of a batch of shapes S (b, p, 3) before cameras M (b, 3, 2)."""
        loss = S.new_zeros(())
        if self.weights.bone_length_weight:
            loss = loss + self.weights.bone_length_weight * self._bones(S)
        if self.weights.handedness_weight:
            loss = loss + self.weights.handedness_weight * self._front(S)
        if self.weights.depth_penalty:
            loss = loss + self.weights.depth_penalty * self._depth(S, M.detach())
        return loss

    def gradient(self, S: Tensor, M: Tensor) -> Tensor:
        """Return the gradient (b, p, 3) by S; also within torch.inference_mode. M has none."""
        with torch.inference_mode(False), torch.enable_grad():
            X = S.clone().requires_grad_()
            (S_bar,) = torch.autograd.grad(self(X, M.clone()), X)
            return S_bar

    def _bones(self, S: Tensor) -> Tensor:
        """Return how much each edge's share of all edges varies, and differs from its partner's.

        Squares, relative to the share, means over the edges.
        """
        i, j = self._ends
        lengths = ((S[:, i] - S[:, j]) ** 2).sum(-1).add(1e-10).sqrt()
        shares = lengths / lengths.sum(1, keepdim=True)
        mean = shares.mean(0)
        other = mean[self._partners]
        varies = ((shares - mean) ** 2).mean(0) / mean**2
        differs = _ALIKE * ((mean - other) / (mean + other)) ** 2
        return (varies + differs).mean()

    def _front(self, S: Tensor) -> Tensor:
        """Return by how much keypoints fail to be in front, in RMS radii; `handedness.votes`."""
        left, right, up, front = (S[:, corner] for corner in self._votes)
        normal = torch.linalg.cross(left - right, up - right)
        heights = ((front - right) * normal).sum(-1) / normal.norm(dim=-1).clamp(min=1e-6)
        X = S - S.mean(1, keepdim=True)
        radius = (X * X).sum(-1).mean(1, keepdim=True).add(1e-12).sqrt()
        return torch.relu(_FRONT_MARGIN - heights / radius).mean()

    @staticmethod
    def _depth(S: Tensor, M: Tensor) -> Tensor:
        """Return the extent in depth over that in the image, squares."""
        X = S - S.mean(1, keepdim=True)
        seen = X @ M
        depth = X - seen @ M.mT
        return ((depth * depth).sum((1, 2)) / (seen * seen).sum((1, 2)).clamp(min=1e-9)).mean()
