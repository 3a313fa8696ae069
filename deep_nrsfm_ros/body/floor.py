# SPDX-License-Identifier: Apache-2.0
"""Metres from the floor: the camera's height says how large a person is who stands on it.

Size and place of a lifted object scale together. The scale is the one with which the lowest point
is on the floor. A step, a jump or hidden feet make it wrong, so it is averaged over seconds for
each identity: a person does not grow.

Source: ours, not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.body.mean_scale import RANGE, MeanScale

Floats = NDArray[Any]

CLEARANCE = 0.04
"""Metres from the floor to the lowest keypoint of a person who stands: a toe, or an ankle less."""


def floor_factor(shapes: Floats, up: Floats, height: float) -> Floats:
    """Return the factor (n,) that puts the lowest point of each shape on the floor, however large.

    Args:
        shapes: (n, p, 3) at their positions before the camera.
        up: (3,) unit vector against gravity in the same axes.
        height: of the camera above the floor, in metres.

    Returns:
        Infinity for an object above the camera, NaN for a shape that is NaN.
    """
    lowest = (-(shapes @ up)).max(1)
    below = np.where(lowest <= 0, np.nan, lowest)
    return np.where(lowest <= 0, np.inf, (height - CLEARANCE) / below)


def floor_scale(
    shapes: Floats, up: Floats, height: float, believed: tuple[float, float] = RANGE
) -> Floats:
    """Return `floor_factor` (n,), and NaN where it is no size of the object.

    Args:
        shapes: (n, p, 3) at their positions before the camera.
        up: (3,) unit vector against gravity in the same axes.
        height: of the camera above the floor, in metres.
        believed: least and largest factor.
    """
    scale = floor_factor(shapes, up, height)
    return np.where((scale >= believed[0]) & (scale <= believed[1]), scale, np.nan)


class FloorScale:
    """The mean factor of each identity."""

    def __init__(self, height: float) -> None:
        """Start without identities; `height` is that of the camera in metres."""
        self._height = height
        self._mean = MeanScale()

    def __call__(
        self,
        identities: Sequence[str],
        shapes: Floats,
        up: Floats,
        seconds: float,
        believed: tuple[float, float] = RANGE,
    ) -> Floats:
        """Return the factors (n,) of the objects of a message; 1 where nothing is known.

        Args:
            identities: n; "" has no memory.
            shapes: (n, p, 3) at their positions.
            up: (3,) against gravity.
            seconds: time of the message.
            believed: least and largest factor; see `believed_scales`.
        """
        found = floor_scale(shapes.astype(np.float64), up, self._height, believed)
        for identity, scale in zip(identities, found.tolist(), strict=True):
            self._mean.update(identity, scale, seconds)
        means = np.array([self._mean(identity) for identity in identities])
        means = np.where(np.isnan(means), found, means)
        return np.where(np.isnan(means), 1.0, means)

    def forget(self) -> None:
        """Forget all identities."""
        self._mean = MeanScale()
