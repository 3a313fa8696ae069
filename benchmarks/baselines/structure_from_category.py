# SPDX-License-Identifier: Apache-2.0
"""Structure from category of Kong, Zhu, Kiani and Lucey: "SfC" in the paper's Table 2.

"Structure from category: a generic and prior-less approach", 3DV 2016. Each basis shape turns by
itself: W_f = sum_k M_fk B_k with M_fk = c_fk R_fk, whose sparsity and orthonormality are both
relaxed by the spectral norm:

    min 1/2 |G o (M B + t - W)|^2 + sparsity sum |M_fk|_2  subject to |B_k|_F = 1,

G being 1 where a point is visible. Convex in M alone; ADMM with a copy Z of M and A of B.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.spectral import depths, shrink_spectral_norm, singular_values
from deep_nrsfm_ros.nrsfm.geometry import visible_mean

Floats = NDArray[Any]


def structure_from_category(
    W: Floats,
    K: int,
    *,
    sparsity: float = 0.05,
    visible: NDArray[np.bool_] | None = None,
    growth: float = 1.01,
    starts: int = 1,
) -> Floats:
    """Return the shapes (2^(K-1), f, p, 3) of all sign patterns, in the camera's axes.

    (M_k, B_k) and (-M_k, -B_k) fit the images equally well and mirror the depth of basis shape k
    against that of the others, so that the objective does not tell the patterns apart.

    Args:
        W: (f, p, 2) images; what is not visible is ignored.
        K: basis shapes.
        sparsity: weight of the spectral norms, of images of norm 1. 0.01 to 0.1 typical.
        visible: (f, p); None: all.
        growth: of the penalties, an iteration. The authors' program has 1.1, which freezes early.
        starts: random starts, of which the lowest objective counts.
    """
    mask = np.ones(W.shape[:2], bool) if visible is None else visible
    Y = np.where(mask[..., None], W, 0).astype(np.float64)
    centred = (Y - visible_mean(Y, mask[..., None])) * mask[..., None]
    size = np.maximum(np.linalg.norm(centred, axis=(1, 2)), 1e-12)[:, None, None]
    Y = (centred / size).swapaxes(1, 2)
    solved = [_solve(Y, mask, K, sparsity, growth, seed) for seed in range(starts)]
    M, B, _ = min(solved, key=lambda result: result[2])
    flat = np.einsum("fkac,kcp->fpa", M, B, optimize=True)
    by_basis = depths(M, B)
    shapes = []
    for pattern in product((1.0, -1.0), repeat=K - 1):
        depth = np.einsum("k,fkp->fp", np.array((1.0, *pattern)), by_basis)
        shapes.append(size * np.concatenate([flat, depth[..., None]], 2))
    return np.stack(shapes)


def _solve(
    Y: Floats, mask: NDArray[np.bool_], K: int, sparsity: float, growth: float, seed: int
) -> tuple[Floats, Floats, float]:
    """Return M (f, K, 2, 3), B (K, 3, p) and the objective; images Y (f, 2, p)."""
    f, _, p = Y.shape
    rng = np.random.default_rng(seed)
    start = rng.standard_normal((K, 3, p))
    B: Floats = _unit(start - start.mean(2, keepdims=True)).reshape(3 * K, p)
    A, Pi = B, np.zeros_like(B)
    Z: Floats = np.zeros((f, 2, 3 * K))
    L, M, t = Z, Z, Z[..., :1]
    mu, rho, last = 1e-2, 1e-1, np.inf
    whole, weight = bool(mask.all()), mask[:, None, :].astype(float)
    while True:
        M = _merge(shrink_spectral_norm(_split(Z - L / mu, K), sparsity / mu))
        Z = _update_cameras(Y - t, B, L + mu * M, mu, None if whole else weight)
        B = _update_basis(Y - t, Z, Pi + rho * A, rho, None if whole else weight)
        A = _unit((B - Pi / rho).reshape(K, 3, p)).reshape(3 * K, p)
        if not whole:
            t = (weight * (Y - Z @ B)).sum(2, keepdims=True) / weight.sum(2, keepdims=True)
        L = L + mu * (M - Z)
        Pi = Pi + rho * (A - B)
        norms = float(singular_values(_split(M, K))[0].sum())
        fit = 0.5 * float((weight * (Z @ B + t - Y) ** 2).sum())
        gap = 0.5 * mu * float(((M - Z) ** 2).sum()) + 0.5 * rho * float(((A - B) ** 2).sum())
        cost = fit + sparsity * norms + gap
        mu, rho = min(growth * mu, 1e5), min(growth * rho, 1e5)
        # The penalties grow from very little: until they count, the cost says nothing.
        if mu > 1 and (abs(last - cost) < 3e-6 * cost or cost < 1e-6 or mu >= 1e5):
            fit = 0.5 * float((weight * (M @ A + t - Y) ** 2).sum())
            return _split(M, K), A.reshape(K, 3, p), fit + sparsity * norms
        last = cost


def _update_cameras(
    Y: Floats, B: Floats, towards: Floats, mu: float, weight: Floats | None
) -> Floats:
    """Return Z (f, 2, 3K): min |G o (Z B - Y)|^2 / 2 + the quadratic penalty, for each frame."""
    eye = mu * np.eye(len(B))
    if weight is None:
        flat = (Y @ B.T + towards).reshape(-1, len(B))
        solved: Floats = np.linalg.solve(B @ B.T + eye, flat.T).T.reshape(towards.shape)
        return solved
    normal = (weight * B) @ B.T + eye
    masked: Floats = np.linalg.solve(normal, ((weight * Y) @ B.T + towards).swapaxes(1, 2))
    return masked.swapaxes(1, 2)


def _update_basis(
    Y: Floats, Z: Floats, towards: Floats, rho: float, weight: Floats | None
) -> Floats:
    """Return B (3K, p): min |G o (Z B - Y)|^2 / 2 + the quadratic penalty, for each point."""
    f, _, p = Y.shape
    eye = rho * np.eye(Z.shape[2])
    rows = Z.reshape(2 * f, -1)
    if weight is None:
        solved: Floats = np.linalg.solve(rows.T @ rows + eye, rows.T @ Y.reshape(-1, p) + towards)
        return solved
    by_point = np.repeat(weight, 2, axis=1).reshape(2 * f, p).T[:, None, :] * rows.T
    right = by_point @ Y.reshape(-1, p).T[..., None] + towards.T[..., None]
    masked: Floats = np.linalg.solve(by_point @ rows + eye, right)[..., 0].T
    return masked


def _unit(B: Floats) -> Floats:
    """Return blocks (K, 3, p) of norm one."""
    unit: Floats = B / np.maximum(np.linalg.norm(B, axis=(1, 2), keepdims=True), 1e-12)
    return unit


def _split(M: Floats, K: int) -> Floats:
    """Return (f, K, 2, 3) of (f, 2, 3K)."""
    return M.reshape(len(M), 2, K, 3).swapaxes(1, 2)


def _merge(M: Floats) -> Floats:
    """Return (f, 2, 3K) of (f, K, 2, 3)."""
    return M.swapaxes(1, 2).reshape(len(M), 2, -1)
