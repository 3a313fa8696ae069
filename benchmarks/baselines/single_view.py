# SPDX-License-Identifier: Apache-2.0
"""Convex and Alternate of Zhou et al.: poses of single views from a 3D dictionary (Table 3).

Zhou, Leonardos, Hu and Daniilidis, "3D shape estimation from 2D landmarks: a convex relaxation
approach", CVPR 2015. W = R sum_k c_k B_k. Alternate minimises over R and sparse c in turn. Convex
relaxes M_k = c_k R to the spectral norm, min |W - sum_k M_k B_k|^2 / 2 + sparsity sum |M_k|_2;
its refinement goes on with Alternate from one rotation for all atoms.

Letters: Y (f, 2, p) images in the unit of `scaled_images`, B (K, 3, p), M (f, K, 2, 3),
R (f, 2, 3), c (f, K). All frames are solved together.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.spectral import depths, shrink_spectral_norm
from deep_nrsfm_ros.nrsfm.geometry import polar, rotation_from_camera

Floats = NDArray[Any]

SPARSITY = 1.0
"""Weight of the norms, of images with a standard deviation of one."""


def scaled_images(W: Floats) -> Floats:
    """Return Y (f, 2, p), centred, with a mean standard deviation of one; W (f, p, 2)."""
    Y = W.astype(np.float64).swapaxes(1, 2)
    Y = Y - Y.mean(2, keepdims=True)
    scaled: Floats = Y / np.maximum(Y.std(2).mean(1), 1e-12)[:, None, None]
    return scaled


def convex(W: Floats, B: Floats, *, sparsity: float = SPARSITY) -> Floats:
    """Return poses (f, p, 3) in the camera's axes: each atom has a rotation of its own."""
    B = B - B.mean(2, keepdims=True)
    M = relaxed_cameras(scaled_images(W), B, sparsity)
    flat = np.einsum("fkac,kcp->fpa", M, B, optimize=True)
    return np.concatenate([flat, depths(M, B).sum(1)[..., None]], 2)


def convex_refined(W: Floats, B: Floats, *, sparsity: float = SPARSITY) -> Floats:
    """Return poses (f, p, 3) of Convex with one rotation for all atoms, refined by Alternate."""
    B = B - B.mean(2, keepdims=True)
    Y = scaled_images(W)
    R, c = one_rotation(relaxed_cameras(Y, B, sparsity))
    return _alternate(Y, B, R, c, sparsity, polish=True)


def alternate(W: Floats, B: Floats, *, sparsity: float = SPARSITY) -> Floats:
    """Return poses (f, p, 3) in the camera's axes, from the dictionary's mean."""
    B = B - B.mean(2, keepdims=True)
    Y = scaled_images(W)
    R = polar(Y @ np.linalg.pinv(B.mean(0)))
    return _alternate(Y, B, R, np.full((len(Y), len(B)), 1 / len(B)), sparsity, polish=False)


def relaxed_cameras(
    Y: Floats, B: Floats, sparsity: float, *, tolerance: float = 1e-3, iterations: int = 1000
) -> Floats:
    """Return M (f, K, 2, 3): min |Y - sum M_k B_k|^2 / 2 + sparsity sum |M_k|_2.

    ADMM with a copy Z of M. The rank of B B^T is that of the points, so that its inverse comes
    from one singular value decomposition for all frames and penalties.
    """
    f, K = len(Y), len(B)
    flat = B.reshape(3 * K, -1)
    U, s, _ = np.linalg.svd(flat, full_matrices=False)
    right = Y @ flat.T
    found = np.zeros((f, 2, 3 * K))
    M, Z, L = found.copy(), found.copy(), found.copy()
    mu = 1 / np.abs(Y).mean((1, 2))[:, None, None]
    frames = np.arange(f)  # not yet converged
    for _ in range(iterations):
        X, last = right[frames] + mu * M + L, Z
        Z = (X - (X @ U * (s**2 / (s**2 + mu))) @ U.T) / mu
        blocks = (Z - L / mu).reshape(len(frames), 2, K, 3).swapaxes(1, 2)
        M = shrink_spectral_norm(blocks, sparsity / mu[:, 0]).swapaxes(1, 2).reshape(Z.shape)
        L = L + mu * (M - Z)
        norm = np.maximum(_norms(last), 1e-12)
        primal, dual = _norms(M - Z) / norm, mu * _norms(Z - last) / norm
        found[frames] = M
        left = ((primal >= tolerance) | (dual >= tolerance)).ravel()
        mu = np.where(primal > 10 * dual, 2 * mu, np.where(dual > 10 * primal, mu / 2, mu))
        frames, M, Z, L, mu = frames[left], M[left], Z[left], L[left], mu[left]
        if not len(frames):
            break
    return found.reshape(f, 2, K, 3).swapaxes(1, 2)


def _norms(M: Floats) -> Floats:
    """Return the norm (f, 1, 1) of each frame."""
    norms: Floats = np.linalg.norm(M, axis=(1, 2), keepdims=True)
    return norms


