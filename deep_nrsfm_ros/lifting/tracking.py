"""Identities of objects from one message to the next, where the detector gives none.

Each track predicts where its keypoints are, at constant velocity that decays. Detections are
assigned to tracks so that the sum of their keypoint similarities is largest. The keypoint
similarity (OKS) is a mean over keypoints of a bell curve of their distances, so that a few wrong
keypoints, which people who cross exchange, do not decide.

Source: COCO, "Keypoint Evaluation": the similarity and its constants.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import lap
import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import Observation

MAX_TRACK_AGE = 1.0
"""Seconds after which a track without a detection is deleted, in a stream of at least 3 Hz."""
INTERVALS = 3.0
"""Intervals between messages for which a track lives at least."""

_MAX_MOTION = 1.5  # mean distance from the prediction, in sizes of the object
_MOTION_GROWTH = 1.5  # of it, in sizes per second without a detection
_UNCERTAINTY = 1.0  # growth of a predicted keypoint's standard deviation, in sizes per second
_DECAY = 0.4  # s, time constant with which the predicted velocity falls to 0
_VELOCITY_GAIN = 0.3  # share of an error of the prediction that corrects the velocity
_SIZE_DECAY = 1.0  # s, with which a track forgets that it was larger
_SHRINKAGE = 1.0  # added to the number of common keypoints, so that few keypoints score lower
_NEARNESS = 0.1  # weight of the mean motion, which decides where all keypoints are far away
_REACH = np.float32(2)  # sizes by which the centre moves where keypoints are hidden
_MAX_LOST = 256  # tracks without a detection that are kept, the latest ones
_PREFIX = "object"  # of the identities that the tracker gives: object1, object2, ...

# COCO's standard deviations, doubled as in its similarity and in units of the size used here:
# the root of a standing person's area is about 1.6 times the RMS distance from the centre.
_SIZES = 2 * 1.6
_COCO_SIGMAS = {
    "nose": 0.026,
    "eye": 0.025,
    "ear": 0.035,
    "shoulder": 0.079,
    "elbow": 0.072,
    "wrist": 0.062,
    "hip": 0.107,
    "knee": 0.087,
    "ankle": 0.089,
}
_SIGMA = 0.2  # sizes, of a keypoint of any other name
_MIN_SIGMA = 0.1  # sizes: an object moves between two messages also where annotators agree

_Complex = NDArray[Any]  # complex64
_Floats = NDArray[Any]  # float32


class _Detections(NamedTuple):
    """The n objects of a message; a keypoint x, y is the complex number x + iy in pixels."""

    points: _Complex  # (n, q), 0 where missing
    visible: _Floats  # (n, q) 1 or 0
    centre: _Complex  # (n,) mean of the visible keypoints
    size: _Floats  # (n,) RMS distance of the visible keypoints from the centre, pixels


class _Tracks(NamedTuple):
    """The state of m objects, in arrays, so that all are compared at once."""

    points: _Complex  # (m, q) last position; hidden keypoints move with the visible ones
    age: _Floats  # (m, q) seconds from the last sight of a keypoint to `time`; inf: never seen
    velocity: _Complex  # (m,) pixels per second
    size: _Floats  # (m,) pixels
    time: NDArray[Any]  # (m,) float64, of the last detection, seconds


class _SingleTrack(NamedTuple):
    """The state of the only track; one object is faster without arrays."""

    points: _Complex  # (q,)
    visible: bytes  # of the booleans (q,)
    centre: complex  # of the visible keypoints
    velocity: complex
    size: float
    time: float


class _Pairs(NamedTuple):
    """The k pairs of a detection and a track that may be the same object."""

    rows: NDArray[Any]  # (k,) of the detections
    columns: NDArray[Any]  # (k,) of the tracks
    score: _Floats  # (k,) 0 where a pair does not match
    shift: _Complex  # (k,) from the prediction to the detection, wrong keypoints left out


_FIRST: NDArray[Any] = np.zeros(1, np.intp)


def keypoint_tolerances(layout: KeypointLayout) -> _Floats:
    """Return for each keypoint the standard deviation (p,) of its similarity, in object sizes.

    Keypoints that COCO names have COCO's, any side of the body; others have 0.2.
    """
    parts = (name.removeprefix("left_").removeprefix("right_") for name in layout.keypoints)
    sigmas = [_SIZES * _COCO_SIGMAS[part] if part in _COCO_SIGMAS else _SIGMA for part in parts]
    return np.maximum(np.array(sigmas, np.float32), np.float32(_MIN_SIGMA))


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
        self._tracks: _Tracks | None = None
        self._single: _SingleTrack | None = None  # instead of `_tracks`, which is older
        self._now = -np.inf
        self._count = 0

    def __call__(
        self,
        detections: Observation,
        now: float,
        period: float = 0.0,
        tolerances: _Floats | None = None,
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
        points = _to_complex(observation.points)[0].copy()
        visible = points[mask]
        centre = complex(visible.sum()) / len(visible)
        offset = visible - np.complex64(centre)
        decay = math.exp(-passed / _DECAY)
        size = math.sqrt(np.vdot(offset, offset).real / len(visible))
        size = max(size, single.size * math.exp(-passed / _SIZE_DECAY), 1e-9)
        shift = centre - single.centre - single.velocity * (_DECAY * (1 - decay))
        if abs(shift) >= (_MAX_MOTION + _MOTION_GROWTH * passed) * size:
            return False
        velocity = single.velocity * decay + shift * (_VELOCITY_GAIN / max(passed, 1e-3))
        self._single = _SingleTrack(points, single.visible, centre, velocity, size, now)
        return True

    def _to_arrays(self) -> None:
        """Write the only track to the arrays."""
        if single := self._single:
            visible = np.frombuffer(single.visible, bool)
            self._tracks = _Tracks(
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
        self, observation: Observation, now: float, memory: float, tolerances: _Floats | None
    ) -> list[str]:
        """Return the identities without the topic."""
        identities, visible = _unique(observation), observation.confidence > 0
        rows = [i for i in np.flatnonzero(visible.any(1)).tolist() if not identities[i]]
        if not rows:
            return identities
        points = observation.points
        if len(rows) < len(identities):
            points, visible = points[rows], visible[rows]
        detections = _detections(points, visible)
        # After a change of the model the keypoints are others and cannot be compared.
        if self._tracks and self._tracks.points.shape[1] == points.shape[1]:
            assigned = self._continue(self._tracks, detections, now, memory, tolerances)
        else:
            self._identities, self._tracks, assigned = [], None, [""] * len(rows)
        new = [j for j, identity in enumerate(assigned) if not identity]
        if new:
            used = {*identities, *self._identities}
            # From left to right, so that the order in the message does not matter.
            for j in sorted(new, key=lambda j: complex(detections.centre[j]).real):
                assigned[j] = self._new_identity(used)
            self._append(_new_tracks(detections, new, now), [assigned[j] for j in new])
        for i, identity in zip(rows, assigned, strict=True):
            identities[i] = identity
        return identities

    def _continue(
        self,
        tracks: _Tracks,
        detections: _Detections,
        now: float,
        memory: float,
        tolerances: _Floats | None,
    ) -> list[str]:
        """Update the tracks; return the identity of each detection, "" for a new object."""
        passed = np.maximum(now - tracks.time, 0).astype(np.float32)
        if passed.max() > memory:
            tracks, passed = self._forget(tracks, passed <= memory), passed[passed <= memory]
            if not self._identities:
                return [""] * len(detections.size)
        decay = np.exp(passed * np.float32(-1 / _DECAY))
        predicted = tracks._replace(
            points=tracks.points + (tracks.velocity * (np.float32(_DECAY) * (1 - decay)))[:, None],
            age=tracks.age + passed[:, None],
            velocity=tracks.velocity * decay,
            size=tracks.size * np.exp(passed * np.float32(-1 / _SIZE_DECAY)),
        )
        sigma = np.float32(_SIGMA) if tolerances is None else tolerances
        pairs = _compare(detections, predicted, passed, sigma)
        chosen = _assign(pairs, len(detections.size), len(passed))
        pairs = _Pairs(*(part[chosen] for part in pairs))
        self._tracks = _corrected(tracks, predicted, detections, pairs, passed, now)
        assigned = [""] * len(detections.size)
        for row, column in zip(pairs.rows.tolist(), pairs.columns.tolist(), strict=True):
            assigned[row] = self._identities[column]
        return assigned

    def _forget(self, tracks: _Tracks, kept: NDArray[np.bool_]) -> _Tracks:
        """Return the tracks where `kept` (m,) is true; forget the others' identities."""
        named = zip(self._identities, kept.tolist(), strict=True)
        self._identities = [identity for identity, chosen in named if chosen]
        self._tracks = _Tracks(*(part[kept] for part in tracks))
        return self._tracks

    def _append(self, new: _Tracks, identities: list[str]) -> None:
        """Add tracks; forget the oldest ones above the limit."""
        self._identities = [*self._identities, *identities]
        if self._tracks is None:
            self._tracks = new
            return
        self._tracks = _Tracks(*map(np.concatenate, zip(self._tracks, new, strict=True)))
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


