"""Identities of objects from one message to the next, where the detector gives none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import Observation

MAX_AGE = 1.0
"""Seconds after which a track without a detection is deleted."""

_MAX_MOTION = 1.5  # from one detection to the next, in sizes of the object
_PREFIX = "object"  # of the identities that the tracker gives: object1, object2, ...


class _Tracks(NamedTuple):
    """The last detections of m objects, in arrays, so that all are compared at once."""

    identities: list[str]
    points: NDArray[np.float32]  # (m, q, 2) pixels
    visible: NDArray[np.float32]  # (m, q) 1 or 0
    size: NDArray[np.float32]  # (m,) RMS distance of the keypoints from their centre, pixels
    time: NDArray[np.float64]  # (m,) seconds


class Tracker:
    """Gives identities to the objects of one topic; an object keeps its identity.

    An identity that the detector gives is kept. Other objects are matched to the tracks, the
    closest pair first. Two detections match if the keypoints visible in both have moved, on
    average, by less than 1.5 times the size of the object, and less than `max_age` has passed. The
    size is the RMS distance of the keypoints from their centre.
    """

    def __init__(self, topic: str = "", max_age: float = MAX_AGE) -> None:
        """Start without tracks.

        Args:
            topic: prefix of the identities, "topic/identity", that separates this topic from
                others; also the identity of a single object to which the detector gives none. "":
                no prefix.
            max_age: seconds after which a track without a detection is deleted.
        """
        self._topic, self._max_age = topic, max_age
        self._tracks: _Tracks | None = None
        self._count = 0

    def __call__(self, detections: Observation, now: float) -> tuple[str, ...]:
        """Return the identities of n detected objects; they differ from one another.

        An object without visible keypoints and without an identity of the detector has identity "".

        Args:
            detections: n objects.
            now: seconds of any clock.
        """
        if not self._topic:
            return self._match(detections, now)
        if len(detections.confidence) == 1 and not any(detections.identities):
            return (self._topic,)
        return tuple(
            identity and f"{self._topic}/{identity}" for identity in self._match(detections, now)
        )

    def _match(self, detections: Observation, now: float) -> tuple[str, ...]:
        """Return the identities without the topic."""
        identities = _unique(detections)
        unmatched = [
            i
            for i, identity in enumerate(identities)
            if not identity and detections.confidence[i].any()
        ]
        if not unmatched:
            return tuple(identities)
        new = _new_tracks(detections, unmatched, now)
        old = self._tracks
        # After a change of the model the keypoints are others and cannot be compared.
        if old is not None and old.points.shape[1:] == new.points.shape[1:]:
            old = _select(old, (now >= old.time) & (now - old.time <= self._max_age))
            distance = _distance(new, old)
            candidates = np.argwhere(distance < _MAX_MOTION)
            matched = np.zeros(len(old.identities), bool)
            for j, k in candidates[distance[tuple(candidates.T)].argsort()].tolist():
                if not new.identities[j] and not matched[k]:
                    new.identities[j], matched[k] = old.identities[k], True
            old = _select(old, ~matched)
        else:
            old = None
        for j, i in enumerate(unmatched):
            identities[i] = new.identities[j] = new.identities[j] or self._new_identity(identities)
        self._tracks = _concatenate(old, new) if old and old.identities else new
        return tuple(identities)

    def _new_identity(self, used: list[str]) -> str:
        """Return an identity that no object has had."""
        self._count += 1
        identity = f"{_PREFIX}{self._count}"
        return self._new_identity(used) if identity in used else identity


def _unique(detections: Observation) -> list[str]:
    """Return the detector's identities, "" for none and for the second of two equal ones."""
    identities = [identity or "" for identity in detections.identities]
    identities = identities or [""] * len(detections.confidence)
    return [
        identity if identity not in identities[:i] else "" for i, identity in enumerate(identities)
    ]


def _new_tracks(detections: Observation, rows: list[int], now: float) -> _Tracks:
    """Return tracks without identities of some objects, each with a visible keypoint."""
    points, visible = detections.points[rows], (detections.confidence[rows] > 0).astype(np.float32)
    weight = visible[..., None] / visible.sum(1)[:, None, None]
    offset = points - (points * weight).sum(1, keepdims=True)
    size = np.sqrt((offset * offset * weight).sum((1, 2)))
    return _Tracks([""] * len(rows), points, visible, size, np.full(len(rows), now))


def _select(tracks: _Tracks, mask: NDArray[np.bool_]) -> _Tracks:
    """Return the tracks where `mask` (m,) is true."""
    identities = [
        identity
        for identity, chosen in zip(tracks.identities, mask.tolist(), strict=True)
        if chosen
    ]
    _, points, visible, size, time = tracks
    return _Tracks(identities, points[mask], visible[mask], size[mask], time[mask])


def _concatenate(a: _Tracks, b: _Tracks) -> _Tracks:
    """Return the tracks of both."""
    return _Tracks(
        a.identities + b.identities,
        np.concatenate([a.points, b.points]),
        np.concatenate([a.visible, b.visible]),
        np.concatenate([a.size, b.size]),
        np.concatenate([a.time, b.time]),
    )


def _distance(a: _Tracks, b: _Tracks) -> NDArray[np.float32]:
    """Return the mean motion (m, n) from a to b in object sizes; NaN without a common keypoint."""
    both = a.visible[:, None] * b.visible[None]
    motion = ((a.points[:, None] - b.points[None]) * both[..., None]).sum(2)
    with np.errstate(invalid="ignore", divide="ignore"):
        distance: NDArray[np.float32] = np.hypot(motion[..., 0], motion[..., 1]) / both.sum(2)
        distance /= np.maximum(np.maximum(a.size[:, None], b.size[None]), np.float32(1e-9))
    return distance
