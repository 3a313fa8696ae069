# SPDX-License-Identifier: Apache-2.0
"""Projected matching pursuit of Ramakrishna, Kanade and Sheikh: "PMP" in the paper's Table 3.

"Reconstructing 3D human pose from 2D image landmarks", ECCV 2012. A pose is the mean mu and few
atoms, X = mu + sum a_k B_k; the sum of the squared limb lengths is that of the mean. Atoms are
added one at a time, the one that correlates most with the residual in the image first; after each,
coefficients and camera are found in turn.

Letters: y (2, p) image, mu (3, p), B (K, 3, p), M (2, 3) camera with the scale of each row.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import brentq

from benchmarks.baselines.pose_dictionary import LIMBS15, TORSO15
from deep_nrsfm_ros.nrsfm.geometry import polar, rotation_from_camera

Floats = NDArray[Any]

MAX_ATOMS = 15
"""Atoms of a pose at most."""
TOLERANCE = 2e-3
"""Sum of squared residuals, relative to the squared height of the image, at which a pose is done:
500 square pixels for a person of 500 pixels, as in the authors' program."""
TURNS = 8
"""First cameras about the vertical, of the variant with several starts."""


def pursue(
    W: Floats,
    mean: Floats,
    B: Floats,
    *,
    several_starts: bool = False,
    limbs: Sequence[tuple[int, int]] = LIMBS15,
    torso: Sequence[int] = TORSO15,
) -> Floats:
    """Return poses (f, p, 3) in the camera's axes.

    Args:
        W: (f, p, 2) images.
        mean: (3, p) mean pose.
        B: (K, 3, p) atoms of unit norm.
        several_starts: the least residual of the camera of the torso, its mirror image about the
            image plane, and `TURNS` turns about the vertical, instead of the first alone: the
            camera of four nearly planar joints is often wrong, and no later step mends it.
        limbs: pairs of points whose lengths are held in sum.
        torso: points that give the first camera.
    """
    poses = []
    for image in W.astype(np.float64):
        y = (image - image.mean(0)).T
        first = _camera(y[:, list(torso)], mean[:, list(torso)])
        cameras = [first, *(_other_cameras(first) if several_starts else ())]
        found = [_pursue_from(M, y, mean, B, limbs) for M in cameras]
        X, M, _ = min(found, key=lambda pose: pose[2])
        poses.append((rotation_from_camera(polar(M).T) @ X).T)
    return np.stack(poses)


def _other_cameras(M: Floats) -> list[Floats]:
    """Return the camera mirrored about the image plane, and turned about the vertical y."""
    R = rotation_from_camera(polar(M).T)
    scale = np.linalg.norm(M, axis=1, keepdims=True)
    others = [scale * (R * [1, 1, -1])[:2], scale * (R * [-1, 1, -1])[:2]]
    for i in range(1, TURNS):
        a = 2 * np.pi * i / TURNS
        turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        others.append(scale * (R @ turn)[:2])
    return others


def _pursue_from(
    M: Floats, y: Floats, mean: Floats, B: Floats, limbs: Sequence[tuple[int, int]]
) -> tuple[Floats, Floats, float]:
    """Return pose X (3, p), camera and squared residual, from a first camera."""
    done = TOLERANCE * float(np.ptp(y, axis=1).max()) ** 2
    chosen: list[int] = []
    X = mean
    residual = _residual(y, M, X)
    while (residual**2).sum() > done and len(chosen) < MAX_ATOMS:
        score = np.abs(np.einsum("ap,ac,kcp->k", residual, M, B, optimize=True))
        score[chosen] = -1
        chosen.append(int(score.argmax()))
        projected = M @ X
        for _ in range(30):
            a = limb_coefficients(y - _centred(M @ mean), M, mean, B[chosen], limbs)
            X = mean + np.tensordot(a, B[chosen], 1)
            M = _camera(y, X)
            moved = float(((M @ X - projected) ** 2).sum())
            projected = M @ X
            if moved < 1e-3 * done:
                break
        residual = _residual(y, M, X)
    return X, M, float((residual**2).sum())


def limb_coefficients(
    left: Floats, M: Floats, mean: Floats, B: Floats, limbs: Sequence[tuple[int, int]]
) -> Floats:
    """Return a (n,): min |left - M sum a_k B_k|^2 with the limbs' squared lengths as in the mean.

    The Lagrange multiplier l is the largest root of |C a(l) - d|^2 = |d|^2 with
    a(l) = (A^T A + l C^T C)^-1 (A^T b + l C^T d), right of all poles, where the left side falls
    from infinity.
    """
    i, j = np.array(limbs).T
    A = _centred(M @ B).reshape(len(B), -1).T
    C = (B[:, :, i] - B[:, :, j]).reshape(len(B), -1).T
    d = -(mean[:, i] - mean[:, j]).ravel()
    values, V = eigh(A.T @ A, C.T @ C + 1e-9 * np.trace(C.T @ C) / len(B) * np.eye(len(B)))
    b, limb = V.T @ (A.T @ left.ravel()), V.T @ (C.T @ d)

    def scaled(multiplier: float) -> Floats:
        """Return V^-1 a(l); the columns of C V are orthonormal."""
        q: Floats = (b + multiplier * limb) / (values + multiplier)
        return q

    def excess(multiplier: float) -> float:
        """Return |C a(l) - d|^2 - |d|^2."""
        q = scaled(multiplier)
        return float(q @ q - 2 * q @ limb)

    pole, scale = -float(values[0]), float(values[-1]) + 1e-12
    low, high = pole + 1e-9 * scale, pole + scale
    while excess(high) > 0 and high < 1e9 * scale:
        high = pole + 10 * (high - pole)
    if excess(low) <= 0 or excess(high) > 0:
        root = low if excess(low) <= 0 else high
    else:
        root = float(brentq(excess, low, high, xtol=1e-12 * scale, maxiter=200))
    a: Floats = V @ scaled(root)
    return a


def _camera(y: Floats, X: Floats) -> Floats:
    """Return M (2, 3): orthonormal rows, each with a scale, near the affine camera of y and X."""
    y, X = _centred(y), _centred(X)
    U, s, Vt = np.linalg.svd(y @ X.T @ np.linalg.pinv(X @ X.T), full_matrices=False)
    swapped = abs(U[0, 1]) > abs(U[0, 0])
    M: Floats = (s[::-1] if swapped else s)[:, None] * (U @ Vt)
    return M


def _residual(y: Floats, M: Floats, X: Floats) -> Floats:
    residual: Floats = y - _centred(M @ X)
    return residual


def _centred(X: Floats) -> Floats:
    """Return X (..., p) minus its mean over points."""
    centred: Floats = X - X.mean(-1, keepdims=True)
    return centred
