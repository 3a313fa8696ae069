"""Smoother: objects that tremble less from one time to the next, and stay through short gaps.

The One-Euro filter (Casiez, Roussel and Vogel, CHI 2012): a first-order low-pass whose cutoff rises
with the speed of what it follows, so that it holds still what rests and lags little behind what
moves. Shapes are filtered in the axes of the object, and rotations by their steps on SO(3), so that
the two still belong together; in the camera's axes the points alone would come out as steady.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.configuration import option
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_vector, rotation_vector

Floats = NDArray[Any]

MAX_AGE = 1.0
"""Seconds after which an object that was not lifted begins anew, if `max_gap` is not longer."""
_SPEED_CUTOFF = 1.0  # Hz, of the speed; the paper's


@dataclass(frozen=True)
class SmoothingOptions:
    """Smoother."""

    enabled: bool = option(
        False,
        "filter shape and rotation over time, each object by its identity and the stamps of its "
        "messages; lags by some 40 ms at walking speed",
    )
    min_cutoff: float = option(
        0.2,
        "cutoff in Hz for what rests: less trembles less and lags more",
        low=0.001,
        high=1000.0,
    )
    beta: float = option(
        4.0,
        "Hz by which the cutoff rises with the speed, in RMS radii of the object, or in radians, "
        "a second: more lags less and trembles more",
        low=0.0,
        high=1000.0,
    )
    max_gap: float = option(
        0.3,
        "seconds for which an object that cannot be lifted, or is not in the message, is answered "
        "by what it was last, with a confidence that falls to 0",
        low=0.0,
        high=60.0,
    )


class _OneEuro:
    """One filter: what it follows it knows by differences alone, so rotations can be followed."""

    def __init__(self, options: SmoothingOptions, like: Floats) -> None:
        """Rest."""
        self._options = options
        self._speed = np.zeros_like(like)

    def share(self, step: Floats, seconds: float, size: float = 1.0) -> Floats:
        """Return how much (..., 1) of the way to the newest value to go.

        step: (..., 3) from the last raw value to the newest, in units of `size`. The paper takes
        it from the filtered value; from the raw one the lag does not depend on the rate.
        """
        self._speed += _smoothing(_SPEED_CUTOFF, seconds) * (step / seconds - self._speed)
        speed = np.sqrt((self._speed * self._speed).sum(-1, keepdims=True)) / size
        share: Floats = _smoothing(self._options.min_cutoff + self._options.beta * speed, seconds)
        return share


def _smoothing(cutoff: Any, seconds: float) -> Any:
    """Return the share of the newest value in a low-pass of `cutoff` Hz."""
    return 1 - 1 / (1 + 2 * np.pi * cutoff * seconds)


class _Track:
    """One object over time: raw and filtered shape (p, 3) in its axes, centre (3,), rotation."""

    def __init__(self, options: SmoothingOptions, lifted: Lifted, time: float) -> None:
        """Begin with an object (n = 1) as it was lifted."""
        self.time = time
        self.lifted = lifted
        self._raw = self._smooth = _parts(lifted)
        self._filters = [_OneEuro(options, part) for part in (*self._raw[:2], self._raw[1])]

    def follow(self, lifted: Lifted, time: float) -> None:
        """Take an object (n = 1) as it was lifted later."""
        seconds, self.time = time - self.time, time
        (S0, c0, R0), (S1, c1, R1) = self._raw, _parts(lifted)
        S, c, R = self._smooth
        size = float(np.sqrt((S1 * S1).sum(1).mean())) or 1.0
        shape, centre, rotation = self._filters
        S = S + shape.share(S1 - S0, seconds, size) * (S1 - S)
        c = c + centre.share(c1 - c0, seconds, size) * (c1 - c)
        part = rotation.share(rotation_vector(R1 @ R0.T), seconds)
        R = rotation_from_vector(part * rotation_vector(R1 @ R.T)) @ R
        self._raw, self._smooth = (S1, c1, R1), (S, c, R)
        shapes = (S @ R.T + c)[None].astype(np.float32)
        self.lifted = lifted._replace(shapes=shapes, rotations=R[None].astype(np.float32))

    def faded(self, share: float) -> Lifted:
        """Return the object as it was last, with `share` of its confidence."""
        return self.lifted._replace(confidence=self.lifted.confidence * np.float32(share))


def _parts(lifted: Lifted) -> tuple[Floats, Floats, Floats]:
    """Return shape (p, 3) in object axes, centre (3,) and rotation (3, 3) of one object."""
    S, R = lifted.shapes[0].astype(np.float64), lifted.rotations[0].astype(np.float64)
    centre = S.mean(0)
    return (S - centre) @ R, centre, R


class Smoother:
    """Filters of all objects that are there, each known by its identity.

    An object that is lifted again after more than `MAX_AGE` and `max_gap` begins anew. What comes
    of an object late, or with the stamp of what came before, is answered as it was lifted and
    changes nothing; a clock that goes back by more than `MAX_AGE` forgets everything.
    """

    def __init__(self, options: SmoothingOptions) -> None:
        """Know nobody."""
        self._options = options
        self._memory = max(MAX_AGE, options.max_gap)
        self._tracks: dict[str, _Track] = {}
        self._now = -np.inf

    def __call__(
        self, lifted: Lifted, identities: tuple[str, ...], time: float
    ) -> tuple[Lifted, tuple[str, ...]]:
        """Return the objects, steadied, and their identities.

        lifted: n objects, at `time` in seconds of any clock. identities: n. Objects that are
        bridged and not among them come last.
        """
        if not self._options.enabled:
            return lifted, identities
        if time < self._now - MAX_AGE:
            self._tracks.clear()
            self._now = -np.inf
        self._now = max(time, self._now)
        oldest = self._now - self._memory
        self._tracks = {identity: t for identity, t in self._tracks.items() if t.time >= oldest}
        objects = [
            self._follow(Lifted(*(part[i : i + 1] for part in lifted)), identity, time)
            for i, identity in enumerate(identities)
        ]
        absent = [
            identity
            for identity in self._tracks
            if identity not in identities and self._left(identity, time)
        ]
        objects += [self._tracks[identity].faded(self._left(identity, time)) for identity in absent]
        if not objects:
            return lifted, identities
        together = Lifted(*(np.concatenate(parts) for parts in zip(*objects, strict=True)))
        return together, (*identities, *absent)

    def _follow(self, lifted: Lifted, identity: str, time: float) -> Lifted:
        """Return one object (n = 1), steadied or bridged."""
        track = self._tracks.get(identity)
        if np.isnan(lifted.residual[0]):
            left = self._left(identity, time)
            return track.faded(left) if track and left else lifted
        if track is None:
            self._tracks[identity] = _Track(self._options, lifted, time)
            return lifted
        if time <= track.time:
            return lifted
        track.follow(lifted, time)
        return track.lifted

    def _left(self, identity: str, time: float) -> float:
        """Return the share of `max_gap` that is left of an object, 0 of one that is not known."""
        track, max_gap = self._tracks.get(identity), self._options.max_gap
        if track is None or not max_gap or time < track.time:
            return 0.0
        return max(0.0, 1 - (time - track.time) / max_gap)
