"""What a layout knows of an object, as a loss: bones keep their lengths, the front is in front.

Not of the paper, and no 3D label: edges and handedness are what an object file says in words. Views
from one side only tell too little about depth for more than its amount; which way each limb goes is
then a matter of chance, unless this is asked for (`recipe.Anatomy`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from deep_nrsfm_ros.nrsfm.keypoints import KeypointLayout
from deep_nrsfm_ros.nrsfm.recipe import Anatomy

_FRONT_MARGIN = 0.1
"""RMS radii by which a keypoint in front should be before its plane: at 0 it would lie in it."""
_ALIKE = 4.0
"""Left and right differ by twice what each differs from their mean, squared."""


class AnatomyLoss:
    """The weighted sum of both terms, of shapes in the network's axes, and its gradient.

    One weight at least is not zero.
    """

    def __init__(self, weights: Anatomy, layout: KeypointLayout) -> None:
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

    def __call__(self, S: Tensor) -> Tensor:
        """Return the loss of a batch of shapes S (b, p, 3)."""
        loss = S.new_zeros(())
        if self.weights.bones:
            loss = loss + self.weights.bones * self._bones(S)
        if self.weights.front:
            loss = loss + self.weights.front * self._front(S)
        return loss

    def gradient(self, S: Tensor) -> Tensor:
        """Return the gradient (b, p, 3) by S; also within torch.inference_mode."""
        with torch.inference_mode(False), torch.enable_grad():
            X = S.clone().requires_grad_()
            (S_bar,) = torch.autograd.grad(self(X), X)
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
