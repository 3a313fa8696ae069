# SPDX-License-Identifier: Apache-2.0
"""Identities of objects from one message to the next, where the detector gives none.

Detections are assigned to tracks so that the sum of their scores (track_matching.py) is largest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import lap
import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.lifting.track_matching import (
    DECAY,
    MAX_MOTION,
    MOTION_GROWTH,
    SIZE_DECAY,
    VELOCITY_GAIN,
    Complex,
    Floats,
    Tracks,
    match,
    new_tracks,
    to_complex,
    update,
)

MAX_TRACK_AGE = 1.0
"""Seconds after which a track without a detection is deleted, in a stream of at least 3 Hz."""
INTERVALS = 3.0
"""Intervals between messages for which a track lives at least."""

_MAX_LOST = 256  # tracks without a detection that are kept, the latest ones
_PREFIX = "object"  # of the identities that the tracker gives: object1, object2, ...


class _SingleTrack(NamedTuple):
    """The state of the only track; one object is faster without arrays."""

    points: Complex  # (q,)
    visible: bytes  # of the booleans (q,)
    centre: complex  # of the visible keypoints
    velocity: complex
    size: float
    time: float


class Tracker:
    """Gives identities to the objects of one topic; an object keeps its identity.

    An identity that the detector gives is kept. Other objects are assigned to the tracks by
    keypoint similarity to the tracks' predictions. An object that is hidden keeps its identity for
    `MAX_TRACK_AGE`, while the uncertainty of its place grows. A detection that is further than 1.5
    times the size of the object from every prediction is a new object; the size is the RMS distance
    of the keypoints from their centre. The order of the objects in a message does not matter.
    """

    def __init__(self, topic: str = "") -> None:
        """Start without tracks.

        Args:
            topic: prefix of the identities, "topic/identity", that separates this topic from
                others; also the identity of a single object to which the detector gives none. "":
                no prefix.
        """
        self._topic = topic
        self._identities: list[str] = []
        self._tracks: Tracks | None = None
        self._single: _SingleTrack | None = None  # instead of `_tracks`, which is older
        self._now = -np.inf
        self._count = 0

    def __call__(
        self,
        detections: Observation,
        now: float,
        period: float = 0.0,
        tolerances: Floats | None = None,
    ) -> tuple[str, ...]:
        """Return the identities of n detected objects; they differ from one another.

        An object without visible keypoints and without an identity of the detector has identity "".

        Args:
            detections: n objects.
            now: stamp of the message, seconds of any clock.
            period: typical interval between messages in seconds; 0: unknown.
            tolerances: (q,) of `keypoint_tolerances`; None: all 0.2.
        """
        if self._topic and len(detections.confidence) == 1 and not any(detections.identities):
            return (self._topic,)
        memory = max(MAX_TRACK_AGE, INTERVALS * period)
        if now < self._now - memory:
            self.restart()
        self._now = max(now, self._now)
        if self._single and self._continue_single(self._single, detections, now, memory):
            identities = list(self._identities)
        else:
            self._to_arrays()
            identities = self._identify(detections, now, memory, tolerances)
            self._to_single(len(identities))
        if self._topic:
            return tuple(identity and f"{self._topic}/{identity}" for identity in identities)
        return tuple(identities)

    @property
    def track_count(self) -> int:
        """The number of tracks, those without a recent detection too."""
        return 0 if self._tracks is None else len(self._identities)

    def restart(self) -> None:
        """Delete all tracks, as when the stamps begin anew; no identity is given a second time."""
        self._tracks = self._single = None
        self._now = -np.inf

    def _continue_single(
        self, single: _SingleTrack, observation: Observation, now: float, memory: float
    ) -> bool:
        """Update the only track by the only detection; return whether that is possible."""
        if len(observation.confidence) != 1 or any(observation.identities):
            return False
        mask: NDArray[np.bool_] = observation.confidence[0] > 0
        passed = max(now - single.time, 0.0)
        if mask.tobytes() != single.visible or passed > memory:
            return False
        points = to_complex(observation.points)[0].copy()
        visible = points[mask]
        centre = complex(visible.sum()) / len(visible)
        offset = visible - np.complex64(centre)
        decay = math.exp(-passed / DECAY)
        size = math.sqrt(np.vdot(offset, offset).real / len(visible))
        size = max(size, single.size * math.exp(-passed / SIZE_DECAY), 1e-9)
        shift = centre - single.centre - single.velocity * (DECAY * (1 - decay))
        if abs(shift) >= (MAX_MOTION + MOTION_GROWTH * passed) * size:
            return False
        velocity = single.velocity * decay + shift * (VELOCITY_GAIN / max(passed, 1e-3))
        self._single = _SingleTrack(points, single.visible, centre, velocity, size, now)
        return True

    def _to_arrays(self) -> None:
        """Write the only track to the arrays."""
        if single := self._single:
            visible = np.frombuffer(single.visible, bool)
            self._tracks = Tracks(
                np.where(visible, single.points, np.complex64(0))[None],
                np.where(visible, np.float32(0), np.float32(np.inf))[None],
                np.array([single.velocity], np.complex64),
                np.array([single.size], np.float32),
                np.array([single.time]),
            )
            self._single = None

    def _to_single(self, count: int) -> None:
        """Take the only track out of the arrays if none of its keypoints is hidden."""
        tracks = self._tracks
        if tracks is None or count != 1 or len(self._identities) != 1:
            return
        points, age = tracks.points[0], tracks.age[0]
        visible = age == 0
        if (visible | (age == np.inf)).all() and float(tracks.time[0]) == self._now:
            centre, velocity = complex(points[visible].mean()), complex(tracks.velocity[0])
            state = (centre, velocity, float(tracks.size[0]), float(tracks.time[0]))
            self._single = _SingleTrack(points, visible.tobytes(), *state)

    def _identify(
        self, observation: Observation, now: float, memory: float, tolerances: Floats | None
    ) -> list[str]:
        """Return the identities without the topic."""
        identities = _unique(observation)
        detected = np.flatnonzero((observation.confidence > 0).any(1)).tolist()
        rows = [i for i in detected if not identities[i]]
        if not rows:
            return identities
        points, confidence = observation.points, observation.confidence
        if len(rows) < len(identities):
            points, confidence = points[rows], confidence[rows]
        # After a change of the model the keypoints are others and cannot be compared.
        if self._tracks and self._tracks.points.shape[1] == points.shape[1]:
            assigned = self._continue(
                self._tracks, Observation(points, confidence), now, memory, tolerances
            )
        else:
            self._identities, self._tracks, assigned = [], None, [""] * len(rows)
        new = [j for j, identity in enumerate(assigned) if not identity]
        if new:
            used = {*identities, *self._identities}
            # From left to right, so that the order in the message does not matter.
            new.sort(key=lambda j: float(points[j, confidence[j] > 0, 0].mean()))
            for j in new:
                assigned[j] = self._new_identity(used)
            tracks = new_tracks(points[new], confidence[new], now)
            self._append(tracks, [assigned[j] for j in new])
        for i, identity in zip(rows, assigned, strict=True):
            identities[i] = identity
        return identities

    def _continue(
        self,
        tracks: Tracks,
        detections: Observation,
        now: float,
        memory: float,
        tolerances: Floats | None,
    ) -> list[str]:
        """Update the tracks; return the identity of each detection, "" for a new object."""
        points, confidence = detections.points, detections.confidence
        passed = np.maximum(now - tracks.time, 0).astype(np.float32)
        if passed.max() > memory:
            tracks, passed = self._forget(tracks, passed <= memory), passed[passed <= memory]
            if not self._identities:
                return [""] * len(points)
        matches = match(tracks, passed, points, confidence, tolerances)
        assigned = matches.best
        columns = [column for column in assigned.tolist() if column >= 0]
        if len(set(columns)) < len(columns):  # several detections have the same best track
            assigned = _assign(matches.score)
            columns = [column for column in assigned.tolist() if column >= 0]
        self._tracks = update(tracks, passed, points, confidence, assigned, matches.shift)
        self._tracks.time[columns] = now
        return [self._identities[column] if column >= 0 else "" for column in assigned.tolist()]

    def _forget(self, tracks: Tracks, kept: NDArray[np.bool_]) -> Tracks:
        """Return the tracks where `kept` (m,) is true; forget the others' identities."""
        named = zip(self._identities, kept.tolist(), strict=True)
        self._identities = [identity for identity, chosen in named if chosen]
        self._tracks = Tracks(*(part[kept] for part in tracks))
        return self._tracks

    def _append(self, new: Tracks, identities: list[str]) -> None:
        """Add tracks; forget the oldest ones above the limit."""
        self._identities = [*self._identities, *identities]
        if self._tracks is None:
            self._tracks = new
            return
        self._tracks = Tracks(*map(np.concatenate, zip(self._tracks, new, strict=True)))
        limit = _MAX_LOST + len(identities)
        if len(self._identities) > limit:
            kept = np.zeros(len(self._identities), bool)
            kept[np.argsort(self._tracks.time, kind="stable")[-limit:]] = True
            self._forget(self._tracks, kept)

    def _new_identity(self, used: set[str]) -> str:
        """Return an identity that no object has had."""
        while True:
            self._count += 1
            if (identity := f"{_PREFIX}{self._count}") not in used:
                return identity


def _unique(observation: Observation) -> list[str]:
    """Return the detector's identities, "" for none.

    Of several objects with the same identity the one with most visible keypoints keeps it, among
    equal ones the leftmost.
    """
    identities = [identity or "" for identity in observation.identities]
    identities = identities or [""] * len(observation.confidence)
    named = [identity for identity in identities if identity]
    for identity in {name for name in named if named.count(name) > 1} if named else ():
        rows = [i for i, name in enumerate(identities) if name == identity]
        count = (observation.confidence > 0).sum(1).tolist()
        for i in sorted(rows, key=lambda i: (-count[i], *observation.points[i].ravel()))[1:]:
            identities[i] = ""
    return identities


def _assign(score: Floats) -> NDArray[np.int32]:
    """Return the track of each detection, -1 for none, with the largest sum of scores (n, m)."""
    assigned: NDArray[np.int32] = lap.lapjv(-score.astype(float), extend_cost=True)[1]
    rows = np.flatnonzero(assigned >= 0)
    assigned[rows[score[rows, assigned[rows]] <= 0]] = -1
    return assigned
