# SPDX-License-Identifier: Apache-2.0
"""The block-matrix method of Dai, Li and He, with the weighted nuclear norm of Kumar."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.factorisation.rigid import quadratic, root_of_rank_three, stack, symmetric
from deep_nrsfm_ros.nrsfm.geometry import back_project, polar

Floats = NDArray[Any]

WEIGHT_FLOOR = 0.1
"""Floor of the weights 1 / (sigma + floor), relative to the largest singular value; of 0.5, 0.2,
0.1, 0.05 and 0.02 the best on a batch of CMU 01 and one of 127, by the truth."""

NORM_ITERATIONS = 150
"""Iterations in which the shapes of lowest nuclear norm are found."""


def block_matrix(
    W: Floats, K: int, *, weighted: bool = False, iterations: int = NORM_ITERATIONS
) -> Floats:
    """Return the shapes of lowest nuclear norm among those that the images allow.

    Dai, Li and He, "A simple prior-free method for non-rigid structure from motion
    factorization", IJCV 2014: cameras from the Gram matrix of one column triplet of the rank 3K
    factorisation, then shapes by the block-matrix method. K is used for the cameras alone.

    `weighted`: the weighted nuclear norm of Kumar, "Non-rigid structure from motion: prior-free
    factorization method revisited", WACV 2020: large singular values are shrunk less. Its cameras
    from several column triplets are left out: refined, the triplets give the same cameras
    (docs/devlog/accuracy.md).
    """
    R = block_rotations(W, K)
    return least_nuclear_norm(W, R, iterations, weighted=weighted)


def block_rotations(W: Floats, K: int) -> Floats:
    """Return R (f, 2, 3) from the rank 3K factorisation."""
    R: Floats = polar(block_cameras(W, K))
    return R


def block_cameras(W: Floats, K: int) -> Floats:
    """Return cameras (f, 2, 3), rotations times the scale of each image, of rank 3K factorisation.

    Each row pair of Pi G is a multiple of a rotation: A q = 0 for the Gram matrix Q = G G^T.
    First min |A q|^2 + trace Q over positive Q, then G itself by least squares.
    """
    n = min(3 * K, *stack(W).shape)
    U, s, _ = np.linalg.svd(stack(W), full_matrices=False)
    Pi = (U[:, :n] * np.sqrt(s[:n])).reshape(-1, 2, n)
    Pi /= np.sqrt((Pi**2).sum((1, 2)).mean() / 2)
    cameras: Floats = Pi @ _refine(Pi, root_of_rank_three(gram_matrix(Pi)))
    return cameras


def gram_matrix(Pi: Floats, *, trace: float = 1e-1, iterations: int = 500) -> Floats:
    """Return the positive Q (n, n) of low trace that makes Pi Q Pi^T nearly orthogonal.

    Q is scaled so that the mean of |Pi G|^2 is one; `trace` is the weight of Q's trace relative
    to the mean curvature of the rest. ADMM between the quadratic and the cone.
    """
    f, _, n = Pi.shape
    x, y = Pi[:, 0], Pi[:, 1]
    A = np.concatenate([quadratic(x, x) - quadratic(y, y), 2 * quadratic(x, y)])
    c = (quadratic(x, x) + quadratic(y, y)).mean(0)
    H = A.T @ A / f
    step = np.trace(H) / len(H)
    inverse = np.linalg.inv(H + step * np.eye(len(H)))
    towards = inverse @ c / (c @ inverse @ c)
    i, j = np.triu_indices(n)
    scale = np.where(i == j, 1, 2**0.5)
    z = u = np.zeros(len(H))
    for _ in range(iterations):
        q = inverse @ (step * (z - u))
        q += towards * (1 - c @ q)
        values, vectors = np.linalg.eigh(symmetric(q + u, n))
        positive = (vectors * np.maximum(values - trace, 0)) @ vectors.T
        z = scale * positive[i, j]
        u = u + q - z
    return symmetric(z, n)


def _refine(Pi: Floats, G: Floats, *, iterations: int = 30) -> Floats:
    """Return G (n, 3) with row pairs of Pi G of equal length and at right angles.

    Levenberg-Marquardt on the differences, relative to the squared lengths of the pair.
    """
    damping, (r, J) = 1e-3, _skew(Pi, G)
    for _ in range(iterations):
        normal, gradient = J.T @ J, J.T @ r
        step = np.linalg.solve(
            normal + damping * (np.diag(normal.diagonal()) + 1e-9 * np.eye(len(normal))), gradient
        )
        moved = G - step.reshape(G.shape)
        r_moved, J_moved = _skew(Pi, moved)
        if r_moved @ r_moved < r @ r:
            G, r, J, damping = moved, r_moved, J_moved, damping / 10
        else:
            damping = min(damping * 10, 1e9)
    return G


def _skew(Pi: Floats, G: Floats) -> tuple[Floats, Floats]:
    """Return (xx - yy, 2 xy) / (xx + yy) (2f,) of the row pairs x, y of Pi G, and its Jacobian."""
    x, y = np.moveaxis(Pi @ G, 1, 0)
    xx, yy, xy = (x * x).sum(1), (y * y).sum(1), (x * y).sum(1)
    size = xx + yy + 1e-12
    r = np.concatenate(((xx - yy) / size, 2 * xy / size))
    u, v = Pi[:, 0, :, None], Pi[:, 1, :, None]
    x, y, size = x[:, None], y[:, None], size[:, None, None]
    along, across = u * x, v * y
    first = 2 * (along - across) / size
    second = 2 * (u * y + v * x) / size
    both = 2 * (along + across) / size
    a, b = np.split(r[:, None, None], 2)
    J = np.concatenate((first - a * both, second - b * both))
    return r, J.reshape(len(r), -1)


def least_nuclear_norm(
    W: Floats,
    R: Floats,
    iterations: int = NORM_ITERATIONS,
    *,
    weighted: bool = False,
    before_each: Callable[[], None] = lambda: None,
) -> Floats:
    """Return S (f, p, 3): min |S#|_* subject to R S = W, S# being S as a matrix (f, 3p).

    ADMM: singular values are shrunk, then the shapes moved to where they project onto W.
    Weighted: each is shrunk in proportion to 1 / (sigma + floor), by the running sigma.
    `before_each` is called before each iteration; an exception ends the work.
    """
    Y = W.astype(np.float64)
    f, p, _ = Y.shape

    def held(S: Floats) -> Floats:
        moved: Floats = back_project(S, R.swapaxes(1, 2), Y)
        return moved

    S, U = held(np.zeros((f, p, 3))), np.zeros((f, p, 3))
    shrinkage = 0.05 * np.linalg.norm(S.reshape(f, -1), 2)
    for _ in range(iterations):
        before_each()
        matrix = (S + U).reshape(f, -1)
        left, s, right = _svd(matrix)
        floor = WEIGHT_FLOOR * s[0]
        weight = floor / (s + floor) if weighted else 1.0
        X = ((left * np.maximum(s - weight * shrinkage, 0)) @ right).reshape(S.shape)
        S = held(X - U)
        U = U + S - X
    return S


def _svd(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the thin singular value decomposition of a matrix.

    LAPACK's (gesdd) converges for nearly every matrix, but not for all; it takes another way
    through the transposed one.
    """
    try:
        left, s, right = np.linalg.svd(matrix, full_matrices=False)
    except np.linalg.LinAlgError:
        right, s, left = (A.T for A in np.linalg.svd(matrix.T, full_matrices=False))
    return left, s, right
