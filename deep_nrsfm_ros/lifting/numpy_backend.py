# SPDX-License-Identifier: Apache-2.0
"""The lifter's computation in NumPy: the readable form, used where the kernel does not run.

`compiled_backend` computes the same in C; one test compares the two.

Symbols: n objects, p keypoints, k test-time rotations, S (n, p, 3) shapes, M (n, 3, 2) cameras,
R (n, 3, 3) rotations from object to camera axes, W (n, p, 2) normalised keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.keypoint_map import detected_count
from deep_nrsfm_ros.lifting.confidence import Calibration, Evidence, keypoint_confidence
from deep_nrsfm_ros.lifting.correction import ErrorModel, correct
from deep_nrsfm_ros.lifting.history import Context
from deep_nrsfm_ros.lifting.history_update import HistoryUpdate
from deep_nrsfm_ros.lifting.options import HistoryOptions
from deep_nrsfm_ros.lifting.weights import keypoint_weight, relative_confidence, trusted
from deep_nrsfm_ros.lifting.wrong_keypoints import MIN_RESIDUAL, Fit, without_wrong
from deep_nrsfm_ros.nrsfm.bones import Bones
from deep_nrsfm_ros.nrsfm.geometry import (
    centre,
    on_one_line,
    polar,
    reprojection_error,
    rotation_from_camera,
    weak_perspective,
)
from deep_nrsfm_ros.nrsfm.network import Network, point_precision, reconstruct
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser, normalise

Float32 = NDArray[np.float32]

# Signs of the mirror image: the y axis of an object points to its left, the x axis of an image
# lies across.
_MIRROR = np.array([1, -1, 1], np.float32)
MIN_RELATIVE_DEPTH = np.float32(0.1)
"""Least depth of a point, as a fraction of its object's, in a perspective projection."""
RESIDUAL_SCALE = 0.02
"""Difference of squared residuals that lowers the weight of a test-time rotation to 1/e."""


class LifterConstants(NamedTuple):
    """Model and options of a lifter, in the form that a backend computes with.

    Attributes:
        network: weights of the network.
        normaliser: how keypoints are centred and scaled.
        object_frame: (3, 3) rotation from the network's axes to the object's.
        test_time_rotations: (k, 2, 2) rotations of the input within the image plane.
        partners: index of each keypoint's left-right partner; None: no mirror images.
        covariance: (3p, 3p) of the errors in object axes, for the correction; None: no correction.
        bones: lengths for the correction; None: lengths are not used.
        error_std: (p,) standard deviation of the error of each point, in units of the network.
        noise: standard deviation of the keypoints, relative to the size of the object.
        refill: rounds of filling missing keypoints with those of the lifted shape.
        reference_length: length in the output of the reference pair, or of the RMS radius where
            `reference` is None.
        reference: indices of the reference pair; None: the RMS radius is the reference.
        min_visible: objects with fewer detected keypoints are not lifted.
        leave_out_wrong: whether keypoints that contradict the others are taken as missing.
        derivations: (m, 2) keypoints that do not count as detected, as in `KeypointMap`.
        history: time constants of what is remembered.
        bone_partners: (b,) of each bone the one of the other side; see `own_bones`.
        axis: (p,) from bottom to top; see `gravity`. None: the layout names neither.
        calibration: of the confidence.
    """

    network: Network
    normaliser: Normaliser
    object_frame: Float32
    test_time_rotations: Float32
    partners: Sequence[int] | None
    covariance: NDArray[np.float64] | None
    bones: Bones | None
    error_std: Float32
    noise: float
    refill: int
    reference_length: float
    reference: tuple[int, int] | None
    min_visible: int
    leave_out_wrong: bool
    derivations: NDArray[np.int32]
    history: HistoryOptions
    bone_partners: NDArray[np.int32]
    axis: NDArray[np.float64] | None
    calibration: Calibration


class Keypoints(NamedTuple):
    """Keypoints as the detector gives them.

    Attributes:
        points: (n, p, 2).
        weight: (n, p) in [0, 1]; 0 = missing.
        trusted: (n, p) whether the network reads the keypoint.
        perspective: whether the correction uses the ray of each point.
    """

    points: Float32
    weight: NDArray[np.float64]
    trusted: NDArray[np.bool_]
    perspective: bool


