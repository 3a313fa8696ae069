"""Who is who from one message to the next, where the detector does not say."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import Observation

MAX_AGE = 1.0
"""Seconds after which an object that is not seen is forgotten."""

_FARTHEST = 1.5  # moves from one message to the next, in sizes of the object
_NAME = "object"


class _Tracks(NamedTuple):
    """m objects as they were seen the last time, in arrays, so that all are compared at once."""

    identities: list[str]
    points: NDArray[np.float32]  # (m, q, 2)
    visible: NDArray[np.float32]  # (m, q) 1 or 0
    size: NDArray[np.float32]  # (m,) distance of the keypoints from their centre, RMS
    time: NDArray[np.float64]  # (m,) seconds


class Tracker:
    """Identities of the objects of one topic, each kept while the object is seen.

    An identity that the detector gives is kept. Other objects are matched by place, the nearest
    first: an object is one that was seen within the last second if the keypoints that both
    show have moved, on average, by less than 1.5 times its size (their distance from their centre,
    RMS).
    """

    def __init__(self, topic: str = "", memory: float = MAX_AGE) -> None:
        """Forget objects that were not seen for `memory` seconds.

        topic: tells this topic from others: the identity of an object that comes alone and without
        one; that of any other is "topic/identity". "" if there are no others.
        """
        self._topic, self._memory = topic, memory
        self._tracks: _Tracks | None = None
        self._count = 0

    def __call__(self, seen: Observation, now: float) -> tuple[str, ...]:
        """Return the identities of the n objects seen at `now`, in seconds of any clock.

        They differ from one another. An object without keypoints, and without an identity of the
        detector, has none: "".
        """
        if not self._topic:
            return self._match(seen, now)
        if len(seen.confidence) == 1 and not any(seen.identities):
            return (self._topic,)
        return tuple(
            identity and f"{self._topic}/{identity}" for identity in self._match(seen, now)
        )

    def _match(self, seen: Observation, now: float) -> tuple[str, ...]:
        """Return the identities, the topic's aside."""
        identities = self._given(seen)
        nameless = [
            i for i, identity in enumerate(identities) if not identity and seen.confidence[i].any()
        ]
        if not nameless:
            return tuple(identities)
        new = _tracks(seen, nameless, now)
        old = self._tracks
        # Another model has other keypoints: there is nothing to compare.
        if old is not None and old.points.shape[1:] == new.points.shape[1:]:
            old = _part(old, (now >= old.time) & (now - old.time <= self._memory))
            distance = _distance(new, old)
            near = np.argwhere(distance < _FARTHEST)
            taken = np.zeros(len(old.identities), bool)
            for j, k in near[distance[tuple(near.T)].argsort()].tolist():
                if not new.identities[j] and not taken[k]:
                    new.identities[j], taken[k] = old.identities[k], True
            old = _part(old, ~taken)
        else:
            old = None
        for j, i in enumerate(nameless):
            identities[i] = new.identities[j] = new.identities[j] or self._next(identities)
        self._tracks = _joined(old, new) if old and old.identities else new
        return tuple(identities)

    def _given(self, seen: Observation) -> list[str]:
        """Return the detector's identities, "" for none and for the second of two equal ones."""
        identities = [identity or "" for identity in seen.identities] or [""] * len(seen.confidence)
        return [
            identity if identity not in identities[:i] else ""
            for i, identity in enumerate(identities)
        ]

    def _next(self, used: list[str]) -> str:
        """Return an identity that no object has had."""
        self._count += 1
        identity = f"{_NAME}{self._count}"
        return self._next(used) if identity in used else identity


def _tracks(seen: Observation, which: list[int], now: float) -> _Tracks:
    """Return some of the objects, each with a keypoint at least, without identities."""
    points, visible = seen.points[which], (seen.confidence[which] > 0).astype(np.float32)
    weight = visible[..., None] / visible.sum(1)[:, None, None]
    spread = points - (points * weight).sum(1, keepdims=True)
    size = np.sqrt((spread * spread * weight).sum((1, 2)))
    return _Tracks([""] * len(which), points, visible, size, np.full(len(which), now))


def _part(tracks: _Tracks, which: NDArray[np.bool_]) -> _Tracks:
    """Return some of the tracks."""
    identities = [
        identity
        for identity, chosen in zip(tracks.identities, which.tolist(), strict=True)
        if chosen
    ]
    _, points, visible, size, time = tracks
    return _Tracks(identities, points[which], visible[which], size[which], time[which])


def _joined(a: _Tracks, b: _Tracks) -> _Tracks:
    """Return the tracks of both."""
    return _Tracks(
        a.identities + b.identities,
        np.concatenate([a.points, b.points]),
        np.concatenate([a.visible, b.visible]),
        np.concatenate([a.size, b.size]),
        np.concatenate([a.time, b.time]),
    )


def _distance(a: _Tracks, b: _Tracks) -> NDArray[np.float32]:
    """Return (m, n) how far apart each two are, in their size; NaN if no keypoint is in both."""
    both = a.visible[:, None] * b.visible[None]
    move = ((a.points[:, None] - b.points[None]) * both[..., None]).sum(2)
    with np.errstate(invalid="ignore", divide="ignore"):
        distance: NDArray[np.float32] = np.hypot(move[..., 0], move[..., 1]) / both.sum(2)
        distance /= np.maximum(np.maximum(a.size[:, None], b.size[None]), np.float32(1e-9))
    return distance
