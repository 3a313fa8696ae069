# SPDX-License-Identifier: Apache-2.0
"""Rigid factorisation, and functions shared with the other factorisations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import polar

Floats = NDArray[Any]


def rigid(W: Floats) -> Floats:
    """Return one shape for all frames: factorisation with the metric upgrade.

    Args:
        W: (f, p, 2) images of the same p points, all visible. Each frame must be centred over its
            points, and all of one scale: `W -= W.mean(1, keepdims=True)`, then
            `W /= np.linalg.norm(W, axis=(1, 2), keepdims=True)`. Pixels as they are give a wrong
            shape.

    Returns:
        (f, p, 3) the shape, f times the same, in the unit of W; possibly a mirror image.

    Source: Tomasi and Kanade, "Shape and motion from image streams under orthography", IJCV 1992.
    """
    S = rigid_shape(W, rigid_rotations(W))
    return np.repeat(S[None], len(W), axis=0)


def stack(W: Floats) -> Floats:
    """Return the measurement matrix (2f, p), rows x_1, y_1, x_2, ..."""
    rows: Floats = W.astype(np.float64).swapaxes(1, 2).reshape(-1, W.shape[1])
    return rows


def quadratic(a: Floats, b: Floats) -> Floats:
    """Return C (f, n (n + 1) / 2) with a^T Q b = C q for the scaled upper triangle q of Q."""
    n = a.shape[1]
    i, j = np.triu_indices(n)
    weight = np.where(i == j, 0.5, 0.5**0.5)
    C: Floats = weight * (a[:, i] * b[:, j] + a[:, j] * b[:, i])
    return C


def symmetric(q: Floats, n: int) -> Floats:
    """Return Q (n, n) of its scaled upper triangle; the norm of q is that of Q."""
    i, j = np.triu_indices(n)
    Q = np.zeros((n, n))
    Q[i, j] = Q[j, i] = np.where(i == j, 1, 0.5**0.5) * q
    return Q


def root_of_rank_three(Q: Floats) -> Floats:
    """Return G (n, 3) of the nearest positive Q ~ G G^T of rank three."""
    values, vectors = np.linalg.eigh(Q)
    G: Floats = vectors[:, -3:] * np.sqrt(np.maximum(values[-3:], 0))
    return G


def rigid_rotations(W: Floats) -> Floats:
    """Return rotations' first rows R (f, 2, 3): x Q x = y Q y = 1, x Q y = 0 in least squares."""
    U = np.linalg.svd(stack(W), full_matrices=False)[0][:, :3].reshape(-1, 2, 3)
    x, y = U[:, 0], U[:, 1]
    C = np.concatenate([quadratic(x, x), quadratic(y, y), quadratic(x, y)])
    ones = np.repeat([1.0, 1.0, 0.0], len(W))
    q = np.linalg.lstsq(C, ones, rcond=None)[0]
    R: Floats = polar(U @ root_of_rank_three(symmetric(q, 3)))
    return R


def rigid_shape(W: Floats, R: Floats) -> Floats:
    """Return the rigid shape (p, 3) that fits W under rotations R (f, 2, 3) best."""
    S: Floats = np.linalg.lstsq(R.reshape(-1, 3), stack(W), rcond=None)[0].T
    return S
