# SPDX-License-Identifier: Apache-2.0
"""Velocities and the state of tracking of identities.

A velocity is the step of a position between two messages, through a first-order low-pass: it lags
by the time constant and half an interval.

Source: ours, not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]

NEW, TRACKED, BRIDGED, LOST = "new", "tracked", "bridged", "lost"
NEW_TIME = 0.5
"""Seconds after its first sight for which an identity is new."""
LOST_TIME = 1.0
"""Seconds without sight after which an identity is lost."""
INTERVALS = 3.0
"""Intervals of a slower stream for which an identity is not lost, and has a velocity."""
LOST_SHOWN = 1.0
"""Seconds for which a lost identity is told, since a message may get lost too."""
_MAX_STEP = 1.0  # s between two messages over which there is no velocity


class Motion(NamedTuple):
    """The motion of n identities.

    Attributes:
        velocities: (n, j, 3) of points, in their unit per second; NaN in the first message and for
            an object that is not lifted.
        states: n of `NEW`, `TRACKED`, `BRIDGED` (kept by smoothing over a gap), and `LOST` for an
            object that is not lifted.
        ages: (n,) seconds since the first sight.
        lost: identities that are lost since `LOST_SHOWN` seconds, or since the last message.
    """

    velocities: Floats
    states: tuple[str, ...]
    ages: Floats
    lost: tuple[str, ...]


class _Track:
    """What is remembered of an identity."""

    def __init__(self, seconds: float, points: Floats) -> None:
        """Start with the first sight: its time and points (j, 3)."""
        self.first = self.last = seconds
        self.points = points
        self.velocity = np.full_like(points, np.nan)

    def update(self, seconds: float, points: Floats, time_constant: float, limit: float) -> None:
        """Filter the velocity with the next points (j, 3)."""
        step = seconds - self.last
        if step <= 0:
            return
        if step > limit:
            self.velocity = np.full_like(points, np.nan)
        else:
            velocity = (points - self.points) / step
            alpha = step / (time_constant + step)
            smoothed = self.velocity + alpha * (velocity - self.velocity)
            self.velocity = np.where(np.isnan(smoothed), velocity, smoothed)
        self.last, self.points = seconds, points


class MotionTracker:
    """Velocity and state of the identities of one stream."""

    def __init__(self, time_constant: float) -> None:
        """Start without identities.

        Args:
            time_constant: of the velocities' low-pass in seconds; 0 = no filter, 0.1 typical.
        """
        self._time_constant = time_constant
        self._tracks: dict[str, _Track] = {}
        self._lost: dict[str, float] = {}  # when each was found to be lost

    def __len__(self) -> int:
        """Return the number of identities that are not lost."""
        return len(self._tracks)

    def __call__(
        self,
        identities: Sequence[str],
        points: Floats,
        seconds: float,
        period: float = 0.0,
        bridged: int = 0,
    ) -> Motion:
        """Return the motion of the objects of a message.

        Args:
            identities: n names.
            points: (n, j, 3); NaN for an object that is not lifted.
            seconds: time of the message.
            period: typical interval between messages in seconds; 0: unknown.
            bridged: number of the last objects that the message did not contain.
        """
        n = len(identities)
        limit = max(_MAX_STEP, INTERVALS * period)
        if self._tracks and seconds < max(t.last for t in self._tracks.values()) - limit:
            self._tracks.clear()  # the clock begins anew
            self._lost.clear()
        lifted = np.asarray(np.isfinite(points).all((1, 2)), bool)
        velocities, ages = np.full(points.shape, np.nan), np.zeros(n)
        states: list[str] = []
        for i, identity in enumerate(identities):
            track = self._tracks.get(identity)
            seen = i < n - bridged and lifted[i]
            if seen and track is None:
                track = self._tracks[identity] = _Track(seconds, points[i])
            elif seen and track is not None:
                track.update(seconds, points[i], self._time_constant, limit)
            if track is not None:
                ages[i] = max(seconds - track.first, 0.0)
                if lifted[i]:
                    velocities[i] = track.velocity
            fresh = NEW if ages[i] < NEW_TIME else TRACKED
            states.append(fresh if seen else BRIDGED if lifted[i] else LOST)
        oldest = seconds - max(LOST_TIME, INTERVALS * period)
        lost = tuple(name for name, track in self._tracks.items() if track.last < oldest)
        for name in lost:
            del self._tracks[name]
        since = seconds - LOST_SHOWN
        known = {n: t for n, t in self._lost.items() if since <= t <= seconds}
        self._lost = {n: t for n, t in known.items() if n not in self._tracks}
        self._lost |= dict.fromkeys(lost, seconds)
        return Motion(velocities, tuple(states), ages, tuple(self._lost))
