# SPDX-License-Identifier: Apache-2.0
"""Correct lifted shapes, depth included, by what the network leaves unexplained of the keypoints.

The errors E = S* - S of a network's points are correlated: where a hand is lifted too low, the
wrist is too, and both have an error of depth. Their second moment Sigma is estimated without 3D
labels: shapes lifted from the training frames are projected by random cameras and lifted again.
Given the residual of the keypoints, r = W - S M = E M + noise, the mean of a Gaussian E is

    Sigma H^T (H Sigma H^T + noise^2 I)^-1 r,    H E = E M.

With Sigma = I and no noise this is back-projection, S + (W - S M) M^T.

The lengths of bones are further measurements. They are linearised about the shape that the
keypoints have corrected; see `nrsfm.bones`.

A perspective camera sees each point along its own ray (u, v, 1). With the depth d of the centre,
x + t_x = u (z + d): the point's own M = R^T [e_x - u e_z, e_y - v e_z] projects it to W = d (u, v)
up to the translation, and the equations above hold.

Symbols: S (n, p, 3) shapes, M (n, 3, 2) or (n, p, 3, 2) cameras, W (n, p, 2) keypoints, E errors,
H (n, k, 3p) measurement matrix, R (n, k, k) covariance of the measurements, r (n, k) residuals.

Source: ours, not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.lifting.gravity import Upright
from deep_nrsfm_ros.nrsfm.bones import Bones, relative_lengths
from deep_nrsfm_ros.nrsfm.geometry import Floats, centre, random_cameras, rotation_from_camera

Lift: TypeAlias = Callable[[Floats], tuple[Floats, Floats, Floats]]
"""Returns S (n, p, 3), M (n, 3, 2) and the centred keypoints (n, p, 2), in units of S, of
keypoints (n, p, 2)."""

_ROUNDS = 2
_MIN_VARIANCE = 1e-4  # of every direction, relative to the mean: any keypoints can be met
_BLOCK = 64  # frames at a time: more exceed the cache and take five times as long
_MIN_OWN_DEVIATION = 0.3  # share of a length's deviation that is always ascribed to the object
_MIN_LENGTH_DEVIATION = 0.01  # of a length: no bone is known more precisely
_MIN_DEVIATION_TOGETHER = 0.02  # the same of every combination of lengths
_MIN_LENGTH = 1e-6  # share of all lengths, for two keypoints at the same place
UNKNOWN_VARIANCE = (
    1e4  # of a missing keypoint and of the translation, relative to the mean of Sigma
)


class ErrorModel(NamedTuple):
    """Prior of the errors of a network.

    Attributes:
        covariance: (3p, 3p) second moment Sigma in the axes of S, in squared units of S.
        bones: lengths that the shape should have; None: lengths are not used.
        upright: what gravity says; None: nothing.
    """

    covariance: Floats
    bones: Bones | None = None
    upright: Upright | None = None

    def of(self, objects: slice) -> ErrorModel:
        """Return the prior of some of the objects."""
        bones, upright = self.bones, self.upright
        if bones is not None and bones.lengths.ndim == 2:
            bones = bones._replace(lengths=bones.lengths[objects], spread=bones.spread[objects])
        if upright is not None:
            upright = upright._replace(up=upright.up[objects])
        return ErrorModel(self.covariance, bones, upright)


def correct(
    S: Floats,
    M: Floats,
    W: Floats,
    weight: Floats,
    errors: ErrorModel,
    noise: Floats | float = 0.0,
) -> Floats:
    """Return the shapes (n, p, 3) moved towards their visible keypoints.

    Missing keypoints move with the visible ones, by their covariance.

    Args:
        S: (n, p, 3) shapes.
        M: (n, 3, 2) cameras, or (n, p, 3, 2), one for each point.
        W: (n, p, 2) keypoints in units of S; the translation is free.
        weight: (n, p) in [0, 1] of the keypoints, by which the variance of their noise is divided;
            0 = missing.
        errors: prior of the errors of S.
        noise: standard deviation (n,) of the coordinates of W of weight 1, in units of S. 0: the
            shape meets the keypoints exactly.
    """
    n, p, _ = S.shape
    noise = np.broadcast_to(noise, n)
    if n > _BLOCK:
        parts = [
            correct(S[b], M[b], W[b], weight[b], errors.of(b), noise[b]) for b in slices(n, _BLOCK)
        ]
        return np.concatenate(parts)
    covariance, bones, upright = errors
    M = (M if M.ndim == 4 else M[:, None]).astype(np.float64)
    H: Floats = np.zeros((n, p, 2, p, 3))
    H[:, range(p), :, range(p)] = np.broadcast_to(M, (n, p, 3, 2)).transpose(1, 0, 3, 2)
    H = H.reshape(n, 2 * p, 3 * p)
    unknown = UNKNOWN_VARIANCE * np.trace(covariance) / (3 * p)
    least = 1e-12 * unknown  # above zero, so that the system is regular even where M is no camera
    shown = weight > 0
    variance = np.square(noise)[:, None] / np.where(shown, weight, 1) + least  # (n, p)
    variance = np.where(shown, np.minimum(variance, unknown), unknown)
    R: Floats = np.zeros((n, p, 2, p, 2))
    for axis in range(2):
        R[:, :, axis, :, axis] = unknown  # of the translation, which all points share
        R[:, range(p), axis, range(p), axis] += variance
    R = R.reshape(n, 2 * p, 2 * p)
    r = ((W - (S[..., None, :] @ M)[..., 0, :]) * shown[..., None]).reshape(n, 2 * p)
    E = _posterior_mean(covariance, H, R, r)
    X = S + E.reshape(S.shape)
    constraints = [] if bones is None else [bones.length_constraint(X)]
    constraints += [] if upright is None else [upright.constraint(X)]
    for G, missing, G_covariance in constraints:
        k, more = len(r[0]), missing.shape[1]
        R = np.pad(R, ((0, 0), (0, more), (0, more)))
        R[:, k:, k:] = G_covariance + least * np.eye(more)
        H = np.concatenate((H, G), 1)
        # Linearised about X: the difference that remains there, and what E has done already.
        r = np.concatenate((r, missing + (G @ E[..., None])[..., 0]), 1)
    if constraints:
        E = _posterior_mean(covariance, H, R, r)
    corrected: Floats = S + E.reshape(S.shape).astype(S.dtype)
    return corrected


def _posterior_mean(covariance: Floats, H: Floats, R: Floats, r: Floats) -> Floats:
    """Return the mean (n, 3p) of the errors, of which H (n, k, 3p) measures r with covariance R."""
    CH = covariance @ H.swapaxes(1, 2)
    E: Floats = (CH @ np.linalg.solve(H @ CH + R, r[..., None]))[..., 0]
    return E


def error_covariance(lift: Lift, W: Floats, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the second moment (3p, 3p) of a network's errors, estimated without 3D labels.

    Args:
        lift: the network with its normalisation.
        W: (n, p, 2) complete keypoints.
        rng: draws the random cameras.
    """
    _, p, _ = W.shape
    all_visible = np.ones(W.shape[:2])
    covariance: Floats = np.eye(3 * p)
    for _ in range(_ROUNDS):
        T = centre(correct(*lift(W), all_visible, ErrorModel(covariance)))
        covariance = _second_moment(lift, T, rng)
    return covariance.astype(np.float32)