def one_rotation(M: Floats) -> tuple[Floats, Floats]:
    """Return R (f, 2, 3) and c (f, K) with c_fk R_f near M (f, K, 2, 3).

    The plane of R is that of the two leading eigenvectors of sum M_k^T M_k; within it, the better
    of a rotation and a reflection (the approximate projection of Del Bue et al., PAMI 2012).
    """
    Q = np.linalg.eigh(np.einsum("fkac,fkad->fcd", M, M, optimize=True))[1][:, :, :0:-1]
    T = M @ Q[:, None]
    turn = np.stack([T[..., 0, 0] + T[..., 1, 1], T[..., 1, 0] - T[..., 0, 1]], -1)
    flip = np.stack([T[..., 0, 0] - T[..., 1, 1], T[..., 0, 1] + T[..., 1, 0]], -1)
    values, vectors = zip(
        *(np.linalg.eigh(g.swapaxes(1, 2) @ g) for g in (turn, flip)), strict=True
    )
    by_turn = (values[0][:, -1] >= values[1][:, -1])[:, None, None]
    (a, b), (x, y) = (np.moveaxis(v[..., -1], -1, 0) for v in vectors)
    rotation = np.stack([np.stack([a, -b], -1), np.stack([b, a], -1)], -2)
    reflection = np.stack([np.stack([x, y], -1), np.stack([y, -x], -1)], -2)
    R = np.where(by_turn, rotation, reflection) @ Q.swapaxes(1, 2)
    c = np.einsum("fkac,fac->fk", M, R) / 2
    largest = np.take_along_axis(c, np.abs(c).argmax(1)[:, None], 1)
    sign = np.where(largest < 0, -1.0, 1.0)
    return sign[..., None] * R, sign * c


def _alternate(
    Y: Floats, B: Floats, R: Floats, c: Floats, sparsity: float, *, polish: bool
) -> Floats:
    """Return poses (f, p, 3) in the camera's axes from alternating minimisation.

    `polish`: rotations by steps that never raise the error, instead of a polar factor.
    """
    R, c = R.copy(), c.copy()
    frames, last = np.arange(len(Y)), np.full(len(Y), np.inf)
    for _ in range(200):
        images = Y[frames]
        S = np.einsum("fk,kcp->fcp", c[frames], B, optimize=True)
        R[frames] = _polished(images, S, R[frames]) if polish else polar(images @ np.linalg.pinv(S))
        c[frames] = _sparse_codes(images, R[frames], B, c[frames], sparsity)
        S = np.einsum("fk,kcp->fcp", c[frames], B, optimize=True)
        cost = 0.5 * ((images - R[frames] @ S) ** 2).sum((1, 2))
        cost += sparsity * np.abs(c[frames]).sum(1)
        left = np.abs(last[frames] - cost) >= 1e-4
        last[frames] = cost
        frames = frames[left]
        if not len(frames):
            break
    S = np.einsum("fk,kcp->fpc", c, B, optimize=True)
    poses: Floats = S @ rotation_from_camera(R.swapaxes(1, 2)).swapaxes(1, 2)
    return poses


def _polished(Y: Floats, S: Floats, R: Floats) -> Floats:
    """Return R (f, 2, 3) of lower |Y - R S|: polar factors of gradient steps, S (f, 3, p)."""
    gram, right = S @ S.swapaxes(1, 2), Y @ S.swapaxes(1, 2)
    bound = np.linalg.eigvalsh(gram)[:, -1][:, None, None]
    for _ in range(20):
        R = polar(bound * R + right - R @ gram)
    return R


def _sparse_codes(Y: Floats, R: Floats, B: Floats, c: Floats, sparsity: float) -> Floats:
    """Return c (f, K): min |Y - R sum c_k B_k|^2 / 2 + sparsity |c|_1, by accelerated steps."""
    A = np.einsum("fac,kcp->fkap", R, B, optimize=True).reshape(len(Y), len(B), -1)
    gram, right = A @ A.swapaxes(1, 2), (A @ Y.reshape(len(Y), -1, 1))[..., 0]
    bound = np.linalg.norm(gram, axis=(1, 2))[:, None]
    bound = np.minimum(bound, np.abs(gram).sum(2).max(1)[:, None])
    ahead, momentum = c, 1.0
    for _ in range(100):
        step = ahead - ((gram @ ahead[..., None])[..., 0] - right) / bound
        new = np.sign(step) * np.maximum(np.abs(step) - sparsity / bound, 0)
        following = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        # Where the step turns against the momentum, start again without it.
        against = ((ahead - new) * (new - c)).sum(1, keepdims=True) > 0
        ahead = new + np.where(against, 0.0, (momentum - 1) / following) * (new - c)
        change = np.linalg.norm(new - c) / max(float(np.linalg.norm(new)), 1e-12)
        c, momentum = new, following
        if change < 1e-4:
            break
    return c
