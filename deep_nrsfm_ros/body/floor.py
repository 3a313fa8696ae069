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

Floats = NDArray[Any]

CLEARANCE = 0.04
"""Metres from the floor to the lowest keypoint of a person who stands: a toe, or an ankle less."""
SCALE_TIME = 3.0
"""Time constant in s of an identity's mean scale."""
_RANGE = (0.4, 2.5)  # of a scale that is believed
_MAX_IDENTITIES = 1000


def floor_scale(shapes: Floats, up: Floats, height: float) -> Floats:
    """Return the factor (n,) that puts the lowest point of each shape on the floor.

    Args:
        shapes: (n, p, 3) at their positions before the camera.
        up: (3,) unit vector against gravity in the same axes.
        height: of the camera above the floor, in metres.

    Returns:
        NaN for an object above the camera, or with a factor beyond 0.4 to 2.5.
    """
    lowest = (-(shapes @ up)).max(1)
    scale = (height - CLEARANCE) / np.where(lowest > 0, lowest, np.nan)
    believed = (scale >= _RANGE[0]) & (scale <= _RANGE[1])
    return np.where(believed, scale, np.nan)


class FloorScale:
    """The mean factor of each identity."""

    def __init__(self, height: float) -> None:
        """Start without identities; `height` is that of the camera in metres."""
        self._height = height
        self._scales: dict[str, tuple[float, float, float]] = {}

    def __call__(
        self, identities: Sequence[str], shapes: Floats, up: Floats, seconds: float
    ) -> Floats:
        """Return the factors (n,) of the objects of a message; 1 where nothing is known.

        Args:
            identities: n; "" has no memory.
            shapes: (n, p, 3) at their positions.
            up: (3,) against gravity.
            seconds: time of the message.
        """
        found = floor_scale(shapes.astype(np.float64), up, self._height)
        scales = np.where(np.isnan(found), 1.0, found)
        for i, identity in enumerate(identities):
            if not identity:
                continue
            mean, weight, last = self._scales.get(identity, (1.0, 0.0, seconds))
            passed = max(seconds - last, 0.0)
            weight *= float(np.exp(-passed / SCALE_TIME))
            if not np.isnan(found[i]):
                mean += (float(found[i]) - mean) / (weight + 1)
                weight += 1
            if weight:
                scales[i] = mean
            if identity in self._scales or len(self._scales) < _MAX_IDENTITIES:
                self._scales[identity] = mean, weight, seconds
        return scales

    def forget(self) -> None:
        """Forget all identities."""
        self._scales.clear()