def _to_complex(points: NDArray[np.float32]) -> _Complex:
    """Return points (n, q, 2) as complex numbers (n, q)."""
    z: _Complex = np.ascontiguousarray(points, np.float32).view(np.complex64)[..., 0]
    return z


def _detections(points: NDArray[np.float32], visible: NDArray[np.bool_]) -> _Detections:
    """Return objects with points (n, q, 2), each with a visible keypoint."""
    z = _to_complex(points)
    mask = visible.astype(np.float32)
    weight = mask / mask.sum(1, keepdims=True)
    centre = (z * weight).sum(1)
    distance = np.abs(z - centre[:, None])
    size = np.sqrt((distance * distance * weight).sum(1))
    return _Detections(z, mask, centre, np.maximum(size, np.float32(1e-9)))


def _new_tracks(detections: _Detections, rows: list[int], now: float) -> _Tracks:
    """Return tracks that begin with some of the detections, at rest."""
    visible = detections.visible[rows]
    return _Tracks(
        detections.points[rows] * visible,
        np.where(visible > 0, np.float32(0), np.float32(np.inf)),
        np.zeros(len(rows), np.complex64),
        detections.size[rows],
        np.full(len(rows), now),
    )


def _compare(
    detections: _Detections, predicted: _Tracks, passed: _Floats, sigma: np.float32 | _Floats
) -> _Pairs:
    """Return the pairs of detections and tracks that may match.

    Args:
        detections: n objects.
        predicted: m tracks at the time of the detections.
        passed: (m,) seconds since their last detection.
        sigma: (q,) or one number, standard deviation of a keypoint in object sizes.
    """
    known = (predicted.age < np.inf).astype(np.float32)
    limit = np.float32(_MAX_MOTION) + np.float32(_MOTION_GROWTH) * passed
    n, m = len(detections.size), len(limit)
    if n == m == 1:
        rows, columns = _FIRST, _FIRST
    else:
        rows, columns = np.nonzero(_centre_distance(detections, predicted, known) < limit + _REACH)
    size = np.maximum(detections.size[rows], predicted.size[columns])
    both = detections.visible[rows] * known[columns]
    common = both.sum(1)
    gap = (detections.points[rows] - predicted.points[columns]) * both
    growth = np.float32(_UNCERTAINTY) * predicted.age
    spread = np.sqrt(sigma * sigma + growth * growth)[columns]
    scaled = np.abs(gap) / (size[:, None] * spread)
    similarity = np.exp(np.float32(-0.5) * scaled * scaled) * both
    # Where a hidden keypoint may be anywhere, a detection nearby proves less.
    oks = (similarity * (sigma / spread)).sum(1) / (common + np.float32(_SHRINKAGE))
    weight = similarity + np.float32(1e-6) * both
    some = np.maximum(common, np.float32(1))
    motion = np.abs(gap.sum(1)) / (some * size * limit[columns])
    score = oks + np.float32(_NEARNESS) * (1 - motion)
    if not common.all():  # the upper half of a person, and then the lower one
        distance = _centre_distance(detections, predicted, known)[rows, columns]
        by_centre = np.float32(_NEARNESS) * (1 - distance / (limit[columns] + _REACH)) ** 2
        score = np.where(common > 0, score, by_centre)
    score = np.where(motion < 1, score, np.float32(0))
    return _Pairs(rows, columns, score, (gap * weight).sum(1) / np.maximum(weight.sum(1), 1e-9))


