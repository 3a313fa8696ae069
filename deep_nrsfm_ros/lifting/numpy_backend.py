"""Fitting the network's shapes to keypoints, in NumPy: what `lifting` does with each object.

`kernel/` does the same, compiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.confidence import keypoint_confidence
from deep_nrsfm_ros.lifting.correction import correct
from deep_nrsfm_ros.nrsfm.bones import Bones
from deep_nrsfm_ros.nrsfm.geometry import (
    centre,
    on_one_line,
    polar,
    reprojection_error,
    rotation_from_camera,
    weak_perspective,
)
from deep_nrsfm_ros.nrsfm.network import Network, reconstruct
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser, normalise

Float32 = NDArray[np.float32]

# The mirror image of an object, whose y axis points to its left, and of an image.
_ACROSS = np.array([1, -1, 1], np.float32)
MIN_RELATIVE_DEPTH = np.float32(
    0.1
)  # depth of a point, relative to its object's, that is not undercut
RESIDUAL_SCALE = 0.02  # squared residual by which a turn loses all but 1/e of its weight


class LifterConstants(NamedTuple):
    """What a lifter knows before it sees any keypoints."""

    network: Network
    normaliser: Normaliser
    frame: Float32  # (3, 3) the network's axes to the object's
    test_time_rotations: Float32  # (k, 2, 2) of the input within the image plane
    partners: Sequence[int] | None  # of each keypoint in the mirror image; None: no mirror images
    covariance: NDArray[np.float64] | None  # (3p, 3p) by which to correct; None: not at all
    bones: Bones | None  # by which to correct as well
    spread: Float32  # (p,) standard deviation of the errors of each point
    noise: float  # of the keypoints, relative to the size of the object
    refill: int  # rounds
    length: float  # of the reference in the output
    reference: tuple[int, int] | None  # two keypoints; None: the RMS radius
    min_visible: int


class NumpyBackend:
    """Lifts by what it knows."""

    def __init__(self, known: LifterConstants) -> None:
        """Take the constants."""
        self.known = known
        self._partners = None if known.partners is None else np.array(known.partners)

    def __call__(
        self, points: Float32, confidence: Float32, perspective: bool
    ) -> tuple[tuple[Float32, ...], NDArray[np.bool_]]:
        """Return the fields of `lifting.Lifted`, and (n,) where there is nothing to lift.

        Arguments as those of `Lifter.__call__`, their shapes checked.
        """
        visible = confidence > 0
        mask = visible[..., None].astype(np.float32)
        whole = np.ones_like(mask)
        fitted = self._fit(points, mask, visible, perspective)
        if not visible.all():
            for _ in range(self.known.refill):
                S, _, _, unit, origin = fitted
                seen = unit * S[..., :2] + origin
                if perspective:
                    seen /= np.maximum(1 + unit * S[..., 2:], MIN_RELATIVE_DEPTH)
                filled = np.where(visible[..., None], points, seen)
                fitted = self._fit(filled, whole, visible, perspective)
        S, R, residual, _, _ = fitted
        S = centre(S)
        sure = self.keypoint_confidence(confidence, residual, S)
        S *= self.known.length / self._reference_size(S)
        scale, translation = weak_perspective(points, S[..., :2], visible)
        lost = on_one_line(points, visible)
        lost |= visible.sum(1) < self.known.min_visible
        return (S, R, scale, translation, residual, sure), lost

    def keypoint_confidence(self, confidence: Float32, residual: Float32, S: Float32) -> Float32:
        """Return the confidence (n, p) of shapes S (n, p, 3) in the network's unit, centred."""
        return keypoint_confidence(confidence, residual, self.spread(S))

    def spread(self, S: Float32) -> Float32:
        """Return the standard deviation (n, p) of the model's errors, relative to the RMS radius.

        S: as in `sure`.
        """
        radius = np.sqrt((S * S).sum(2).mean(1))
        spread: Float32 = self.known.spread / np.maximum(radius, 1e-9)[:, None]
        return spread

    def _fit(
        self, points: Float32, mask: Float32, visible: NDArray[np.bool_], perspective: bool
    ) -> tuple[Float32, Float32, Float32, Float32, Float32]:
        """Return S in camera axes, R, residual (n,), and what leads to the image: unit, origin.

        The network sees the points (n, p, 2) of mask (n, p, 1); the correction the visible alone.
        """
        known = self.known
        W, gain, unit, origin = normalise(known.network, known.normaliser, points, mask)
        S, M, residual = self._average(gain * W, W, visible, unit if perspective else None)
        R = rotation_from_camera(M)
        if known.covariance is not None:
            seen = visible[..., None]
            size = np.sqrt((W * W * seen).sum((1, 2)) / np.maximum(2 * seen.sum((1, 2)), 1))
            noise = known.noise * size
            cameras = M[:, None] - R[:, None, 2, :, None] * points[:, :, None] if perspective else M
            S = correct(S @ R, cameras, W, visible, known.covariance, noise, known.bones)
            S = S @ R.swapaxes(1, 2)
        return S, R, residual, unit, origin

    def _average(
        self, x: Float32, W: Float32, visible: NDArray[np.bool_], unit: Float32 | None
    ) -> tuple[Float32, Float32, Float32]:
        """Return S (n, p, 3) in camera axes, M (n, 3, 2) from the object's, residual (n,).

        Means over the turns of the network's input x within the image plane, and over their
        mirror images, each by the residual that it leaves of W.
        """
        turns, partners = self.known.test_time_rotations, self._partners
        n, p, _ = W.shape
        turned = x @ turns.swapaxes(1, 2)[:, None]  # (k, n, p, 2)
        if partners is not None:
            turned = np.concatenate((turned, (turned * _ACROSS[1:])[:, :, partners]))
            turns = np.concatenate((turns, turns))
        k = len(turns)
        S, M = reconstruct(self.known.network, turned.reshape(k * n, p, 2))
        A = self.known.frame
        S, M = (S @ A).reshape(k, n, p, 3), (A.T @ M).reshape(k, n, 3, 2)
        if partners is not None:
            half = k // 2
            S[half:] = S[half:, :, partners] * _ACROSS
            M[half:] *= _ACROSS[:, None] * _ACROSS[1:]
        M = M @ turns[:, None]
        S = S @ rotation_from_camera(M).swapaxes(-1, -2)
        P = (
            S[..., :2]
            if unit is None
            else S[..., :2] / np.maximum(1 + unit * S[..., 2:], MIN_RELATIVE_DEPTH)
        )
        residual = reprojection_error(W, P, visible)
        trust = np.exp((residual.min(0) ** 2 - residual**2) / RESIDUAL_SCALE)
        trust /= trust.sum(0)
        M = (trust[..., None, None] * M).sum(0)
        return (
            (trust[..., None, None] * S).sum(0),
            polar(M.swapaxes(1, 2)).swapaxes(1, 2),
            (trust * residual).sum(0),
        )

    def _reference_size(self, S: Float32) -> Float32:
        """Return the size (n, 1, 1) of each shape that the reference length stands for."""
        if self.known.reference is None:
            size = np.sqrt((S * S).sum(2).mean(1))
        else:
            a, b = self.known.reference
            size = np.linalg.norm(S[:, a] - S[:, b], axis=1)
        held: Float32 = np.maximum(size, np.float32(1e-9))
        return held[:, None, None]
