# SPDX-License-Identifier: Apache-2.0
"""Smoothing over time: less jitter of shapes and rotations, and short gaps filled.

The One-Euro filter is a first-order low-pass whose cutoff frequency rises with the speed of its
input: an object at rest is held still, a moving one is followed with little lag. Shapes are
filtered in object axes and rotations by their steps on SO(3), so that both still agree. Filtering
the points in camera axes would smooth them as much, but not the rotation.

Source: Casiez, Roussel and Vogel, "1 Euro Filter", CHI 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.configuration import described, option
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_vector, rotation_vector

Floats = NDArray[Any]

FILTER_RESET_TIME = 1.0
"""Seconds after which an object that was not lifted is filtered from its next frame on."""
_INTERVALS = 3.0  # between messages, for which a filter lives and a gap is filled at least
SPEED_CUTOFF = 1.0
"""Hz, of the low-pass of the speed, as in the paper."""


@dataclass(frozen=True)
@described
class SmoothingOptions:
    """Smoothing over time."""

    enabled: bool = option(
        False,
        "whether shapes and rotations are filtered over time after the correction (One-Euro "
        "filter), each object by its identity and the stamps of its messages: less jitter than "
        "history.* leaves, by half for people at rest, at a lag of about 40 ms at walking speed",
    )
    min_cutoff: float = option(
        0.2,
        "cutoff frequency in Hz for an object at rest; lower: less jitter and more lag; 0.2 "
        "typical, 1 weak",
        low=0.001,
        high=1000.0,
    )
    beta: float = option(
        4.0,
        "Hz by which the cutoff frequency rises per unit of speed, in RMS radii of the object or "
        "radians per second; 0 = constant cutoff; higher: less lag and more jitter; 4 typical",
        low=0.0,
        high=1000.0,
    )
    max_gap: float = option(
        0.3,
        "longest gap in s that is filled, or 3 intervals of a slower stream: an object that cannot "
        "be lifted, or is missing from the message, keeps its last shape and rotation while its "
        "confidence falls to 0; 0 = off, 0.3 typical",
        low=0.0,
        high=60.0,
    )


class _OneEuro:
    """One-Euro filter of vectors or rotations; its input is the step between two values."""

    def __init__(self, options: SmoothingOptions, like: Floats) -> None:
        """Start with speed 0 in the shape of `like` (..., 3)."""
        self._options = options
        self._speed = np.zeros_like(like)

    def alpha(self, step: Floats, seconds: float, size: float = 1.0) -> Floats:
        """Return the smoothing factor alpha (..., 1) in (0, 1].

        The paper takes the step from the filtered value; from the raw value, the lag does not
        depend on the rate.

        Args:
            step: (..., 3) from the last raw value to the newest one.
            seconds: time between the two.
            size: unit of the step.
        """
        self._speed += low_pass_gain(SPEED_CUTOFF, seconds) * (step / seconds - self._speed)
        speed = np.sqrt((self._speed * self._speed).sum(-1, keepdims=True)) / size
        alpha: Floats = low_pass_gain(
            self._options.min_cutoff + self._options.beta * speed, seconds
        )
        return alpha


def low_pass_gain(cutoff: Any, seconds: float) -> Any:
    """Return the weight of the newest value in a low-pass.

    Args:
        cutoff: in Hz, above 0.
        seconds: since the value before.
    """
    return 1 - 1 / (1 + 2 * np.pi * cutoff * seconds)


class _Track:
    """Filter state of one object: raw and smoothed shape (p, 3) in object axes, centre, rotation.

    Attributes:
        time: of the last frame in which the object was lifted, seconds.
        lifted: the object (n = 1) as smoothed in that frame.
    """

    def __init__(self, options: SmoothingOptions, lifted: Lifted, time: float) -> None:
        """Start with a lifted object (n = 1)."""
        self.time = time
        self.lifted = lifted
        self._raw = self._smoothed = _decompose(lifted)
        self._filters = [_OneEuro(options, part) for part in (*self._raw[:2], self._raw[1])]

    def update(self, lifted: Lifted, time: float) -> None:
        """Filter the next frame of the object (n = 1)."""
        seconds, self.time = time - self.time, time
        (S0, c0, R0), (S1, c1, R1) = self._raw, _decompose(lifted)
        S, c, R = self._smoothed
        size = float(np.sqrt((S1 * S1).sum(1).mean())) or 1.0
        shape, centre, rotation = self._filters
        S = S + shape.alpha(S1 - S0, seconds, size) * (S1 - S)
        c = c + centre.alpha(c1 - c0, seconds, size) * (c1 - c)
        alpha = rotation.alpha(rotation_vector(R1 @ R0.T), seconds)
        R = rotation_from_vector(alpha * rotation_vector(R1 @ R.T)) @ R
        self._raw, self._smoothed = (S1, c1, R1), (S, c, R)
        shapes = (S @ R.T + c)[None].astype(np.float32)
        self.lifted = lifted._replace(shapes=shapes, rotations=R[None].astype(np.float32))

    def faded(self, factor: float) -> Lifted:
        """Return the last smoothed object with its confidence multiplied by `factor`."""
        confidence = self.lifted.confidence * np.float32(factor)
        nothing = np.zeros_like(self.lifted.wrong)
        return self.lifted._replace(confidence=confidence, wrong=nothing)


def _decompose(lifted: Lifted) -> tuple[Floats, Floats, Floats]:
    """Return shape (p, 3) in object axes, centre (3,) and rotation (3, 3) of one object."""
    S, R = lifted.shapes[0].astype(np.float64), lifted.rotations[0].astype(np.float64)
    centre = S.mean(0)
    return (S - centre) @ R, centre, R


class Smoother:
    """Smooths all objects of one topic, each by its identity.

    The filter of an object starts anew when the object is lifted again after more than
    `FILTER_RESET_TIME`, `max_gap` and 3 periods of the stream. A frame of an object with the stamp
    of its last frame, or an earlier one, is returned as lifted and does not change the filter. A
    clock that jumps back by more than `FILTER_RESET_TIME` and 3 periods deletes all filters.
    """

    def __init__(self, options: SmoothingOptions) -> None:
        """Start without objects."""
        self._options = options
        self._period = 0.0
        self._tracks: dict[str, _Track] = {}
        self._now = -np.inf

    def __call__(
        self, lifted: Lifted, identities: tuple[str, ...], time: float, period: float = 0.0
    ) -> tuple[Lifted, tuple[str, ...]]:
        """Return the smoothed objects and their identities.

        Objects whose gap is filled and that the message does not contain are appended.

        Args:
            lifted: n objects.
            identities: n.
            time: of the message, seconds of any clock.
            period: typical interval between messages in seconds; 0: unknown.
        """
        if not self._options.enabled:
            return lifted, identities
        self._period = period
        if time < self._now - max(FILTER_RESET_TIME, _INTERVALS * period):
            self._tracks.clear()
            self._now = -np.inf
        self._now = max(time, self._now)
        oldest = self._now - max(FILTER_RESET_TIME, self._max_gap, _INTERVALS * period)
        self._tracks = {
            identity: track for identity, track in self._tracks.items() if track.time >= oldest
        }
        objects = [
            self._smooth(lifted.at([i]), identity, time) for i, identity in enumerate(identities)
        ]
        absent = [
            identity
            for identity in self._tracks
            if identity not in identities and self._gap_left(identity, time)
        ]
        objects += [
            self._tracks[identity].faded(self._gap_left(identity, time)) for identity in absent
        ]
        if not objects:
            return lifted, identities
        together = Lifted._make(np.concatenate(parts) for parts in zip(*objects, strict=True))
        return together, (*identities, *absent)

    @property
    def _max_gap(self) -> float:
        """The longest gap that is filled, in seconds: `max_gap`, or 3 periods; 0 = off."""
        max_gap = self._options.max_gap
        return max(max_gap, _INTERVALS * self._period) if max_gap else 0.0

    def _smooth(self, lifted: Lifted, identity: str, time: float) -> Lifted:
        """Return one object (n = 1), smoothed, or its last state if it could not be lifted."""
        track = self._tracks.get(identity)
        if np.isnan(lifted.residual[0]):
            left = self._gap_left(identity, time)
            return track.faded(left) if track and left else lifted
        if track is None:
            self._tracks[identity] = _Track(self._options, lifted, time)
            return lifted
        if time <= track.time:
            return lifted
        track.update(lifted, time)
        return track.lifted

    def _gap_left(self, identity: str, time: float) -> float:
        """Return the fraction of `max_gap` that remains for an object, 0 if it has no track."""
        track, max_gap = self._tracks.get(identity), self._max_gap
        if track is None or not max_gap or time < track.time:
            return 0.0
        return max(0.0, 1 - (time - track.time) / max_gap)
