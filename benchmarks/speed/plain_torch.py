# SPDX-License-Identifier: Apache-2.0
"""The paper's network and losses in plain torch: the reference of the benchmarks.

Each layer is a convolution, or its transpose, over k blocks of 3 x 2. The camera comes from an SVD,
the gradient from autograd. All keypoints are visible. With the same weights the results are those
of `network.forward`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812  the usual name

from deep_nrsfm_ros.nrsfm.geometry import polar
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.losses import frobenius
from deep_nrsfm_ros.nrsfm.network import Network
from deep_nrsfm_ros.nrsfm.recipe import Preset


class PlainNetwork(nn.Module):
    """The network of "Deep Non-Rigid Structure from Motion", one convolution a layer."""

    L: Tensor
    L_inverse: Tensor

    def __init__(self, net: Network) -> None:
        """Copy the weights of `net`, NumPy or torch."""
        super().__init__()
        net = net.map(torch.as_tensor)
        first, *others = net.D
        self.first = nn.Parameter(first.permute(0, 2, 1)[..., None].clone())  # (p, k_1, 3, 1)
        self.D = nn.ParameterList(D.T[..., None, None].clone() for D in others)
        self.b = nn.ParameterList(b.clone() for b in net.b)
        self.b_ = nn.ParameterList(b.clone() for b in net.b_)
        k = net.camera_head.shape[0]
        heads = net.code_head.reshape(2, 3, k, k).permute(3, 2, 1, 0)  # (k, k, 3, 2)
        self.code_head = nn.Parameter(heads.clone())
        self.camera_head = nn.Parameter(net.camera_head.T[..., None, None].clone())
        self.whitened = net.architecture.whitening > 0
        self.register_buffer("L", net.L)
        self.register_buffer("L_inverse", net.L_inverse)

    def forward(self, W: Tensor) -> tuple[Tensor, Tensor]:
        """Return shape S (b, p, 3) and camera M (b, 3, 2) of the keypoints W (b, p, 2)."""
        if self.whitened:
            W = self.L @ W
        Psi = F.conv_transpose2d(W[:, :, None], self.first, -self.b[0]).relu()  # (b, k_1, 3, 2)
        for D, b in zip(self.D, list(self.b)[1:], strict=True):
            Psi = F.conv2d(Psi, D, -b).relu()
        psi = F.conv2d(Psi, self.code_head)  # (b, k_n, 1, 1)
        U, _, Vt = torch.linalg.svd(F.conv2d(Psi, self.camera_head)[:, 0], full_matrices=False)
        for D, b in zip(reversed(self.D), reversed(list(self.b_)[1:]), strict=True):
            psi = F.conv_transpose2d(psi, D, -b).relu()
        S = F.conv_transpose2d(psi, self.first.transpose(0, 1))[..., 0] - self.b_[0]  # (b, p, 3)
        if self.whitened:
            S = self.L_inverse @ S
        return S, U @ Vt


class PlainTraining:
    """Training by two passes of the network and torch's Adam."""

    def __init__(
        self,
        net: Network,
        points: Tensor,
        preset: Preset,
        layout_loss: LayoutLoss | None = None,
    ) -> None:
        """Prepare to train a `PlainNetwork` of `net` on points (f, p, 2)."""
        self.net, self.points, self.preset = PlainNetwork(net), points, preset
        self.layout_loss = layout_loss
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=preset.recipe.learning_rate)

    def advance(self) -> None:
        """Take one gradient step."""
        chosen = torch.randint(len(self.points), (self.preset.recipe.batch,))
        self.optimiser.zero_grad()
        self.loss(self.points[chosen]).backward()
        self.optimiser.step()

    def loss(self, points: Tensor) -> Tensor:
        """Return the loss of points (b, p, 2): reprojection, and cycle and layout loss if any."""
        W = self._normalised(points)
        S, M = self.net(W)
        residual = W - (S @ M - (S @ M).mean(-2, keepdim=True))
        loss = self._relative(residual, W)
        if self.preset.recipe.cycle:
            with torch.no_grad():
                shapes = S + residual @ M.mT
                shapes = shapes - shapes.mean(-2, keepdim=True)
                seen = shapes @ polar(torch.randn(len(shapes), 2, 3)).mT
                unit = (
                    frobenius(seen)[:, None, None]
                    / frobenius(self._normalised(seen))[:, None, None]
                )
            again, _ = self.net(self._normalised(seen))
            T = shapes / unit
            error = again - again.mean(-2, keepdim=True) - T
            loss = loss + self.preset.recipe.cycle * self._relative(error, T)
        if self.layout_loss:
            loss = loss + self.layout_loss(S, M)
        return loss

    def _normalised(self, points: Tensor) -> Tensor:
        """Return points (b, p, 2) centred and, where the preset says so, of RMS radius 1 / 2."""
        W = points - points.mean(-2, keepdim=True)
        if self.preset.normaliser.scale == "none":
            return W
        return W / (2 * (W * W).sum(-1).mean(-1).sqrt()[:, None, None])

    def _relative(self, error: Tensor, X: Tensor) -> Tensor:
        """Return the mean of ||error|| / ||X||, both whitened where the network is."""
        if self.net.whitened:
            error, X = self.net.L @ error, self.net.L @ X
        return (frobenius(error) / frobenius(X)).mean()
