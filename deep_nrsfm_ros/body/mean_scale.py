# SPDX-License-Identifier: Apache-2.0
"""The mean scale of each identity: an object's size does not change."""

from __future__ import annotations

import math

SCALE_TIME = 3.0
"""Time constant in s of an identity's mean scale."""
RANGE = (0.4, 2.5)
"""Scales that are believed: from a small child to twice the assumed size."""
_MAX_IDENTITIES = 1000


class MeanScale:
    """The mean of the scales of each identity, over the seconds in which there were some."""

    def __init__(self) -> None:
        """Start without identities."""
        self._scales: dict[str, tuple[float, float, float]] = {}

    def __call__(self, identity: str) -> float:
        """Return the mean scale of an identity, NaN if it has none."""
        mean, weight, _ = self._scales.get(identity, (math.nan, 0.0, 0.0))
        return mean if weight else math.nan

    def update(self, identity: str, scale: float, seconds: float) -> None:
        """Take a scale into the mean of its identity.

        Args:
            identity: "" has no memory.
            scale: NaN: none is found at this time.
            seconds: time of the message.
        """
        if not identity:
            return
        mean, weight, last = self._scales.get(identity, (1.0, 0.0, seconds))
        weight *= math.exp(-max(seconds - last, 0.0) / SCALE_TIME)
        if not math.isnan(scale):
            mean += (scale - mean) / (weight + 1)
            weight += 1
        if identity in self._scales or len(self._scales) < _MAX_IDENTITIES:
            self._scales[identity] = mean, weight, seconds