def hidden_covariance(
    lift: Lift, lift_visible: Lift, W: Floats, covariance: Floats, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return the second moment (3p, 3p) of a network's errors where keypoints are hidden.

    The shapes that are lifted again come from all keypoints, as those of `error_covariance`.

    Args:
        lift: the network with its normalisation.
        lift_visible: the same, from a part of the keypoints.
        W: (n, p, 2) complete keypoints.
        covariance: (3p, 3p) as `error_covariance` returns it.
        rng: draws the random cameras.
    """
    T = centre(correct(*lift(W), np.ones(W.shape[:2]), ErrorModel(covariance)))
    return _second_moment(lift_visible, T, rng).astype(np.float32)


def _second_moment(lift: Lift, T: Floats, rng: np.random.Generator) -> Floats:
    """Return the second moment (3p, 3p) of the errors of lifts of the known shapes T (n, p, 3)."""
    n, p, _ = T.shape
    Q = random_cameras(n, rng)
    S, M, keypoints = lift(T @ Q)
    unit = np.linalg.norm(keypoints, axis=(1, 2)) / np.linalg.norm(T @ Q, axis=(1, 2))
    # Rotate the known shape into the object's axes that the lifted camera M implies.
    T = unit[:, None, None] * T @ rotation_from_camera(Q).swapaxes(1, 2)
    E = (T @ rotation_from_camera(M) - S).reshape(n, 3 * p).astype(np.float64)
    covariance = E.T @ E / n
    covariance += _MIN_VARIANCE * np.trace(covariance) / (3 * p) * np.eye(3 * p)
    return covariance


def bone_lengths(
    lift: Lift,
    W: Floats,
    pairs: Sequence[tuple[int, int]],
    covariance: Floats,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Return the length and its standard deviation (b, 2) of each bone, without 3D labels.

    Both are shares of the sum of all lengths, as in `Bones`. The variance of lifted lengths exceeds
    that of the object by the error of lifting, which is measured by lifting known shapes again.

    Args:
        lift: the network with its normalisation.
        W: (n, p, 2) complete keypoints.
        pairs: b pairs of keypoints.
        covariance: (3p, 3p) as `error_covariance` returns it.
        rng: draws the random cameras.
    """
    if not pairs:
        return np.zeros((0, 2), np.float32)
    first, second = _lengths_of_two_lifts(lift, W, pairs, covariance, rng)
    lengths, variance = np.maximum(first.mean(0), _MIN_LENGTH), first.var(0)
    error = ((second - first) ** 2).mean(0)
    least = np.maximum(_MIN_OWN_DEVIATION**2 * variance, (_MIN_LENGTH_DEVIATION * lengths) ** 2)
    return np.stack((lengths, np.sqrt(np.maximum(variance - error, least))), 1).astype(np.float32)


def varied_bones(
    lift: Lift,
    W: Floats,
    pairs: Sequence[tuple[int, int]],
    covariance: Floats,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return length and standard deviation (b, 2) of each bone, and their correlation (b, b).

    As `bone_lengths`, of frames that show many different objects: lengths that belong together, as
    those of left and right, are told from lengths that vary by themselves. Frames of few objects do
    not show it.

    Args:
        lift: the network with its normalisation.
        W: (n, p, 2) complete keypoints.
        pairs: b pairs of keypoints, at least one.
        covariance: (3p, 3p) as `error_covariance` returns it.
        rng: draws the random cameras.
    """
    first, second = _lengths_of_two_lifts(lift, W, pairs, covariance, rng)
    lengths = np.maximum(first.mean(0), _MIN_LENGTH)
    found, added = (first - lengths) / lengths, (second - first) / lengths
    values, axes = np.linalg.eigh((found.T @ found - added.T @ added) / len(found))
    varies = (axes * np.maximum(values, _MIN_DEVIATION_TOGETHER**2)) @ axes.T
    relative = np.sqrt(varies.diagonal())
    statistics = np.stack((lengths, relative * lengths), 1), varies / np.outer(relative, relative)
    return statistics[0].astype(np.float32), statistics[1].astype(np.float32)


def _lengths_of_two_lifts(
    lift: Lift,
    W: Floats,
    pairs: Sequence[tuple[int, int]],
    covariance: Floats,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Return the relative lengths (n, b) of lifted shapes, and of those shapes lifted again."""
    all_visible, errors = np.ones(W.shape[:2]), ErrorModel(covariance)
    T = centre(correct(*lift(W), all_visible, errors))
    T_again = correct(*lift(T @ random_cameras(len(T), rng)), all_visible, errors)
    return relative_lengths(T, pairs), relative_lengths(T_again, pairs)
