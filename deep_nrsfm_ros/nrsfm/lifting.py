"""Lifting: 2D keypoints of n objects to 3D shapes and camera rotations, in NumPy alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.nrsfm.geometry import (
    back_project,
    centre,
    polar,
    reprojection_error,
    rotation_from_camera,
    weak_perspective,
)
from deep_nrsfm_ros.nrsfm.model_file import Model
from deep_nrsfm_ros.nrsfm.network import forward

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class LiftingOptions:
    """Lifting."""

    back_projection: float = option(
        1.0,
        "share of the remaining reprojection error that is removed by moving points within the "
        "image plane; 1 pays below 5 % noise, 0.5 below 10 %, 0 leaves the network's shape",
        low=0.0,
        high=1.0,
    )
    refill: int = option(
        5, "rounds of filling missing points with their own reprojection", low=0, high=50
    )
    min_visible: int = option(
        4, "objects with fewer visible keypoints are not lifted", low=3, high=1000
    )
    reference_length: float = option(
        1.0,
        "length of the layout's reference pair (of people: neck to mid-hip) in the output; about "
        "0.5 makes the points of an adult metres. Layouts without one: RMS radius of the shape",
        low=1e-6,
        high=1e6,
    )


class Lifted(NamedTuple):
    """n lifted objects; NaN with confidence 0 where there is nothing to lift.

    That is: too few visible points, or points on one line, which say nothing about the camera.
    """

    shapes: Float32  # (n, p, 3) camera axes (x right, y down, z forward), centred, output units
    rotations: Float32  # (n, 3, 3) object to camera: p_camera = R p_object, det +1
    scale: Float32  # (n,) pixels per output unit
    translation: Float32  # (n, 2) where the shape's centre is in the image
    residual: Float32  # (n,) relative reprojection error of the network, before back-projection
    confidence: Float32  # (n, p) 0..1


class Lifter:
    """A model ready to lift."""

    def __init__(self, model: Model, options: LiftingOptions | None = None) -> None:
        """Take the model with `options` (all defaults if None)."""
        self.model = model
        self.options = options or LiftingOptions()
        pair = model.layout.reference
        self._reference = pair and (model.layout.index(pair[0]), model.layout.index(pair[1]))

    def __call__(self, points: Float32, confidence: Float32) -> Lifted:
        """Lift keypoints (n, p, 2) of confidence (n, p), 0 = missing, in the model's layout.

        Raises ValueError if the shapes do not fit the model.
        """
        p = len(self.model.layout)
        if points.shape[1:] != (p, 2) or confidence.shape != points.shape[:2]:
            raise ValueError(
                f"points are {points.shape} and confidence {confidence.shape}; "
                f"model {self.model.name!r} needs (n, {p}, 2) and (n, {p})"
            )
        visible = confidence > 0
        S, M, W = self._reconstruct(points, visible)
        residual = reprojection_error(points, S @ M, visible)
        S = back_project(S, M, W, self.options.back_projection)
        A = self.model.object_frame
        R = rotation_from_camera(A.T @ M)
        S = centre(S) @ A
        S *= self.options.reference_length / self._reference_size(S)
        S = S @ R.swapaxes(1, 2)
        scale, translation = weak_perspective(points, S[..., :2], visible)
        lifted = Lifted(S, R, scale, translation, residual, self._sure(confidence, residual))
        lost = np.abs(M.swapaxes(1, 2) @ M - np.eye(2, dtype=M.dtype)).max((1, 2)) > 0.01
        lost |= visible.sum(1) < self.options.min_visible
        return _blank(lifted, lost) if lost.any() else lifted

    def _reconstruct(
        self, points: Float32, visible: NDArray[np.bool_]
    ) -> tuple[Float32, Float32, Float32]:
        """Return the network's S, M and its input W, missing points where S M puts them."""
        mask = visible[..., None].astype(np.float32)
        encode = self.model.normaliser.encode
        seen = encode(points, mask)
        S, M = self._forward(seen.W * seen.gain)
        if visible.all():
            return S, M, seen.W
        for _ in range(self.options.refill):
            P = S @ M
            scale, shift = weak_perspective(points, P, visible)
            filled = np.where(mask > 0, points, scale[:, None, None] * P + shift[:, None])
            seen = encode(filled, np.ones_like(mask))
            S, M = self._forward(seen.W)
        return S, M, np.where(mask > 0, seen.W, S @ M)

    def _forward(self, W: Float32) -> tuple[Float32, Float32]:
        """Return the network's S and an orthonormal M; S takes over the size of a free camera."""
        S, M = forward(self.model.network, W)
        if self.model.network.architecture.camera == "free":
            S = S * ((M * M).sum((1, 2), keepdims=True) / 2) ** 0.5
            M = polar(M.swapaxes(1, 2)).swapaxes(1, 2)
        return S, M

    def _reference_size(self, S: Float32) -> Float32:
        """Return the size (n, 1, 1) of each shape that the reference length stands for."""
        if self._reference is None:
            size = np.sqrt((S * S).sum(2).mean(1))
        else:
            a, b = self._reference
            size = np.linalg.norm(S[:, a] - S[:, b], axis=1)
        held: Float32 = np.maximum(size, np.float32(1e-9))
        return held[:, None, None]

    @staticmethod
    def _sure(confidence: Float32, residual: Float32) -> Float32:
        """Return confidence (n, p): the detector's, less what the residual takes from it.

        A missing point counts half of the mean of those seen: the model guesses it from them.
        """
        seen = confidence > 0
        mean = confidence.sum(1) / np.maximum(seen.sum(1), 1).astype(np.float32)
        sure = np.where(seen, confidence, np.float32(0.5) * mean[:, None])
        trust: Float32 = np.clip(sure, 0, 1) * np.clip(1 - residual, 0, 1)[:, None]
        return trust


def _blank(lifted: Lifted, where: NDArray[np.bool_]) -> Lifted:
    """Return `lifted` with the chosen objects NaN and their confidence 0."""
    for array in lifted:
        array[where] = np.nan
    lifted.confidence[where] = 0
    return lifted
