"""Lifting: 2D keypoints of n objects to 3D shapes and camera rotations, without torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.kernel import supports
from deep_nrsfm_ros.lifting.compiled_backend import CompiledBackend
from deep_nrsfm_ros.lifting.numpy_backend import Float32, LifterConstants, NumpyBackend
from deep_nrsfm_ros.model_files.model_file import Model

_BLOCK = 64  # objects lifted together by `lift_all`


@dataclass(frozen=True)
class LiftingOptions:
    """Lifting."""

    correction: str = option(
        "bones",
        "how the shape is moved after the network: by what the keypoints show, what the model has "
        "learned of its own errors, depth included, and how long the bones of the layout are; by "
        "the same without the bones; by back-projection, within the image plane; or not at all",
        choices=("bones", "learned", "back_projection", "none"),
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
    test_time_rotations: int = option(
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
        "0: the length in metres that the model's layout file gave, or 1 if it gave none",
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
        self.constants = _constants(model, self.options)
        self.backend = (
            CompiledBackend(self.constants)
            if supports(model.network)
            else NumpyBackend(self.constants)
        )

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
        arrays, lost = self.backend(points, confidence, perspective)
        lifted = Lifted(*arrays)
        return mark_not_lifted(lifted, lost) if lost.any() else lifted


def _constants(model: Model, options: LiftingOptions) -> LifterConstants:
    p = len(model.layout)
    angles = 2 * np.pi * np.arange(options.test_time_rotations) / options.test_time_rotations
    c, s = np.cos(angles), np.sin(angles)
    covariance = None
    if options.correction in ("bones", "learned"):
        turn = np.kron(np.eye(p), model.object_frame)
        covariance = turn.T @ model.error_covariance @ turn
    elif options.correction == "back_projection":
        covariance = np.eye(3 * p)
    pair = model.layout.reference
    return LifterConstants(
        model.network,
        model.normaliser,
        model.object_frame,
        np.array([[c, -s], [s, c]], np.float32).transpose(2, 0, 1).copy(),
        model.layout.partners() if options.mirror else None,
        covariance,
        model.bones if options.correction == "bones" else None,
        np.sqrt(model.error_covariance.diagonal().reshape(p, 3).sum(1)),
        options.noise,
        options.refill,
        options.reference_length or model.layout.reference_length or 1.0,
        pair and (model.layout.index(pair[0]), model.layout.index(pair[1])),
        options.min_visible,
    )


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
    for part in slices(len(points), _BLOCK) or [slice(0)]:
        parts.append(lifter(points[part], confidence[part]))
        on_progress(part.stop, len(points))
    return Lifted(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def mark_not_lifted(lifted: Lifted, where: NDArray[np.bool_]) -> Lifted:
    """Return `lifted` with the chosen objects NaN and their confidence 0."""
    for array in lifted:
        array[where] = np.nan
    lifted.confidence[where] = 0
    return lifted
