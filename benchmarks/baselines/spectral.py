# SPDX-License-Identifier: Apache-2.0
"""The spectral norm of 2 x 3 blocks, by which SfC and Convex relax sparsity and orthonormality."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import polar, rotation_from_camera

Floats = NDArray[Any]


def singular_values(Q: Floats) -> tuple[Floats, Floats]:
    """Return the larger and the smaller singular value (...) of blocks Q (..., 2, 3)."""
    a, b, c = _gram(Q)
    root = np.sqrt((a - c) ** 2 + 4 * b * b)
    return np.sqrt((a + c + root) / 2), np.sqrt(np.maximum(a + c - root, 0) / 2)


def shrink_spectral_norm(Q: Floats, threshold: Floats | float) -> Floats:
    """Return argmin_X threshold |X|_2 + |X - Q|_F^2 / 2 for each block Q (..., 2, 3).

    The two singular values approach each other from above: (s1 - t, s2) while s1 - t > s2, then
    both (s1 + s2 - t) / 2, or 0. As a function of the 2 x 2 matrix Q Q^T it needs no decomposition.
    """
    a, b, c = _gram(Q)
    large, small = singular_values(Q)
    both = np.maximum((large + small - threshold) / 2, 0)
    apart = large - small > threshold
    tiny = 1e-12
    of_large = np.where(apart, large - threshold, both) / np.maximum(large, tiny)
    of_small = np.where(apart, 1.0, both / np.maximum(small, tiny))
    of_small = np.where(small > tiny, of_small, 0.0)
    # f(Q Q^T) = f(small) + slope (Q Q^T - small) on the eigenvalues.
    gap = large**2 - small**2
    slope = np.where(gap > 1e-9 * large**2, (of_large - of_small) / np.maximum(gap, 1e-300), 0.0)
    constant = np.where(gap > 1e-9 * large**2, of_small - slope * small**2, of_large)
    x, y = Q[..., 0, :], Q[..., 1, :]
    rows = (
        (constant + slope * a)[..., None] * x + (slope * b)[..., None] * y,
        (slope * b)[..., None] * x + (constant + slope * c)[..., None] * y,
    )
    return np.stack(rows, -2)


def _gram(Q: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the entries xx, xy, yy (...) of Q Q^T."""
    x, y = Q[..., 0, :], Q[..., 1, :]
    return (x * x).sum(-1), (x * y).sum(-1), (y * y).sum(-1)


def depths(M: Floats, B: Floats) -> Floats:
    """Return the third coordinate (f, K, p) of each c_fk R_fk B_k, in the camera's axes.

    Args:
        M: (f, K, 2, 3) the first two rows of c_fk R_fk, not exactly orthonormal.
        B: (K, 3, p) basis shapes.
    """
    c = singular_values(M)[0]
    third = rotation_from_camera(polar(M).swapaxes(-1, -2))[..., 2, :]
    depth: Floats = np.einsum("fk,fkc,kcp->fkp", c, third, B, optimize=True)
    return depth
