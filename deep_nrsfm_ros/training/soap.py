# SPDX-License-Identifier: Apache-2.0
"""SOAP: Adam in the axes in which the second moment of the gradient is diagonal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from deep_nrsfm_ros.training.adam import Adam, take_over
from deep_nrsfm_ros.training.distributed import ALONE, ProcessGroup

_SIDES = range(16, 1025)  # smaller matrices gain nothing, and the axes of larger ones take seconds
_COVARIANCE_INTERVAL = 4  # steps
_FORGETTING = 0.02  # weight of the newest gradient in the second moment
_AXES_INTERVAL = 40  # steps
_EARLY = 4  # step at which the axes follow the first gradients
_ADAMS = 2  # times the learning rate of Adam, with which both learn best


@dataclass(frozen=True)
class _Side:
    """The smaller side, of length k, of a matrix of weights.

    Attributes:
        rows: of the vector of all weights, which hold the matrix.
        shape: of the matrix.
        covariance: (k, k) moving second moment of the gradient.
        axes: (k, k) its eigenvectors, in columns; 0 at first.
    """

    rows: slice
    shape: tuple[int, int]
    covariance: Tensor
    axes: Tensor

    def of(self, vector: Tensor) -> Tensor:
        """Return the matrix (k, n) in a vector of all weights, as a view."""
        matrix = vector[self.rows].view(self.shape)
        return matrix.T if self.shape[0] > self.shape[1] else matrix

    def rotate(self, vector: Tensor, Q: Tensor) -> None:
        """Replace the matrix A in a vector of all weights by Q^T A."""
        matrix = self.of(vector)
        matrix.copy_(Q.T @ matrix)


class Soap:
    """Adam on weights of which each matrix is rotated on its smaller side.

    Adam scales each entry of the gradient by itself, which is right where the entries are
    uncorrelated. In the eigenvectors of their second moment they are. The larger side is left as it
    is: its rotation would take several times as long.

    Attributes:
        moments: those of `Adam`, in the rotated axes; `covariance` and `axes` (s,) of all sides.

    Source: Vyas et al., SOAP: Improving and Stabilizing Shampoo using Adam, arXiv 2409.11321,
    algorithm 3, with one side rotated.
    """

    def __init__(
        self, weights: Tensor, shapes: Sequence[Sequence[int]], group: ProcessGroup = ALONE
    ) -> None:
        """Start with moments of zero.

        Args:
            weights: (w,) float32; `update` changes them in place.
            shapes: of the arrays that the weights are, in their order. An array of more than two
                dimensions is a matrix whose second side are all but the first.
            group: processes that have the same weights. They take the axes of the first one, as
                processors differ in rounding.
        """
        self._weights, self._group = weights, group
        self._adam = Adam(torch.zeros_like(weights))  # its weights are one step in rotated axes
        matrices, end = [], 0
        for shape in shapes:
            start, end = end, end + math.prod(shape)
            matrix = shape[0], math.prod(shape[1:])
            if min(matrix) in _SIDES:
                matrices.append((slice(start, end), matrix))
        sizes = [min(matrix) for _, matrix in matrices]
        covariance, axes = (weights.new_zeros(sum(k * k for k in sizes)) for _ in range(2))
        self.moments = self._adam.moments | {"covariance": covariance, "axes": axes}
        self._sides, end = [], 0
        for (rows, matrix), k in zip(matrices, sizes, strict=True):
            start, end = end, end + k * k
            C, Q = (x[start:end].view(k, k) for x in (covariance, axes))
            self._sides.append(_Side(rows, matrix, C, Q))

    @property
    def learning_rate(self) -> float:
        """Return the learning rate of the last step, 0 before the first one."""
        return self._adam.learning_rate

    @torch.no_grad()
    def update(self, gradient: Tensor, learning_rate: float) -> None:
        """Take one step along the gradient (w,); the learning rate is that of Adam."""
        count = int(self.moments["step"])
        if count % _COVARIANCE_INTERVAL == 0:
            for side in self._sides:
                G = side.of(gradient)
                side.covariance.lerp_(G @ G.T, _FORGETTING if count else 1.0)
        if count % _AXES_INTERVAL == 0 or count == _EARLY:
            self._renew_axes()
        rotated, step = gradient.clone(), self._adam.weights.zero_()
        for side in self._sides:
            side.rotate(rotated, side.axes)
        self._adam.update(rotated, learning_rate)
        for side in self._sides:
            side.rotate(step, side.axes.T)
        self._weights.add_(step, alpha=_ADAMS)

    def restore(self, moments: Mapping[str, Tensor]) -> None:
        """Take over saved moments; those that are not among them keep their values."""
        take_over(self.moments, moments)

    def _renew_axes(self) -> None:
        """Compute the axes from the second moments, and rotate the mean of the gradient to them.

        Its squares cannot be rotated; they are of nearly the same axes, and soon forget the others.
        """
        for side in self._sides:
            axes = self._group.broadcast(torch.linalg.eigh(side.covariance).eigenvectors)
            side.rotate(self.moments["exp_avg"], side.axes.T @ axes)
            side.axes.copy_(axes)
