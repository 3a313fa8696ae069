"""Who is who from one message to the next, where the detector does not say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.observations.observation import Observation

MEMORY = 1.0
"""Seconds after which an object that is not seen is forgotten."""

_FARTHEST = 1.5  # moves from one message to the next, in sizes of the object
_NAME = "object"


@dataclass
class _Track:
    """An object that was seen: points (q, 2), those there (q), size and time of the last time."""

    name: str
    points: NDArray[np.float32]
    visible: NDArray[np.bool_]
    size: float
    time: float


class Tracker:
    """Names for the objects of one topic, each kept while the object is seen.

    What the detector names keeps that name. The others are matched by place, the nearest first: an
    object is one that was seen within the last second if the keypoints that both show have moved,
    on average, by less than 1.5 times its size (their distance from their centre, RMS).
    """

    def __init__(self, topic: str = "", memory: float = MEMORY) -> None:
        """Forget objects that were not seen for `memory` seconds.

        topic: tells this topic from others. An object that comes alone and without a name is called
        that, any other "topic/name"; "" if there are no others.
        """
        self._topic, self._memory = topic, memory
        self._tracks: list[_Track] = []
        self._count = 0

    def __call__(self, seen: Observation, now: float) -> tuple[str, ...]:
        """Return the names of the n objects seen at `now`, in seconds of any clock.

        They differ from one another. An object without keypoints that no one has named has no name:
        "".
        """
        if not self._topic:
            return self._match(seen, now)
        if len(seen.confidence) == 1 and not any(seen.ids):
            return (self._topic,)
        return tuple(name and f"{self._topic}/{name}" for name in self._match(seen, now))

    def _match(self, seen: Observation, now: float) -> tuple[str, ...]:
        """Return the names, the topic's aside."""
        names = self._given(seen)
        nameless = [i for i, name in enumerate(names) if not name and seen.confidence[i].any()]
        if not nameless:
            return tuple(names)
        self._tracks = [t for t in self._tracks if 0 <= now - t.time <= self._memory]
        new = [_track(seen.points[i], seen.confidence[i] > 0, now) for i in nameless]
        pairs = sorted(
            (distance, j, k)
            for j, track in enumerate(new)
            for k, old in enumerate(self._tracks)
            if (distance := _distance(track, old)) < _FARTHEST
        )
        taken = set()
        for _, j, k in pairs:
            if not new[j].name and k not in taken:
                new[j].name = self._tracks[k].name
                taken.add(k)
        for i, track in zip(nameless, new, strict=True):
            names[i] = track.name = track.name or self._next(names)
        kept = [track for k, track in enumerate(self._tracks) if k not in taken]
        self._tracks = kept + new
        return tuple(names)

    def _given(self, seen: Observation) -> list[str]:
        """Return the detector's names, "" where there is none; a second of the same is none."""
        names = [name or "" for name in seen.ids] or [""] * len(seen.confidence)
        return [name if name not in names[:i] else "" for i, name in enumerate(names)]

    def _next(self, used: list[str]) -> str:
        """Return a name that no object has had."""
        self._count += 1
        name = f"{_NAME}{self._count}"
        return self._next(used) if name in used else name


def _track(points: NDArray[np.float32], visible: NDArray[np.bool_], now: float) -> _Track:
    """Return an object without a name."""
    spread = points[visible] - points[visible].mean(0)
    return _Track("", points, visible, float(np.sqrt((spread**2).sum(1).mean())), now)


def _distance(a: _Track, b: _Track) -> float:
    """Return how far apart two are, in their size; infinite if no keypoint is in both."""
    both = a.visible & b.visible
    if not both.any():
        return np.inf
    move = (a.points[both] - b.points[both]).mean(0)
    return float(np.hypot(*move) / max(a.size, b.size, 1e-9))
