"""Lifting: 2D keypoints of n objects to 3D shapes and camera rotations, in NumPy alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.nrsfm.confidence import near
from deep_nrsfm_ros.nrsfm.correction import correct
from deep_nrsfm_ros.nrsfm.geometry import (
    centre,
    on_one_line,
    polar,
    reprojection_error,
    rotation_from_camera,
    weak_perspective,
)
from deep_nrsfm_ros.nrsfm.model_file import Model
from deep_nrsfm_ros.nrsfm.network import reconstruct
from deep_nrsfm_ros.nrsfm.normaliser import observe

Float32 = NDArray[np.float32]

# The mirror image of an object, whose y axis points to its left, and of an image.
_ACROSS = np.array([1, -1, 1], np.float32)
_BLOCK = 64  # objects lifted together by `lift_all`
_NEAREST = np.float32(0.1)  # depth of a point, relative to its object's, that is not undercut
_RESIDUAL_SPREAD = 0.02  # squared residual by which a turn loses all but 1/e of its weight


@dataclass(frozen=True)
class LiftingOptions:
    """Lifting."""

    correction: str = option(
        "learned",
        "how what is left of the keypoints moves the shape: by what the model has learned of its "
        "own errors, depth included; by back-projection, within the image plane; or not at all",
        choices=("learned", "back_projection", "none"),
    )
    noise: float = option(
        0.02,
        "noise of the keypoints, relative to the size of the object in the image: how far the "
        "corrected shape may stay from them; 0 meets them exactly and magnifies their noise",
        low=0.0,
        high=1.0,
    )
    refill: int = option(
        2, "rounds of filling missing points with those of the lifted shape", low=0, high=50
    )
    turns: int = option(
        3,
        "turns of the input within the image plane of which the lifted shapes are averaged, each "
        "by its residual: they are not lifted exactly alike, but those a quarter apart nearly are",
        low=1,
        high=64,
    )
    mirror: bool = option(
        False,
        "lift the mirror image as well and average, where the layout has a handedness and left_ "
        "and right_ of some keypoints: a little more accurate on average, at twice the time and "
        "with a mirrored frame now and then",
    )
    min_visible: int = option(
        4, "objects with fewer visible keypoints are not lifted", low=3, high=1000
    )
    reference_length: float = option(
        0.0,
        "length of the layout's reference pair (of people: neck to mid-hip) in the output; about "
        "0.5 makes the points of an adult metres. Layouts without one: RMS radius of the shape. "
        "0: the length in metres that the model's object file gave, or 1 if it gave none",
        low=0.0,
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
    residual: Float32  # (n,) relative reprojection error of the network, before correction
    confidence: Float32  # (n, p) chance that the point is near its true place, see `confidence`

    @property
    def object_confidence(self) -> Float32:
        """The share (n,) of each object's points to be expected near their true places."""
        share: Float32 = self.confidence.mean(1)
        return share


