# SPDX-License-Identifier: Apache-2.0
"""Block-sparse dictionary learning of Kong and Lucey: "Sparse" in the paper's Table 1.

Kong and Lucey, "Prior-less compressible structure from motion", CVPR 2016. Each shape is a
combination of few of K atoms, S_f = sum_k c_fk B_k, so that the image is block sparse too:
W_f = sum_k d_fk D_k^T with blocks d_fk = c_fk R_f G_k^-1 (2, 3) and D_k^T = G_k B_k. First the
factorisation (ADMM, then block K-SVD), then a closed form for cameras and codes.

Letters: f frames, p points, K atoms, s active atoms a frame; D (K, p, 3), d (f, K, 2, 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.factorisation.block_matrix import gram_matrix
from deep_nrsfm_ros.nrsfm.factorisation.rigid import quadratic, symmetric
from deep_nrsfm_ros.nrsfm.geometry import back_project, polar

Floats = NDArray[Any]

EIGENVALUE_FLOOR = 0.05
"""Smallest eigenvalue of a repaired Gram matrix, relative to the largest: G has to be inverted. Of
0, 0.001, 0.01, 0.05 and 0.2 the best on a batch of CMU 127, by the truth."""
POINT_NORM = 4.0
"""Norm of each point over all images during the factorisation."""
FOCUSS_RIDGE, FOCUSS_DECAY, FOCUSS_FLOOR = 6e-3, 0.9, 1e-15
"""Tikhonov weight of block FOCUSS in the first round, its factor a round, and its least value."""
FOCUSS_STEPS, FOCUSS_MORE = 10, 60
"""Iterations of block FOCUSS, and those at most until few enough blocks are active."""


@dataclass(frozen=True)
class Effort:
    """Iterations and weight of the factorisation.

    Attributes:
        admm: iterations of the start.
        ksvd: iterations of block K-SVD.
        gamma: weight of the block norms in the start.
    """

    admm: int = 500
    ksvd: int = 40
    gamma: float = 1.0


class Factors(NamedTuple):
    """W_f = sum_k d_fk D_k^T.

    Attributes:
        D: (K, p, 3).
        d: (f, K, 2, 3), zero where an atom is not active.
    """

    D: Floats
    d: Floats

    def images(self) -> Floats:
        """Return the images (f, p, 2)."""
        W: Floats = np.einsum("kpc,fkac->fpa", self.D, self.d, optimize=True)
        return W


class _Views(NamedTuple):
    """Each atom's cameras and codes by themselves.

    Attributes:
        G: (K, 3, 3) corrective matrices.
        c: (f, K) codes, 0 where an atom is not active.
        r: (f, K, 2, 3) cameras, up to one rotation for each atom and a sign.
    """

    G: Floats
    c: Floats
    r: Floats


def sparse(
    W: Floats,
    K: int,
    active: int,
    *,
    repaired: bool = True,
    focuss: bool = False,
    effort: Effort = Effort(),
    seed: int = 0,
) -> Floats:
    """Return the shapes (f, p, 3) of a block-sparse factorisation.

    Args:
        W: (f, p, 2) images.
        K: number of atoms.
        active: atoms a frame, s.
        repaired: positive Gram matrices, rotations between atoms from all frames that they share,
            cameras from all atoms, and shapes moved onto the images. Otherwise as the authors'
            program does: absolute eigenvalues, two random frames, the first camera.
        focuss: code by block FOCUSS, as the authors' program does for motion capture, otherwise by
            block orthogonal matching pursuit, as it does for synthetic data.
        effort: iterations.
        seed: of the start.
    """
    rng = np.random.default_rng(seed)
    size = np.maximum(np.linalg.norm(W, axis=(0, 2)), 1e-12) / POINT_NORM
    D, d = factorise(W / size[:, None], K, active, effort, rng, focuss=focuss)
    return recover(Factors(D * size[:, None], d), W, rng, repaired=repaired)


def factorise(
    W: Floats,
    K: int,
    active: int,
    effort: Effort,
    rng: np.random.Generator,
    *,
    focuss: bool = False,
) -> Factors:
    """Return a factorisation with at most `active` blocks a frame; W (f, p, 2)."""
    f, p, _ = W.shape
    Y = W.astype(np.float64).transpose(1, 0, 2).reshape(p, 2 * f)
    D: Floats = _start(Y, K, effort, rng).reshape(p, K, 3)
    D /= np.maximum(np.linalg.norm(D, axis=0), 1e-12)
    X: Floats = np.zeros((K, 3, f, 2))
    best, lowest, escaped = (D, X), np.inf, 0
    for i in range(effort.ksvd):
        if focuss:
            ridge = max(FOCUSS_RIDGE * FOCUSS_DECAY**i, FOCUSS_FLOOR)
            X = _block_focuss(Y, D, active, _blurred(X, rng), ridge)
        else:
            X = _block_omp(Y, D, active)
        D, X = _update_atoms(Y, D.copy(), X.copy())
        cost = float(np.linalg.norm(Y - _product(D, X)))
        fell = lowest - cost
        if fell > 0:
            lowest, best = cost, (D, X)
        if cost < 2e-4:
            break
        if fell < 0.1 and i - escaped >= 10 and i < effort.ksvd - 10:
            escaped, D = i, _replace_unused(Y, D, X, active, rng)
    D, X = best
    return Factors(D.transpose(1, 0, 2), X.transpose(2, 0, 3, 1))


def _product(D: Floats, X: Floats) -> Floats:
    """Return D X (p, 2f) of D (p, K, 3) and X (K, 3, f, 2)."""
    product: Floats = D.reshape(len(D), -1) @ X.reshape(D[0].size, -1)
    return product


def _start(Y: Floats, K: int, effort: Effort, rng: np.random.Generator) -> Floats:
    """Return a dictionary (p, 3K): min |Y - A X|^2 / 2 + gamma sum |X_kf|_F, columns <= 1.

    ADMM with a sparse copy C of X and a bounded copy E of A.
    """
    p, columns = Y.shape
    A: Floats = rng.standard_normal((p, 3 * K))
    X: Floats = rng.standard_normal((3 * K, columns))
    LX, LA, rho, mu = np.zeros_like(X), np.zeros_like(A), 0.1, 100.0
    for _ in range(effort.admm):
        blocks = (X + LX / rho).reshape(K, 3, -1, 2)
        norm = np.sqrt((blocks**2).sum((1, 3), keepdims=True))
        C = blocks * np.maximum(1 - effort.gamma / rho / np.maximum(norm, 1e-12), 0)
        C = C.reshape(X.shape)
        E = A + LA / mu
        E /= np.maximum(np.linalg.norm(E, axis=0), 1)
        A = np.linalg.solve(X @ X.T + mu * np.eye(3 * K), (Y @ X.T + mu * E - LA).T).T
        X = np.linalg.solve(A.T @ A + rho * np.eye(3 * K), A.T @ Y + rho * C - LX)
        LA += mu * (A - E)
        LX += rho * (X - C)
        rho, mu = min(1.001 * rho, 10), min(1.01 * mu, 1e6)
    return E


def _block_omp(Y: Floats, D: Floats, active: int) -> Floats:
    """Return X (K, 3, f, 2) with `active` blocks a frame, by block orthogonal matching pursuit."""
    p, K, _ = D.shape
    f = Y.shape[1] // 2
    flat, basis = D.reshape(p, -1), np.linalg.qr(D.transpose(1, 0, 2))[0]
    gram, right = flat.T @ flat + 1e-9 * np.eye(3 * K), (flat.T @ Y).reshape(3 * K, f, 2)
    chosen = np.zeros((f, 0), np.int64)
    left, X = Y, np.zeros((K, 3, f, 2))
    for _ in range(active):
        correlation = np.einsum("kpc,pm->kcm", basis, left, optimize=True)
        score = (correlation.reshape(K, 3, f, 2) ** 2).sum((1, 3)).T
        np.put_along_axis(score, chosen, -1, 1)
        chosen = np.concatenate([chosen, score.argmax(1)[:, None]], 1)
        rows = (3 * chosen[:, :, None] + np.arange(3)).reshape(f, -1)
        codes = np.linalg.solve(
            gram[rows[:, :, None], rows[:, None, :]], right[rows, np.arange(f)[:, None]]
        )
        flat_X = np.zeros((3 * K, f, 2))
        flat_X[rows, np.arange(f)[:, None]] = codes
        X = flat_X.reshape(K, 3, f, 2)
        left = Y - _product(D, X)
    return X


def _blurred(X: Floats, rng: np.random.Generator) -> Floats:
    """Return X (K, 3, f, 2) plus noise of its own size, or noise alone if it is zero."""
    size = float(np.sqrt((X**2).mean())) or 1.0
    blurred: Floats = X + size * rng.standard_normal(X.shape)
    return blurred


def _block_focuss(Y: Floats, D: Floats, active: int, X: Floats, ridge: float) -> Floats:
    """Return X (K, 3, f, 2) with at most `active` blocks a frame, by block FOCUSS.

    x <- W A^T (A W A^T + ridge)^-1 y with the weights W = (|x_k| / max|D_k|)^2 of the blocks:
    small blocks vanish. The ridge of a frame grows by half while too many of its blocks are active.

    Args:
        Y: (p, 2f) images.
        D: (p, K, 3) dictionary.
        active: blocks of a frame at most.
        X: (K, 3, f, 2) start.
        ridge: Tikhonov weight at the start.
    """
    p, K, _ = D.shape
    y, atoms = Y.reshape(p, -1, 2).swapaxes(0, 1), D.transpose(1, 0, 2)
    products = (atoms @ atoms.swapaxes(1, 2)).reshape(K, -1)
    scale = 1 / np.maximum(np.abs(atoms).max((1, 2)), 1e-12)
    x = X.transpose(2, 0, 1, 3).copy()
    ridges, crowded = np.full(len(x), ridge), np.arange(len(x))
    for i in range(FOCUSS_STEPS + FOCUSS_MORE):
        norm = np.sqrt((x[crowded] ** 2).sum((2, 3)))
        norm = np.where(norm < 1e-5 * norm.max(1, keepdims=True), 0, norm)
        if i >= FOCUSS_STEPS:
            left = (norm > 0).sum(1) > active
            crowded, norm = crowded[left], norm[left]
            if not len(crowded):
                break
            ridges[crowded] *= 1.5
        weight = (scale * norm) ** 2
        system = (weight @ products).reshape(-1, p, p)
        system += ridges[crowded, None, None] * np.eye(p)
        z = np.linalg.solve(system, y[crowded])
        x[crowded] = weight[:, :, None, None] * (atoms.swapaxes(1, 2) @ z[:, None])
    norm = (x**2).sum((2, 3))
    beyond = np.argsort(-norm, axis=1)[:, active:]
    np.put_along_axis(x, beyond[:, :, None, None], 0.0, 1)
    coded: Floats = x.transpose(1, 2, 0, 3)
    return coded


def _update_atoms(Y: Floats, D: Floats, X: Floats) -> tuple[Floats, Floats]:
    """Return D and X after one rank-three update of each atom on the frames that use it."""
    p = len(Y)
    left = (Y - _product(D, X)).reshape(p, -1, 2)
    for k in range(D.shape[1]):
        used = np.flatnonzero((X[k] != 0).any((0, 2)))
        if len(used) < 2:
            continue
        own = left[:, used] + np.einsum("pc,cfa->pfa", D[:, k], X[k][:, used])
        columns = own.reshape(p, -1)
        D[:, k] = np.linalg.eigh(columns @ columns.T)[1][:, -3:]
        X[k][:, used] = (D[:, k].T @ columns).reshape(3, -1, 2)
        left[:, used] = own - np.einsum("pc,cfa->pfa", D[:, k], X[k][:, used])
    return D, X


def _replace_unused(
    Y: Floats, D: Floats, X: Floats, active: int, rng: np.random.Generator
) -> Floats:
    """Return D with each little used atom replaced by a badly explained frame and noise."""
    p, K, _ = D.shape
    f = Y.shape[1] // 2
    left = (Y - _product(D, X)).reshape(p, f, 2)
    worst = np.argsort(-(left**2).sum((0, 2)))
    uses = (X != 0).any((1, 3)).sum(1)
    D = D.copy()
    for i, k in enumerate(np.flatnonzero(uses < 0.2 * f * active / K)):
        atom = np.concatenate([Y.reshape(p, f, 2)[:, worst[i]], rng.standard_normal((p, 1))], 1)
        D[:, k] = atom / np.linalg.norm(atom, axis=0)
    return D


def recover(
    factors: Factors, W: Floats, rng: np.random.Generator, *, repaired: bool = True
) -> Floats:
    """Return the shapes (f, p, 3) of a factorisation of the images W (f, p, 2)."""
    views = _views(factors, repaired=repaired)
    R, c, G = _synchronise(views, rng, repaired=repaired)
    atoms = np.linalg.pinv(G) @ factors.D.swapaxes(1, 2)
    S: Floats = np.einsum("fk,kcp->fpc", c, atoms, optimize=True)
    return back_project(S, R.swapaxes(1, 2), W) if repaired else S


def _views(factors: Factors, *, repaired: bool) -> _Views:
    """Return cameras and codes of each atom: d_fk G_k = c_fk r_fk with orthonormal r_fk.

    With Q = G G^T each frame gives x Q x = y Q y and x Q y = 0.
    """
    f, K = factors.d.shape[:2]
    views = _Views(np.zeros((K, 3, 3)), np.zeros((f, K)), np.zeros((f, K, 2, 3)))
    for k in range(K):
        used = np.flatnonzero((factors.d[:, k] ** 2).sum((1, 2)) > 1e-12)
        # Six unknowns and a scale: two equations a frame.
        if len(used) < 3:
            continue
        d = factors.d[used, k]
        x, y = d[:, 0], d[:, 1]
        A = np.concatenate([quadratic(x, x) - quadratic(y, y), quadratic(x, y)])
        Q = symmetric(np.linalg.svd(A)[2][-1], 3)
        values, vectors = np.linalg.eigh(Q * np.sign(np.trace(Q)))
        if repaired and values[0] < 0:
            Q = gram_matrix(d / np.sqrt((d**2).mean()), trace=0.0)
            values, vectors = np.linalg.eigh(Q)
            values = np.maximum(values, EIGENVALUE_FLOOR * values[-1])
        views.G[k] = vectors * np.sqrt(np.abs(values))
        turned = d @ views.G[k]
        views.c[used, k] = np.linalg.norm(turned, axis=2).mean(1)
        views.r[used, k] = polar(turned)
    return views


def _synchronise(
    views: _Views, rng: np.random.Generator, *, repaired: bool
) -> tuple[Floats, Floats, Floats]:
    """Return cameras R (f, 2, 3), signed codes c (f, K) and G (K, 3, 3) in one object frame."""
    f, K = views.c.shape
    uses, c, G = views.c > 0, views.c.copy(), views.G.copy()
    R, known = np.zeros((f, 2, 3)), np.zeros(f, bool)
    total, open_atoms = np.zeros((f, 2, 3)), set(np.flatnonzero(uses.any(0)).tolist())
    while open_atoms:
        k = max(open_atoms, key=lambda k: (int((uses[:, k] & known).sum()), int(uses[:, k].sum())))
        open_atoms.remove(k)
        shared, r = uses[:, k] & known, views.r[:, k]
        turn = _rotation_between(r[shared], R[shared], rng, repaired=repaired)
        turned = r @ turn
        G[k] = G[k] @ turn
        sign = np.where(shared & ((turned * R).sum((1, 2)) < 0), -1.0, 1.0)
        c[:, k] *= sign
        total += (c[:, k] * uses[:, k])[:, None, None] * turned
        new = uses[:, k] & ~known
        R[new] = turned[new]
        if repaired:
            R[uses[:, k]] = polar(total[uses[:, k]])
        known |= uses[:, k]
    return R, c, G


def _rotation_between(r: Floats, R: Floats, rng: np.random.Generator, *, repaired: bool) -> Floats:
    """Return the orthonormal T (3, 3) with r_f T = R_f up to a sign of each frame."""
    if not len(r):
        return np.eye(3)
    if not repaired:
        pair = rng.choice(len(r), 2, replace=len(r) < 2)
        found = []
        for sign in (1.0, -1.0):
            first = r[pair] * np.array([sign, 1.0])[:, None, None]
            T = _procrustes(first, R[pair])
            found.append((float(_misfit(r @ T, R).max()), T))
        return found[0][1] if found[0][0] <= 0.1 else found[1][1]
    best, lowest = np.eye(3), np.inf
    for _ in range(10):
        T = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        for _ in range(30):
            sign = np.sign((r @ T * R).sum((1, 2), keepdims=True))
            T = _procrustes(sign * r, R)
        misfit = float(_misfit(r @ T, R).sum())
        if misfit < lowest:
            best, lowest = T, misfit
    return best


def _misfit(r: Floats, R: Floats) -> Floats:
    """Return the squared distances (f,) of cameras, of the better sign."""
    misfit: Floats = ((r**2) + R**2).sum((1, 2)) - 2 * np.abs((r * R).sum((1, 2)))
    return misfit


def _procrustes(r: Floats, R: Floats) -> Floats:
    """Return the orthonormal T (3, 3) that minimises sum |r_f T - R_f|^2."""
    U, _, Vt = np.linalg.svd(r.reshape(-1, 3).T @ R.reshape(-1, 3))
    T: Floats = U @ Vt
    return T
