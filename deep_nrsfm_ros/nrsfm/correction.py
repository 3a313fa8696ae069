"""What the reprojection error tells about the shape, depth included.

The errors E = S* - S of a network hang together: where a hand comes out too low, so does the
wrist, and both are off in depth as well. Their second moment Sigma needs no 3D label: shapes of
the training frames, seen by random cameras, are known when they are lifted again. Given what is
left over of the keypoints, r = W - S M = E M + noise, the mean of a Gaussian E is

    Sigma H^T (H Sigma H^T + noise^2 I)^-1 r,    H E = E M.

For Sigma = I and no noise this is back-projection, S + (W - S M) M^T. Ours, not in the paper.

A perspective camera sees each point along its own ray (u, v, 1): with the depth d of the centre,
x + t_x = u (z + d) says that the point's own M = R^T [e_x - u e_z, e_y - v e_z] takes it to
W = d (u, v), up to the translation, and all of the above holds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.nrsfm.geometry import Floats, centre, random_cameras, rotation_from_camera

_ROUNDS = 2
_FLOOR = 1e-4  # variance of every direction, relative to the mean: any keypoints can be met
_BLOCK = 64  # frames at a time: more do not fit the cache, and take five times as long
UNKNOWN = 1e4  # variance of what is not known at all, relative to that of the errors


def correct(
    S: Floats,
    M: Floats,
    W: Floats,
    visible: NDArray[np.bool_],
    covariance: Floats,
    noise: Floats | float = 0.0,
) -> Floats:
    """Return S (n, p, 3) moved towards the visible of the keypoints W (n, p, 2).

    M: (n, 3, 2) cameras, or (n, p, 3, 2), one of each point. covariance: (3p, 3p) of the errors in
    the axes of S. noise: standard deviation (n,) of the keypoints' coordinates; 0 meets them
    exactly, but for a translation, which may be any. Missing keypoints follow the others.
    """
    n, p, _ = S.shape
    noise = np.broadcast_to(noise, n)
    if n > _BLOCK:
        blocks = (slice(i, i + _BLOCK) for i in range(0, n, _BLOCK))
        return np.concatenate(
            [correct(S[b], M[b], W[b], visible[b], covariance, noise[b]) for b in blocks]
        )
    M = (M if M.ndim == 4 else M[:, None]).astype(np.float64)
    CH = covariance.reshape(3 * p, p, 3).swapaxes(0, 1) @ M  # (n, p, 3p, 2)
    CH = CH.swapaxes(1, 2).reshape(n, p, 3, 2 * p)
    A = M.swapaxes(-1, -2) @ CH  # H Sigma H^T
    unknown = UNKNOWN * np.trace(covariance) / (3 * p)
    # Not quite zero, so that there is an answer even where M is no camera.
    spread = np.where(visible, np.square(noise)[:, None] + 1e-12 * unknown, unknown)  # (n, p)
    A = A.reshape(n, p, 2, p, 2)
    for axis in range(2):
        A[:, :, axis, :, axis] += unknown  # of the translation, the same for all points
        A[:, range(p), axis, range(p), axis] += spread
    r = (W - (S[..., None, :] @ M)[..., 0, :]) * visible[..., None]
    x = np.linalg.solve(A.reshape(n, 2 * p, 2 * p), r.reshape(n, 2 * p, 1))
    E = (CH.reshape(n, 3 * p, 2 * p) @ x).reshape(n, p, 3)
    corrected: Floats = S + E.astype(S.dtype)
    return corrected


def error_covariance(
    lift: Callable[[Floats], tuple[Floats, Floats, Floats]],
    W: Floats,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Return the second moment (3p, 3p) of a network's errors, found without labels.

    lift: gives S (n, p, 3), M (n, 3, 2) and the keypoints as the network took them (n, p, 2),
    centred and in units of S. W: (n, p, 2) complete keypoints.
    """
    _, p, _ = W.shape
    everything = np.ones(W.shape[:2], bool)
    covariance = np.eye(3 * p)
    for _ in range(_ROUNDS):
        T = centre(correct(*lift(W), everything, covariance))
        Q = random_cameras(len(T), rng)
        S, M, seen = lift(T @ Q)
        unit = np.linalg.norm(seen, axis=(1, 2)) / np.linalg.norm(T @ Q, axis=(1, 2))
        # The same shape where M, in place of Q, sees it alike.
        T = unit[:, None, None] * T @ rotation_from_camera(Q).swapaxes(1, 2)
        E = (T @ rotation_from_camera(M) - S).reshape(len(T), 3 * p).astype(np.float64)
        covariance = E.T @ E / len(E)
        covariance += _FLOOR * np.trace(covariance) / (3 * p) * np.eye(3 * p)
    return covariance.astype(np.float32)
