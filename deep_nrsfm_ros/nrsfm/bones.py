"""Bones keep their lengths: what edges, and other rigid pairs, tell about depth.

How long each edge is among all, and how much that varies, needs no 3D label: shapes of the training
frames tell. They vary by more than the object does, as they come with errors; by how much more is
seen where known shapes are lifted again. An edge that is no bone varies a lot, and says little.

A length l = ||x_i - x_j|| is linear about a shape X: l(X + E) ~ l(X) + g^T (E_i - E_j), with g the
unit vector along the edge. So lengths are further observations for `correction`. Ours, not in the
paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import Floats


class Bones(NamedTuple):
    """What is known of b bones."""

    ends: NDArray[np.int32]  # (2, b) keypoints
    lengths: NDArray[np.float64]  # (b,) shares of the sum of all
    spread: NDArray[np.float64]  # (b,) their standard deviations

    def length_constraint(self, X: Floats) -> tuple[Floats, Floats, Floats]:
        """Return what shapes X (n, p, 3) lack of the lengths: G (n, b, 3p), (n, b), (n, b, b).

        That is: by how much each bone grows with the shape, should grow, and the covariance of
        that. The size of the object, which fits the lengths best, may be another one.
        """
        (i, j), L = self.ends, self.lengths
        n, p, _ = X.shape
        edges = X[:, i] - X[:, j]
        found = np.linalg.norm(edges, axis=2)
        trust = (L / self.spread) ** 2
        size = (found / L) @ trust / trust.sum()  # (n,)
        G = np.zeros((n, len(L), p, 3))
        towards = edges / np.maximum(found, 1e-9)[..., None]
        G[:, range(len(L)), i] = towards
        G[:, range(len(L)), j] = -towards
        varies = np.diag(self.spread**2) + np.outer(L, L)
        wanted = size[:, None] * L - found
        return G.reshape(n, len(L), 3 * p), wanted, size[:, None, None] ** 2 * varies


def shares(S: Floats, pairs: Sequence[tuple[int, int]]) -> Floats:
    """Return the distances (n, b) of pairs of keypoints in shapes S (n, p, 3), by their sum."""
    i, j = np.array(pairs).T
    lengths: Floats = np.linalg.norm(S[:, i] - S[:, j], axis=2).astype(np.float64)
    lengths /= np.maximum(lengths.sum(1, keepdims=True), 1e-9)
    return lengths
