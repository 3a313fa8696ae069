# SPDX-License-Identifier: Apache-2.0
"""Bone lengths: edges of the layout, and other rigid pairs of keypoints, that keep their lengths.

The lengths relative to their sum, and how much they vary, are estimated from the lifted shapes of
the training frames, without 3D labels. Lifted shapes have errors, so that their lengths vary more
than those of the object; how much more follows from lifting known shapes again. An edge that is not
rigid varies a lot and gets little weight.

A length l = ||x_i - x_j|| is linear near a shape X: l(X + E) ~ l(X) + g^T (E_i - E_j), where g is
the unit vector along the edge. So lengths are further measurements for `lifting.correction`. This
is ours, not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import Floats


class Bones(NamedTuple):
    """The lengths of b bones.

    Attributes:
        ends: (2, b) int32, the keypoints at the ends of each bone.
        lengths: (b,) mean lengths, relative to the sum of all; 0.05 typical. (n, b) where each of
            n objects has its own.
        spread: (b,) or (n, b) standard deviations of the lengths, in the same unit.
        correlation: (b, b) of the lengths: a person with a long left shin has a long right one.
            None: they are independent.
    """

    ends: NDArray[np.int32]
    lengths: NDArray[np.float64]
    spread: NDArray[np.float64]
    correlation: NDArray[np.float64] | None = None

    def length_constraint(self, X: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the linearised bone-length constraint G e = r for a correction e of each shape.

        The lengths are relative, so each shape is first given the size that fits them best.

        Args:
            X: (n, p, 3) shapes, in any unit.

        Returns:
            Jacobian G (n, b, 3 p) of the lengths, residual r (n, b) = expected - measured length in
            the unit of X, and covariance (n, b, b) of the residual.
        """
        i, j = self.ends
        n, p, _ = X.shape
        b = len(i)
        L, spread = np.broadcast_to(self.lengths, (n, b)), np.broadcast_to(self.spread, (n, b))
        edges = X[:, i] - X[:, j]  # (n, b, 3)
        measured = np.linalg.norm(edges, axis=2)  # (n, b)
        weight = (L / spread) ** 2
        size = (measured / L * weight).sum(1) / weight.sum(1)  # (n,)
        G = np.zeros((n, b, p, 3))
        directions = edges / np.maximum(measured, 1e-9)[..., None]
        G[:, range(b), i] = directions
        G[:, range(b), j] = -directions
        correlation = np.eye(b) if self.correlation is None else self.correlation
        # The first product is the variance of the unknown size of the object.
        covariance = L[:, :, None] * L[:, None]
        covariance += correlation * spread[:, :, None] * spread[:, None]
        residual = size[:, None] * L - measured
        return G.reshape(n, b, 3 * p), residual, size[:, None, None] ** 2 * covariance


def relative_lengths(S: Floats, pairs: Sequence[tuple[int, int]]) -> Floats:
    """Return the distances (n, b) of b pairs of keypoints in shapes S (n, p, 3), by their sum."""
    i, j = np.array(pairs).T
    lengths: Floats = np.linalg.norm(S[:, i] - S[:, j], axis=2).astype(np.float64)
    lengths /= np.maximum(lengths.sum(1, keepdims=True), 1e-9)
    return lengths
