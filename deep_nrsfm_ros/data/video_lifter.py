# SPDX-License-Identifier: Apache-2.0
"""Lifting of a video in Python, frame after frame: with the camera, over time, without ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.lifting.history import Context
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all, warn_of_scale
from deep_nrsfm_ros.lifting.numpy_backend import Float32
from deep_nrsfm_ros.lifting.observation import from_arrays
from deep_nrsfm_ros.lifting.options import unit_vector
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.lifting.steady_depth import steady_depths
from deep_nrsfm_ros.lifting.track_matching import keypoint_tolerances
from deep_nrsfm_ros.lifting.tracking import Tracker
from deep_nrsfm_ros.messages.stamps import TopicClock


class VideoLifter:
    """Lifts the objects of a video, frame after frame, as the ROS node does.

    Attributes:
        lifter: model, options and the detector's layout.
        camera: intrinsics of the camera; None: unknown.
        identities: of the objects of the last frame, in their order; "": unknown.
    """

    def __init__(
        self, lifter: Lifter, camera: Intrinsics | None = None, *, up: ArrayLike | None = None
    ) -> None:
        """Start without objects.

        Args:
            lifter: model, options and the detector's layout.
            camera: intrinsics of the camera, in pixels of the image of the keypoints: objects come
                out at their place before it. None: each object is centred.
            up: (3,) direction against gravity in the camera's axes, x right, y down, z forward, of
                any length: (0, -1, 0) of a level camera. None: unknown.

        Raises:
            TypeError: the camera is no `Intrinsics`.
            ValueError: `up` is no direction, or no object of the layout can have as many keypoints
                as the option `min_visible` asks for.
        """
        if camera is not None and not isinstance(camera, Intrinsics):
            raise TypeError(
                f"camera is a {type(camera).__name__}; give Intrinsics((fx, fy), (cx, cy)), "
                "Intrinsics.from_matrix(K, distortion), or "
                "Intrinsics.from_field_of_view(degrees, (width, height))"
            )
        lifter(np.zeros((0, len(lifter.layout), 2)))  # checks `min_visible` against the layout
        self.lifter, self.camera = lifter, camera
        self.identities: tuple[str, ...] = ()
        self._up = None if up is None else _unit_vector(up)
        self._to_model = KeypointMap(lifter.layout, lifter.model.layout)
        self._tolerances = keypoint_tolerances(lifter.model.layout)
        history = lifter.constants.history.enabled and lifter.options.correction != "none"
        self._remembers = history  # without a correction nothing could be smoothed before it
        self._clock = TopicClock()
        self._restart()

    def _restart(self) -> None:
        """Forget all objects."""
        self._tracker, self._memory = Tracker(), self.lifter.memory()

    def __call__(
        self,
        points: ArrayLike,
        confidence: ArrayLike | None = None,
        *,
        seconds: float | None = None,
        identities: Sequence[str] = (),
    ) -> Lifted:
        """Lift the n objects of a frame; `identities` of this lifter then names them.

        Args:
            points: (n, q, 2) or (q, 2) as in a call of `Lifter`; pixels where there is a camera.
            confidence: (n, q) or (q,), likewise; None: all keypoints have confidence 1.
            seconds: time of the frame on any clock, so that the last frames of each object help.
                More than a second back in time, all objects are forgotten. None: each object is
                lifted by itself, so that `points` may hold the objects of many frames.
            identities: n, those of the detector's tracker; "" of an object without one. (): they
                are found.

        Raises:
            ValueError: the arrays do not fit each other or the layout, there is not an identity
                for each object, or the time is not finite.
        """
        warn_of_scale(confidence)
        seen = from_arrays(points, confidence, self.lifter.layout)
        n = len(seen.points)
        if identities and len(identities) != n:
            raise ValueError(f"identities are {len(identities)}; give one for each of {n} objects")
        keypoints = self._to_model(seen.points, seen.confidence)
        if seconds is None:
            self.identities = tuple(identities) or ("",) * n
            return lift_all(self._lift_alone, *keypoints)
        if not math.isfinite(seconds):
            raise ValueError(f"seconds is {seconds}; give the time of the frame, or None")
        stamp = round(1e9 * seconds)
        moment = self._clock(stamp, stamp)
        if moment.restarted:
            self._restart()
        observed = seen._replace(
            points=keypoints[0],
            confidence=keypoints[1],
            identities=tuple(identity or None for identity in identities),
        )
        found = self._tracker(observed, moment.seconds, moment.period, self._tolerances)
        self.identities = found
        remembered = found if self._remembers else ("",) * n
        context = self._memory(remembered, moment.seconds, self._up)
        return steady_depths(self._lift(*keypoints, context), self._memory, context)

    def _lift_alone(self, points: Float32, confidence: Float32) -> Lifted:
        """Lift objects in the model's layout of which nothing is remembered."""
        context = None
        if self._up is not None:
            context = self.lifter.memory()(("",) * len(points), 0.0, self._up)
        return self._lift(points, confidence, context)

    def _lift(self, points: Float32, confidence: Float32, context: Context | None) -> Lifted:
        """Lift objects in the model's layout, at their place where the camera is known."""
        if self.camera is None:
            return self.lifter.lift(points, confidence, context=context)
        return lift_perspective(self.lifter, self.camera, points, confidence, context)


def _unit_vector(up: ArrayLike) -> NDArray[np.float64]:
    """Return a direction (3,) with length 1.

    Raises:
        ValueError: it is no direction.
    """
    direction = np.asarray(up, np.float64)
    if direction.shape != (3,) or not 0 < np.linalg.norm(direction) < np.inf:
        raise ValueError(
            f"up is {up!r}; give x, y and z against gravity in the camera's axes: (0, -1, 0) of a "
            "level camera"
        )
    return unit_vector(direction)