def _centre_distance(detections: _Detections, predicted: _Tracks, known: _Floats) -> _Floats:
    """Return the distance of the centres (n, m) in object sizes."""
    centre = (predicted.points * known).sum(1) / known.sum(1)
    size = np.maximum(detections.size[:, None], predicted.size)
    distance: _Floats = np.abs(detections.centre[:, None] - centre) / size
    return distance


def _assign(pairs: _Pairs, n: int, m: int) -> NDArray[np.intp]:
    """Return the indices of the pairs of the assignment with the largest sum of scores."""
    valid = np.flatnonzero(pairs.score > 0)
    if n == 1 or len(valid) < 2:
        return valid if len(valid) < 2 else valid[[pairs.score[valid].argmax()]]
    index = np.full((n, m), -1)
    index[pairs.rows[valid], pairs.columns[valid]] = valid
    score = np.zeros((n, m))
    score[pairs.rows[valid], pairs.columns[valid]] = pairs.score[valid]
    column = score.argmax(1)
    if len(set(column.tolist())) < n:  # else each detection has its own best track
        column = lap.lapjv(-score, extend_cost=True)[1]
    row = np.flatnonzero(column >= 0)
    chosen: NDArray[np.intp] = index[row, column[row]]
    return chosen[chosen >= 0]


def _corrected(
    tracks: _Tracks,
    predicted: _Tracks,
    detections: _Detections,
    pairs: _Pairs,
    passed: _Floats,
    now: float,
) -> _Tracks:
    """Return the tracks after their assigned detections; the others as they were."""
    rows, columns = pairs.rows, pairs.columns
    updated = _Tracks(*(part.copy() for part in tracks))
    visible = detections.visible[rows] > 0
    moved = predicted.points[columns] + pairs.shift[:, None]
    updated.points[columns] = np.where(visible, detections.points[rows], moved)
    updated.age[columns] = np.where(visible, np.float32(0), predicted.age[columns])
    correction = pairs.shift * (np.float32(_VELOCITY_GAIN) / np.maximum(passed[columns], 1e-3))
    updated.velocity[columns] = predicted.velocity[columns] + correction
    updated.size[columns] = np.maximum(detections.size[rows], predicted.size[columns])
    updated.time[columns] = now
    return updated
