"""EM-PPCA of Torresani, Hertzmann and Bregler.

Here `basis` (1 + K, 3, p) is the mean shape and the modes, and z (f, 1 + K) their coefficients,
of which the first is one. Y (f, 2, p) are the images.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.rigid import rigid_rotations, rigid_shape
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_camera

Floats = NDArray[Any]


def em_ppca(W: Floats, K: int, *, iterations: int = 300) -> Floats:
    """Return the posterior mean of shapes that are a mean shape and K Gaussian modes.

    Torresani, Hertzmann and Bregler, "Nonrigid structure-from-motion: estimating shape and
    motion with hierarchical priors", PAMI 2008: EM-PPCA under orthography, without the linear
    dynamics. Starts from rigid factorisation and the principal modes of its residual.
    """
    f, p, _ = W.shape
    Y = W.astype(np.float64).swapaxes(1, 2)
    Q = rotation_from_camera(rigid_rotations(W).swapaxes(1, 2))
    mean = rigid_shape(W, Q[:, :2])
    residual = Y - Q[:, :2] @ mean.T
    variance = float((residual**2).mean())
    lifted = (Q[:, :2].swapaxes(1, 2) @ residual).reshape(f, -1)
    _, s, Vt = np.linalg.svd(lifted, full_matrices=False)
    modes = (s[:K, None] / f**0.5 * Vt[:K]).reshape(-1, 3, p)
    basis = np.concatenate((mean.T[None], modes))  # (1 + K, 3, p)
    for _ in range(iterations):
        z, zz = _posterior(Y, Q[:, :2], basis, variance)
        Q = _update_rotations(Y, Q, basis, z, zz)
        basis, variance = _fit_basis(Y, Q[:, :2], z, zz)
    z, _ = _posterior(Y, Q[:, :2], basis, variance)
    S: Floats = np.einsum("fk,kdp->fpd", z, basis)
    return S


def _posterior(Y: Floats, R: Floats, basis: Floats, variance: float) -> tuple[Floats, Floats]:
    """Return E[z] (f, 1 + K) and E[z z^T] (f, 1 + K, 1 + K) given the images Y (f, 2, p)."""
    f, K = len(Y), len(basis) - 1
    P = np.einsum("fad,kdp->fkap", R, basis).reshape(f, K + 1, -1)
    modes, left = P[:, 1:], Y.reshape(f, -1) - P[:, 0]
    covariance = np.linalg.inv(np.eye(K) + modes @ modes.swapaxes(1, 2) / variance)
    z = np.ones((f, K + 1))
    z[:, 1:] = (covariance @ (modes @ left[..., None]))[..., 0] / variance
    zz = z[:, :, None] * z[:, None, :]
    zz[:, 1:, 1:] += covariance
    return z, zz


def _update_rotations(Y: Floats, Q: Floats, basis: Floats, z: Floats, zz: Floats) -> Floats:
    """Return rotations Q (f, 3, 3) after one Gauss-Newton step of the expected error.

    Q <- exp([w]) Q, with E|y - (x + w cross x)|^2 over the first two rows of x = Q s.
    """
    inner = np.einsum("kdp,lep->kdle", basis, basis)
    second = np.einsum("fkl,kdle->fde", zz, inner)  # E[S S^T]
    cross_moment = np.einsum("fap,fk,kdp->fad", Y, z, basis) @ Q.swapaxes(1, 2)  # E[y x^T]
    B = Q @ second @ Q.swapaxes(1, 2)  # E[x x^T]
    E = cross_moment - B[:, :2]  # E[(y - x) x^T]
    # The first row moves by w_y x_z - w_z x_y, the second by w_z x_x - w_x x_z.
    H = np.empty((len(Y), 3, 3))
    H[:, 0, 0] = H[:, 1, 1] = B[:, 2, 2]
    H[:, 2, 2] = B[:, 0, 0] + B[:, 1, 1]
    H[:, 0, 1] = H[:, 1, 0] = 0
    H[:, 0, 2] = H[:, 2, 0] = -B[:, 0, 2]
    H[:, 1, 2] = H[:, 2, 1] = -B[:, 1, 2]
    H += 1e-9 * np.trace(B, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    gradient = np.stack((-E[:, 1, 2], E[:, 0, 2], E[:, 1, 0] - E[:, 0, 1]), 1)
    w = np.linalg.solve(H, gradient[..., None])[..., 0]
    w *= np.minimum(1, 0.3 / np.maximum(np.linalg.norm(w, axis=1), 1e-12))[:, None]
    updated: Floats = _rotation(w) @ Q
    return updated


def _rotation(w: Floats) -> Floats:
    """Return exp([w]) (f, 3, 3) of rotation vectors w (f, 3), by Rodrigues' formula."""
    angle = np.maximum(np.linalg.norm(w, axis=1), 1e-12)[:, None, None]
    X = np.cross(np.eye(3), w[:, None, :] / angle)
    rotation: Floats = np.eye(3) + np.sin(angle) * X + (1 - np.cos(angle)) * X @ X
    return rotation


def _fit_basis(Y: Floats, R: Floats, z: Floats, zz: Floats) -> tuple[Floats, float]:
    """Return mean and modes (1 + K, 3, p) and the noise variance of highest likelihood."""
    k, p = z.shape[1], Y.shape[2]
    normal = np.einsum("fkl,fad,fae->kdle", zz, R, R, optimize=True).reshape(3 * k, -1)
    right = np.einsum("fk,fad,fap->kdp", z, R, Y, optimize=True).reshape(3 * k, p)
    B = np.linalg.lstsq(normal, right, rcond=None)[0]
    variance = ((Y**2).sum() - (B * right).sum()) / Y.size
    return B.reshape(k, 3, p), max(float(variance), 1e-12)
