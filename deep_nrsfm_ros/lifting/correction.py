"""What the reprojection error tells about the shape, depth included.

The errors E = S* - S of a network hang together: where a hand comes out too low, so does the
wrist, and both are off in depth as well. Their second moment Sigma needs no 3D label: shapes of
the training frames, seen by random cameras, are known when they are lifted again. Given what is
left over of the keypoints, r = W - S M = E M + noise, the mean of a Gaussian E is

    Sigma H^T (H Sigma H^T + noise^2 I)^-1 r,    H E = E M.

For Sigma = I and no noise this is back-projection, S + (W - S M) M^T. Ours, not in the paper.

Lengths of bones are further observations, once the keypoints have moved the shape; see `bones`.

A perspective camera sees each point along its own ray (u, v, 1): with the depth d of the centre,
x + t_x = u (z + d) says that the point's own M = R^T [e_x - u e_z, e_y - v e_z] takes it to
W = d (u, v), up to the translation, and all of the above holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.nrsfm.bones import Bones, shares
from deep_nrsfm_ros.nrsfm.geometry import Floats, centre, random_cameras, rotation_from_camera

_ROUNDS = 2
_FLOOR = 1e-4  # variance of every direction, relative to the mean: any keypoints can be met
_BLOCK = 64  # frames at a time: more do not fit the cache, and take five times as long
_LEAST_SHARE = 0.3  # of the deviation of a length, that is the object's own in any case
_LEAST_SPREAD = 0.01  # of a length: no bone is known better
_SHORTEST = 1e-6  # share of all lengths, where two keypoints are one
UNKNOWN_VARIANCE = 1e4  # variance of what is not known at all, relative to that of the errors


def correct(
    S: Floats,
    M: Floats,
    W: Floats,
    visible: NDArray[np.bool_],
    covariance: Floats,
    noise: Floats | float = 0.0,
    bones: Bones | None = None,
) -> Floats:
    """Return S (n, p, 3) moved towards the visible of the keypoints W (n, p, 2).

    M: (n, 3, 2) cameras, or (n, p, 3, 2), one of each point. covariance: (3p, 3p) of the errors in
    the axes of S. noise: standard deviation (n,) of the keypoints' coordinates; 0 meets them
    exactly, but for a translation, which may be any. Missing keypoints follow the others.
    bones: lengths that the shape should have as well, about where the keypoints move it.
    """
    n, p, _ = S.shape
    noise = np.broadcast_to(noise, n)
    if n > _BLOCK:
        parts = [
            correct(S[b], M[b], W[b], visible[b], covariance, noise[b], bones)
            for b in slices(n, _BLOCK)
        ]
        return np.concatenate(parts)
    M = (M if M.ndim == 4 else M[:, None]).astype(np.float64)
    H: Floats = np.zeros((n, p, 2, p, 3))
    H[:, range(p), :, range(p)] = np.broadcast_to(M, (n, p, 3, 2)).transpose(1, 0, 3, 2)
    H = H.reshape(n, 2 * p, 3 * p)
    unknown = UNKNOWN_VARIANCE * np.trace(covariance) / (3 * p)
    least = 1e-12 * unknown  # not quite zero: there is an answer even where M is no camera
    spread = np.where(visible, np.square(noise)[:, None] + least, unknown)  # (n, p)
    R: Floats = np.zeros((n, p, 2, p, 2))
    for axis in range(2):
        R[:, :, axis, :, axis] = unknown  # of the translation, the same for all points
        R[:, range(p), axis, range(p), axis] += spread
    R = R.reshape(n, 2 * p, 2 * p)
    r = ((W - (S[..., None, :] @ M)[..., 0, :]) * visible[..., None]).reshape(n, 2 * p)
    E = _mean(covariance, H, R, r)
    if bones is not None:
        G, wanted, varies = bones.length_constraint(S + E.reshape(S.shape))
        b = wanted.shape[1]
        R = np.pad(R, ((0, 0), (0, b), (0, b)))
        R[:, 2 * p :, 2 * p :] = varies + least * np.eye(b)
        r = np.concatenate((r, wanted + (G @ E[..., None])[..., 0]), 1)
        E = _mean(covariance, np.concatenate((H, G), 1), R, r)
    corrected: Floats = S + E.reshape(S.shape).astype(S.dtype)
    return corrected


def _mean(covariance: Floats, H: Floats, R: Floats, r: Floats) -> Floats:
    """Return the mean (n, 3p) of errors of which H (n, k, 3p) shows r (n, k), with noise R."""
    CH = covariance @ H.swapaxes(1, 2)
    E: Floats = (CH @ np.linalg.solve(H @ CH + R, r[..., None]))[..., 0]
    return E


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


def bone_lengths(
    lift: Callable[[Floats], tuple[Floats, Floats, Floats]],
    W: Floats,
    pairs: Sequence[tuple[int, int]],
    covariance: Floats,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Return the lengths and spread (b, 2) of bones, as those of `Bones`, found without labels.

    lift, W: as in `error_covariance`, which gives the covariance. pairs: of keypoints.
    """
    if not pairs:
        return np.zeros((0, 2), np.float32)
    everything = np.ones(W.shape[:2], bool)
    T = centre(correct(*lift(W), everything, covariance))
    again = correct(*lift(T @ random_cameras(len(T), rng)), everything, covariance)
    found, found_again = shares(T, pairs), shares(again, pairs)
    lengths, variance = np.maximum(found.mean(0), _SHORTEST), found.var(0)
    error = ((found_again - found) ** 2).mean(0)
    least = np.maximum(_LEAST_SHARE**2 * variance, (_LEAST_SPREAD * lengths) ** 2)
    return np.stack((lengths, np.sqrt(np.maximum(variance - error, least))), 1).astype(np.float32)