class NumpyBackend:
    """Lifts keypoints with NumPy.

    Attributes:
        constants: model and options.
        precision: (p, p) as in `confidence.gaps`.
    """

    def __init__(self, constants: LifterConstants) -> None:
        """Take model and options."""
        self.constants = constants
        self.precision = point_precision(constants.network)
        self._partners = None if constants.partners is None else np.array(constants.partners)

    def __call__(
        self,
        points: Float32,
        confidence: Float32,
        perspective: bool,
        context: Context | None = None,
    ) -> tuple[tuple[NDArray[Any], ...], NDArray[np.bool_]]:
        """Return the fields of `Lifted`, and which of the n objects cannot be lifted.

        Args:
            points: (n, p, 2) as in `Lifter.lift`; the shape is not checked again.
            confidence: (n, p) in [0, 1], 0 = missing.
            perspective: as in `Lifter.lift`.
            context: as in `Lifter.lift`.
        """
        weight = keypoint_weight(confidence)
        visible = trusted(weight)
        not_lifted = on_one_line(points, visible)
        not_lifted |= (
            detected_count(visible, self.constants.derivations) < self.constants.min_visible
        )
        wrong = np.zeros_like(visible)
        history = None
        if context is not None and self.constants.covariance is not None:
            history = HistoryUpdate(self.constants, context, not_lifted)
        if self.constants.leave_out_wrong:
            right = self._without_wrong(points, visible, perspective)
            wrong = visible & ~right
            weight[wrong] = 0
            visible = right
        seen = Keypoints(points, weight, visible, perspective)
        mask = visible[..., None].astype(np.float32)
        complete = np.ones_like(mask)
        rounds = 0 if visible.all() else self.constants.refill
        solution = self._solve(points, mask, seen, history, rounds == 0)
        if rounds:
            for number in range(1, rounds + 1):
                S, _, _, unit, origin = solution
                reprojected = unit * S[..., :2] + origin
                if perspective:
                    reprojected /= np.maximum(1 + unit * S[..., 2:], MIN_RELATIVE_DEPTH)
                filled = np.where(visible[..., None], points, reprojected)
                solution = self._solve(filled, complete, seen, history, number == rounds)
        if history:
            history.write()
        S, R, residual, _, _ = solution
        S = centre(S)
        probability = keypoint_confidence(
            Evidence(relative_confidence(confidence), visible, residual, S),
            self.constants.error_std,
            self.precision,
            self.constants.calibration,
        )
        S *= self.constants.reference_length / self._reference_size(S)
        scale, translation = weak_perspective(points, S[..., :2], visible)
        return (S, R, scale, translation, residual, probability, wrong), not_lifted

    def _without_wrong(
        self, points: Float32, visible: NDArray[np.bool_], perspective: bool
    ) -> NDArray[np.bool_]:
        """Return which visible keypoints (n, p) do not contradict the others."""
        constants = self.constants
        right = visible.copy()
        for i in np.flatnonzero(self._fit(points, visible, perspective).residual > MIN_RESIDUAL):

            def fit(shown: NDArray[np.bool_], own: Float32 = points[i, None]) -> Fit:
                return Fit(*(part[0] for part in self._fit(own, shown[None], perspective)))

            pairs, fewest = constants.derivations, constants.min_visible
            right[i] = without_wrong(fit, points[i], visible[i], pairs, fewest)
        return right

    def _fit(self, points: Float32, visible: NDArray[np.bool_], perspective: bool) -> Fit:
        """Return the network's fit of n objects to their visible keypoints (n, p)."""
        constants, shown = self.constants, visible[..., None]
        W, gain, unit, origin = normalise(
            constants.network, constants.normaliser, points, shown.astype(np.float32)
        )
        S, _, residual = self._average(gain * W, W, visible, unit if perspective else None)
        P = _projected(S, unit if perspective else None)
        radius = np.sqrt((W * W * shown).sum((1, 2)) / np.maximum(visible.sum(1), 1))
        apart = np.linalg.norm((points - origin) / unit - P, axis=2)
        return Fit(residual, apart / np.maximum(radius, np.float32(1e-9))[:, None])

    def _solve(
        self,
        points: Float32,
        mask: Float32,
        seen: Keypoints,
        history: HistoryUpdate | None,
        last: bool,
    ) -> tuple[Float32, Float32, Float32, Float32, Float32]:
        """Return S in camera axes, R, residual (n,), and unit and origin of S in the image.

        The network reads all points of mask (n, p, 1); the correction those of positive weight.
        The last round smooths, and remembers what it finds.
        """
        constants, visible, perspective = self.constants, seen.trusted, seen.perspective
        W, gain, unit, origin = normalise(constants.network, constants.normaliser, points, mask)
        S, M, residual = self._average(gain * W, W, visible, unit if perspective else None)
        R = rotation_from_camera(M)
        if constants.covariance is not None:
            shown = visible[..., None]
            size = np.sqrt((W * W * shown).sum((1, 2)) / np.maximum(2 * shown.sum((1, 2)), 1))
            doubtful = ((seen.weight > 0) & ~visible)[..., None]
            W = np.where(doubtful, (seen.points - origin) / unit, W)
            points = np.where(doubtful, seen.points, points)
            S = S @ R
            if history and last:
                S, R = history.smoothed(S, R, visible)
                M = R.swapaxes(1, 2)[..., :2]
            cameras = M[:, None] - R[:, None, 2, :, None] * points[:, :, None] if perspective else M
            errors = ErrorModel(constants.covariance, constants.bones)
            noise = constants.noise * size
            if history:
                if last:
                    first_stage = ErrorModel(constants.covariance)
                    X = correct(S, cameras, W, seen.weight, first_stage, noise)
                    history.learn(X, R, seen.weight * visible)
                errors = history.errors(R)
            S = correct(S, cameras, W, seen.weight, errors, noise)
            S = S @ R.swapaxes(1, 2)
        return S, R, residual, unit, origin

    def _average(
        self, x: Float32, W: Float32, visible: NDArray[np.bool_], unit: Float32 | None
    ) -> tuple[Float32, Float32, Float32]:
        """Return S (n, p, 3) in camera axes, M (n, 3, 2) from object axes, residual (n,).

        Test-time augmentation: means over rotations of the network's input x within the image
        plane, and over their mirror images, weighted by the residual of W that each leaves.
        """
        rotations, partners = self.constants.test_time_rotations, self._partners
        n, p, _ = W.shape
        inputs = x @ rotations.swapaxes(1, 2)[:, None]  # (k, n, p, 2)
        if partners is not None:
            inputs = np.concatenate((inputs, (inputs * _MIRROR[1:])[:, :, partners]))
            rotations = np.concatenate((rotations, rotations))
        k = len(rotations)
        S, M = reconstruct(self.constants.network, inputs.reshape(k * n, p, 2))
        A = self.constants.object_frame
        S, M = (S @ A).reshape(k, n, p, 3), (A.T @ M).reshape(k, n, 3, 2)
        if partners is not None:
            half = k // 2
            S[half:] = S[half:, :, partners] * _MIRROR
            M[half:] *= _MIRROR[:, None] * _MIRROR[1:]
        M = M @ rotations[:, None]
        S = S @ rotation_from_camera(M).swapaxes(-1, -2)
        residual = reprojection_error(W, _projected(S, unit), visible)
        weight = np.exp((residual.min(0) ** 2 - residual**2) / RESIDUAL_SCALE)
        weight /= weight.sum(0)
        M = (weight[..., None, None] * M).sum(0)
        return (
            (weight[..., None, None] * S).sum(0),
            polar(M.swapaxes(1, 2)).swapaxes(1, 2),
            (weight * residual).sum(0),
        )

    def _reference_size(self, S: Float32) -> Float32:
        """Return the length (n, 1, 1) of the reference in each shape, above 0."""
        if self.constants.reference is None:
            size = np.sqrt((S * S).sum(2).mean(1))
        else:
            a, b = self.constants.reference
            size = np.linalg.norm(S[:, a] - S[:, b], axis=1)
        positive: Float32 = np.maximum(size, np.float32(1e-9))
        return positive[:, None, None]


def _projected(S: Float32, unit: Float32 | None) -> Float32:
    """Return the projection (..., p, 2) of shapes (..., p, 3) in camera axes.

    Args:
        S: the shapes.
        unit: of the shapes, in distances of their origin from the camera; None: weak perspective.
    """
    if unit is None:
        return S[..., :2]
    projected: Float32 = S[..., :2] / np.maximum(1 + unit * S[..., 2:], MIN_RELATIVE_DEPTH)
    return projected
