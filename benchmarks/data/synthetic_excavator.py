# SPDX-License-Identifier: Apache-2.0
"""A synthetic excavator, seen by a camera that moves around it; layout excavator.yaml.

Metres; x to the front of the tracks, y left, z up. The upper structure rotates on the tracks; boom,
arm and bucket move in its middle plane.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.lifting.intrinsics import Intrinsics

Floats = NDArray[Any]

RATE = 10.0
"""Frames a second."""
CAMERA, DISTANCE = Intrinsics((1000.0, 1000.0), (640.0, 360.0)), 25.0
"""Intrinsics in pixels, and distance to the middle of the machine in metres."""
NOISE = 1.0
"""Standard deviation of the keypoints in pixels."""
_TRACKS = ((1.8, 1.2, 0.5), (1.8, -1.2, 0.5), (-1.8, 1.2, 0.5), (-1.8, -1.2, 0.5))
_UPPER = ((1.2, 0.9, 2.9), (-0.2, 0.9, 2.9), (-2.2, 1.2, 1.6), (-2.2, -1.2, 1.6), (0.6, 0.0, 1.8))
_ARM = ((5.0, 20, 65), (2.6, -130, -70), (1.3, -100, -20))
"""Boom, arm, bucket: length (m), lowest and highest angle to the previous part (degrees)."""


class Recording(NamedTuple):
    """Points (f, 13, 2) in pixels and truth (f, 13, 3) in metres in the camera's axes."""

    points: Floats
    truth: Floats


def record(frames: int, seed: int) -> Recording:
    """Return `frames` frames of random motion."""
    rng = np.random.default_rng(seed)
    machine = _machine(frames, rng)
    around, above = _wander(frames, rng, -360, 360, 60), _wander(frames, rng, 10, 45, 30)
    # From the front of the tracks the camera looks along -x: its x is the machine's y.
    ahead = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    turn = Rotation.from_euler("x", above, degrees=True).as_matrix() @ ahead
    turn = turn @ Rotation.from_euler("z", around, degrees=True).as_matrix()
    truth = (machine - machine.mean((0, 1))) @ turn.swapaxes(1, 2)
    rays = truth[..., :2] / (truth[..., 2:] + DISTANCE)
    points = np.array(CAMERA.focal) * rays + CAMERA.principal
    return Recording(points + NOISE * rng.standard_normal(points.shape), truth)


def _machine(frames: int, rng: np.random.Generator) -> Floats:
    """Return the keypoints (f, 13, 3) of excavator.yaml, in its order."""
    swing = Rotation.from_euler("z", _wander(frames, rng, -180, 180, 20), degrees=True)
    upper = np.tile(_UPPER, (frames, 1, 1))
    pitch = np.zeros(frames)
    for length, low, high in _ARM:
        pitch = pitch + np.radians(_wander(frames, rng, low, high, 8))
        step = length * np.stack((np.cos(pitch), np.zeros(frames), np.sin(pitch)), 1)
        upper = np.concatenate((upper, upper[:, -1:] + step[:, None]), 1)
    upper = upper @ swing.as_matrix().swapaxes(1, 2)
    tracks = np.tile(_TRACKS, (frames, 1, 1))
    return np.concatenate((tracks, upper, tracks.mean(1, keepdims=True)), 1)


def _wander(
    frames: int, rng: np.random.Generator, low: float, high: float, seconds: float
) -> Floats:
    """Return a smooth random path (f,) between low and high with periods of 1 to 4 `seconds`."""
    periods, phases = seconds * rng.uniform(1, 4, 5), rng.uniform(0, 2 * np.pi, 5)
    times = np.arange(frames)[:, None] / RATE
    waves = np.sin(2 * np.pi * times / periods + phases).mean(1)
    path: Floats = low + (high - low) * (0.5 + 0.5 * np.sin(np.pi * waves))
    return path
