# SPDX-License-Identifier: Apache-2.0
"""Dictionaries of 3D poses, which the supervised methods of the paper's Table 3 learn from labels.

Shapes here are S (f, p, 3), dictionaries B (K, 3, p). All shapes share one unit: the mean over
frames and axes of the standard deviation over points is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from deep_nrsfm_ros.nrsfm.geometry import align, centre

Floats = NDArray[Any]

JOINTS15 = (
    *("root", "lhipjoint", "lfemur", "ltibia", "rhipjoint", "rfemur", "rtibia", "thorax", "head"),
    *("lclavicle", "lhumerus", "lhand", "rclavicle", "rhumerus", "rhand"),
)
"""The joints of Ramakrishna et al. and Zhou et al.: hips, knees, ankles, thorax, head, shoulders,
elbows and hands, by the CMU bones that end there."""
LIMBS15 = (
    *((0, 1), (1, 2), (2, 3), (0, 4), (4, 5), (5, 6), (0, 7), (7, 8)),
    *((7, 9), (9, 10), (10, 11), (7, 12), (12, 13), (13, 14)),
)
"""Limbs between them."""
TORSO15 = (0, 1, 4, 7)
"""Root, hips and thorax: the rotation of a pose and the first camera follow from these."""


def mean_deviation(S: Floats) -> float:
    """Return the mean over frames and axes of the standard deviation over points."""
    return float(S.std(-2).mean())


def normalised_poses(S: Floats, torso: Sequence[int] = TORSO15) -> Floats:
    """Return poses (f, p, 3), centred, in the common unit, each turned onto the first.

    The rotation is the proper one that aligns the torso.
    """
    S = centre(S.astype(np.float64))
    S = S / mean_deviation(S)
    part = centre(S[:, list(torso)])
    turned: Floats = S @ align(part, np.broadcast_to(part[0], part.shape)).rotation
    return turned


def sparse_dictionary(poses: Floats, K: int, sparsity: float, *, iterations: int = 300) -> Floats:
    """Return K atoms (K, 3, p) whose non-negative sparse combinations are the poses (f, p, 3).

    min |Y - D X|^2 / 2 + sparsity sum X subject to X >= 0 and |D_k| <= the mean norm of a pose.
    Zhou, Leonardos, Hu and Daniilidis, CVPR 2015: starts from poses evenly spaced in time; each
    iteration has proximal steps of X and one gradient step of D.
    """
    f, p, _ = poses.shape
    Y = poses.transpose(0, 2, 1).reshape(f, -1).T
    D = Y[:, np.linspace(0, f - 1, K).round().astype(int)]
    bound = float(np.linalg.norm(D, axis=0).mean())
    X = np.maximum(np.linalg.pinv(D) @ Y, 0)
    last = np.inf
    for _ in range(iterations):
        gram, right = D.T @ D, D.T @ Y
        step = 1 / np.linalg.norm(gram, 2)
        for _ in range(20):
            X = np.maximum(X - step * (gram @ X - right + sparsity), 0)
        D = D - (D @ X - Y) @ X.T / np.linalg.norm(X @ X.T, 2)
        D = D * np.minimum(1, bound / np.maximum(np.linalg.norm(D, axis=0), 1e-12))
        cost = 0.5 * float(((D @ X - Y) ** 2).sum()) + sparsity * float(X.sum())
        if last - cost < 1e-6 * cost:
            break
        last = cost
    return D.T.reshape(K, 3, p)


def class_dictionary(
    poses: Floats, classes: int = 10, *, variance: float = 0.99, seed: int = 0
) -> tuple[Floats, Floats]:
    """Return the mean pose (3, p) and the principal components (K, 3, p) of classes of poses.

    Ramakrishna, Kanade and Sheikh, ECCV 2012, have the classes of the motions; here they are
    clusters of poses. Components have unit norm and explain `variance` of their class.
    """
    f, p, _ = poses.shape
    Y = poses.transpose(0, 2, 1).reshape(f, -1)
    label = kmeans2(Y, classes, minit="++", seed=np.random.default_rng(seed))[1]
    atoms = []
    for k in range(classes):
        own = Y[label == k]
        if len(own) < 2:
            continue
        _, s, Vt = np.linalg.svd(own - own.mean(0), full_matrices=False)
        share = np.cumsum(s**2) / max(float((s**2).sum()), 1e-12)
        atoms.append(Vt[: int(np.searchsorted(share, variance)) + 1])
    return Y.mean(0).reshape(3, p), np.concatenate(atoms).reshape(-1, 3, p)