class Lifter:
    """A model ready to lift."""

    def __init__(self, model: Model, options: LiftingOptions | None = None) -> None:
        """Take the model with `options` (all defaults if None)."""
        self.model = model
        self.options = options or LiftingOptions()
        pair = model.layout.reference
        angles = 2 * np.pi * np.arange(self.options.turns) / self.options.turns
        c, s = np.cos(angles), np.sin(angles)
        self._turns = np.array([[c, -s], [s, c]], np.float32).transpose(2, 0, 1).copy()
        p = len(model.layout)
        partners = model.layout.partners() if self.options.mirror else None
        self._partners = None if partners is None else np.array(partners)
        turn = np.kron(np.eye(p), model.object_frame)
        learned = self.options.correction == "learned"
        self._covariance = turn.T @ model.error_covariance @ turn if learned else np.eye(3 * p)
        self._spread = np.sqrt(model.error_covariance.diagonal().reshape(p, 3).sum(1))
        self._length = self.options.reference_length or model.layout.reference_length or 1.0
        self._reference = pair and (model.layout.index(pair[0]), model.layout.index(pair[1]))

    def __call__(
        self, points: Float32, confidence: Float32, *, perspective: bool = False
    ) -> Lifted:
        """Lift keypoints (n, p, 2) of confidence (n, p), 0 = missing, in the model's layout.

        perspective: the points are where rays meet the plane z = 1 of a camera that looks at the
        object (see `placement`), and the correction moves each along its own ray or across it.
        Raises ValueError if the shapes do not fit the model.
        """
        p = len(self.model.layout)
        if points.shape[1:] != (p, 2) or confidence.shape != points.shape[:2]:
            raise ValueError(
                f"points are {points.shape} and confidence {confidence.shape}; "
                f"model {self.model.name!r} needs (n, {p}, 2) and (n, {p})"
            )
        visible = confidence > 0
        mask = visible[..., None].astype(np.float32)
        whole = np.ones_like(mask)
        fitted = self._fit(points, mask, visible, perspective)
        if not visible.all():
            for _ in range(self.options.refill):
                S, _, _, unit, origin = fitted
                seen = unit * S[..., :2] + origin
                if perspective:
                    seen /= np.maximum(1 + unit * S[..., 2:], _NEAREST)
                filled = np.where(visible[..., None], points, seen)
                fitted = self._fit(filled, whole, visible, perspective)
        S, R, residual, _, _ = fitted
        S = centre(S)
        sure = self.sure(confidence, residual, S)
        S *= self._length / self._reference_size(S)
        scale, translation = weak_perspective(points, S[..., :2], visible)
        lifted = Lifted(S, R, scale, translation, residual, sure)
        lost = on_one_line(points, visible)
        lost |= visible.sum(1) < self.options.min_visible
        return blank(lifted, lost) if lost.any() else lifted

    def sure(self, confidence: Float32, residual: Float32, S: Float32) -> Float32:
        """Return the confidence (n, p) of shapes S (n, p, 3) in the network's unit, centred."""
        return near(confidence, residual, self.spread(S))

    def spread(self, S: Float32) -> Float32:
        """Return the standard deviation (n, p) of the model's errors, relative to the RMS radius.

        S: as in `sure`.
        """
        radius = np.sqrt((S * S).sum(2).mean(1))
        spread: Float32 = self._spread / np.maximum(radius, 1e-9)[:, None]
        return spread

    def _fit(
        self, points: Float32, mask: Float32, visible: NDArray[np.bool_], perspective: bool
    ) -> tuple[Float32, Float32, Float32, Float32, Float32]:
        """Return S in camera axes, R, residual (n,), and what leads to the image: unit, origin.

        The network sees the points (n, p, 2) of mask (n, p, 1); the correction the visible alone.
        """
        model = self.model
        W, gain, unit, origin = observe(model.network, model.normaliser, points, mask)
        S, M, residual = self._average(gain * W, W, visible, unit if perspective else None)
        R = rotation_from_camera(M)
        if self.options.correction != "none":
            seen = visible[..., None]
            size = np.sqrt((W * W * seen).sum((1, 2)) / np.maximum(2 * seen.sum((1, 2)), 1))
            noise = self.options.noise * size
            cameras = M[:, None] - R[:, None, 2, :, None] * points[:, :, None] if perspective else M
            S = correct(S @ R, cameras, W, visible, self._covariance, noise) @ R.swapaxes(1, 2)
        return S, R, residual, unit, origin

    def _average(
        self, x: Float32, W: Float32, visible: NDArray[np.bool_], unit: Float32 | None
    ) -> tuple[Float32, Float32, Float32]:
        """Return S (n, p, 3) in camera axes, M (n, 3, 2) from the object's, residual (n,).

        Means over the turns of the network's input x within the image plane, and over their
        mirror images, each by the residual that it leaves of W.
        """
        turns = self._turns  # (k, 2, 2)
        n, p, _ = W.shape
        turned = x @ turns.swapaxes(1, 2)[:, None]  # (k, n, p, 2)
        if self._partners is not None:
            turned = np.concatenate((turned, (turned * _ACROSS[1:])[:, :, self._partners]))
            turns = np.concatenate((turns, turns))
        k = len(turns)
        S, M = reconstruct(self.model.network, turned.reshape(k * n, p, 2))
        A = self.model.object_frame
        S, M = (S @ A).reshape(k, n, p, 3), (A.T @ M).reshape(k, n, 3, 2)
        if self._partners is not None:
            half = k // 2
            S[half:] = S[half:, :, self._partners] * _ACROSS
            M[half:] *= _ACROSS[:, None] * _ACROSS[1:]
        M = M @ turns[:, None]
        S = S @ rotation_from_camera(M).swapaxes(-1, -2)
        P = S[..., :2] if unit is None else S[..., :2] / np.maximum(1 + unit * S[..., 2:], _NEAREST)
        residual = reprojection_error(W, P, visible)
        trust = np.exp((residual.min(0) ** 2 - residual**2) / _RESIDUAL_SPREAD)
        trust /= trust.sum(0)
        M = (trust[..., None, None] * M).sum(0)
        return (
            (trust[..., None, None] * S).sum(0),
            polar(M.swapaxes(1, 2)).swapaxes(1, 2),
            (trust * residual).sum(0),
        )

    def _reference_size(self, S: Float32) -> Float32:
        """Return the size (n, 1, 1) of each shape that the reference length stands for."""
        if self._reference is None:
            size = np.sqrt((S * S).sum(2).mean(1))
        else:
            a, b = self._reference
            size = np.linalg.norm(S[:, a] - S[:, b], axis=1)
        held: Float32 = np.maximum(size, np.float32(1e-9))
        return held[:, None, None]


def lift_all(
    lifter: Callable[[Float32, Float32], Lifted],
    points: Float32,
    confidence: Float32,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Lifted:
    """Lift any number of objects, a few at a time: many at once leave the processor's cache.

    on_progress: called with how many are done and how many there are.
    """
    parts = []
    for start in range(0, len(points), _BLOCK) or (0,):
        end = min(start + _BLOCK, len(points))
        parts.append(lifter(points[start:end], confidence[start:end]))
        on_progress(end, len(points))
    return Lifted(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def blank(lifted: Lifted, where: NDArray[np.bool_]) -> Lifted:
    """Return `lifted` with the chosen objects NaN and their confidence 0."""
    for array in lifted:
        array[where] = np.nan
    lifted.confidence[where] = 0
    return lifted
