# SPDX-License-Identifier: Apache-2.0
"""Whether the direction of gravity can be right: people stand in the image, and lie against it.

A wrong direction, such as one with another sign or in the axes of the camera's body, spoils shapes
and lays people on their side in a fixed frame. One message does not show it: people bend and lie.
Over seconds it is seen where people are upright in the image, and nearly all of them are upside
down against gravity, or horizontal before a camera that would look at the ceiling. Somebody who
lies, or whom a camera at the ceiling sees, is neither.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.sanity import Finding

Floats = NDArray[Any]

WINDOW = 15.0
"""Seconds that are looked at."""

_INTERVAL = 0.2  # s between two messages that are kept
_LEAST_SECONDS = 5.0  # of people
_LEAST = 20  # people of all messages
_UPRIGHT = 0.7  # cosine between a person's up axis and that of the image, of somebody upright
_MOST = 0.6  # fraction of the people who must be upright in the image
_NEARLY_ALL = 0.95  # fraction of these who must disagree
_UPSIDE_DOWN = -0.5  # cosine between up axis and the direction against gravity: more than 120 deg
_OFF = 0.5  # the same: more than 60 degrees
_LOOKS_UP = 0.9  # cosine between the camera's view and the direction against gravity


class _Seen(NamedTuple):
    """The people of one message.

    Attributes:
        seconds: when.
        image: (n,) cosine between the up axis of each and that of the image.
        gravity: (n,) cosine between it and the direction against gravity.
        view: cosine between the camera's view and the direction against gravity.
    """

    seconds: float
    image: Floats
    gravity: Floats
    view: float


class GravityCheck:
    """Compares the direction against gravity with the people of the last seconds."""

    def __init__(self) -> None:
        """Start without people."""
        self._seen: deque[_Seen] = deque()

    def add(self, seconds: float, rotations: Floats, up: Floats) -> None:
        """Keep the people of a message; most messages are left out.

        Args:
            seconds: of a clock that is never set back.
            rotations: (n, 3, 3) from object axes (z up) to camera axes; NaN where not lifted.
            up: (3,) unit vector against gravity in the camera's axes.
        """
        seen = self._seen
        if seen and seconds - seen[-1].seconds < _INTERVAL:
            return
        axes = rotations[:, :, 2]
        axes = axes[np.isfinite(axes).all(1)].astype(np.float64)
        if len(axes):
            seen.append(_Seen(seconds, -axes[:, 1], axes @ up, float(up[2])))
        while seen and seen[0].seconds < seconds - WINDOW:
            seen.popleft()

    def forget(self) -> None:
        """Forget all people."""
        self._seen.clear()

    def find(self, source: str, mend: str) -> list[Finding]:
        """Return whether people and gravity disagree.

        Args:
            source: of the direction, for the message.
            mend: what to check.
        """
        seen = self._seen
        if len(seen) < 2 or seen[-1].seconds - seen[0].seconds < _LEAST_SECONDS:
            return []
        image = np.concatenate([each.image for each in seen])
        gravity = np.concatenate([each.gravity for each in seen])
        view = np.concatenate([np.full(len(each.image), each.view) for each in seen])
        upright = image > _UPRIGHT
        if upright.sum() < _LEAST or upright.mean() < _MOST:
            return []
        disagrees = (gravity < _UPSIDE_DOWN) | (gravity < _OFF) & (view > _LOOKS_UP)
        if disagrees[upright].mean() < _NEARLY_ALL:
            return []
        angle = np.degrees(np.arccos(np.clip(np.median(gravity[upright]), -1, 1)))
        return [
            Finding(
                "gravity",
                f"people stand upright in the image, and {angle:.0f} degrees off the direction "
                f"against gravity that {source} gives: {mend}",
            )
        ]
