# SPDX-License-Identifier: Apache-2.0
"""Lifting of recordings over time: identities, and what is remembered of each."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.large_arrays import empty, release
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.lifting.history import MAX_BACK, MAX_GAP, Context, Memory
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import Identities, Observation
from deep_nrsfm_ros.lifting.steady_depth import steady_depths
from deep_nrsfm_ros.lifting.tracking import Tracker

Floats = NDArray[Any]
LiftFrame = Callable[[Floats, Floats, Context], Lifted]

NONE, CAUSAL, BOTH = "none", "causal", "both"
SMOOTH = (CAUSAL, BOTH, NONE)
"""How a recording is lifted: by the frames so far, by those before and after, or each by itself."""
_MAX_MOTION = 0.25  # of the size of an object from one frame to the next, median
_NEIGHBOUR = 0.25  # s, the longest time between two frames of which the motion counts
_BLOCK = 2048  # frames or objects that are in memory in the model's layout
_BETWEEN = MAX_GAP + MAX_BACK  # s, between two passes: smoothing starts anew


class OverTime(NamedTuple):
    """How the frames of a recording help each other.

    Attributes:
        smooth: one of `SMOOTH`.
        up: (3,) unit vector against gravity in the camera's axes; None: unknown.
    """

    smooth: str = CAUSAL
    up: Floats | None = None


class Stream(NamedTuple):
    """The objects of a recording, frame by frame.

    Attributes:
        points: (m, q, 2) in the detector's layout.
        confidence: (m, q).
        to_model: maps them to the model's layout.
        starts: (f + 1,) the first row of each frame with objects, in order of time, and m.
        seconds: (f,) of each of these frames.
        identities: (m,) from frame to frame; "": unknown.
    """

    points: Floats
    confidence: Floats
    to_model: KeypointMap
    starts: NDArray[np.int64]
    seconds: Floats
    identities: list[str]


class _Frame(NamedTuple):
    """A frame of a stream.

    Attributes:
        number: in the stream.
        rows: its objects.
        points: (n, p, 2) in the model's layout.
        confidence: (n, p).
    """

    number: int
    rows: slice
    points: Floats
    confidence: Floats


def _frames(stream: Stream, *, backward: bool = False) -> Iterator[_Frame]:
    """Yield the frames of a stream in order of time, or from the last to the first."""
    blocks = slices(len(stream.seconds), _BLOCK)
    for block in reversed(blocks) if backward else blocks:
        starts = stream.starts[block.start : block.stop + 1].tolist()
        rows = slice(starts[0], starts[-1])
        points, confidence = stream.to_model(stream.points[rows], stream.confidence[rows])
        order = range(block.stop - block.start)
        for i in reversed(order) if backward else order:
            rows, own = (
                slice(*starts[i : i + 2]),
                slice(starts[i] - starts[0], starts[i + 1] - starts[0]),
            )
            yield _Frame(block.start + i, rows, points[own], confidence[own])


def stream_of(detections: Detections, to_model: KeypointMap, tolerances: Floats | None) -> Stream:
    """Return the objects of a recording with identities; those that it lacks are found.

    Args:
        detections: of the recording.
        to_model: maps its keypoints to the model's layout.
        tolerances: (p,) of the model's keypoints, as in `Tracker`.
    """
    first = np.unique(detections.frame, return_index=True)[1]
    stamps = detections.stamps[detections.frame[first]]
    seconds = 1e-9 * (stamps - (stamps[0] if len(stamps) else 0)).astype(np.float64)
    starts = np.append(first, len(detections))
    points, confidence = detections.points, detections.confidence
    stream = Stream(points, confidence, to_model, starts, seconds, [])
    # A source without identities has the index in the frame instead.
    given = detections.has_identities()
    tracker = Tracker()
    period = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    identities: list[str] = []
    texts: dict[str, str] = {}  # one text for all objects of an identity
    for frame in _frames(stream):
        names: Identities = tuple(detections.identities[frame.rows].tolist()) if given else ()
        seen = Observation(frame.points, frame.confidence, tuple(n or None for n in names))
        found = tracker(seen, float(seconds[frame.number]), period, tolerances)
        identities += [texts.setdefault(identity, identity) for identity in found]
    return stream._replace(identities=identities)


def is_in_time(stream: Stream) -> bool:
    """Return whether the frames follow each other as those of a video.

    In unrelated images, objects move by as much as they are large. A stream of which no object is
    in two frames less than 0.25 s apart has nothing to smooth: it counts as in time.
    """
    motions = array("f")
    earlier = _earlier_rows(stream)
    for block in slices(len(earlier), _BLOCK):
        rows = block.start + np.flatnonzero(earlier[block] >= 0)
        keypoints = stream.to_model(stream.points[rows], stream.confidence[rows])
        rows = earlier[rows]
        before = stream.to_model(stream.points[rows], stream.confidence[rows])
        for points, confidence, points_before, confidence_before in zip(
            *keypoints, *before, strict=True
        ):
            both = (confidence > 0) & (confidence_before > 0)
            if both.sum() < 2:
                continue
            a, b = points[both], points_before[both]
            size = np.sqrt(np.square(a - a.mean(0)).sum(1).mean())
            motions.append(np.median(np.linalg.norm(a - b, axis=1)) / max(size, 1e-9))
    return not motions or float(np.median(motions)) <= _MAX_MOTION


def _earlier_rows(stream: Stream) -> NDArray[np.int64]:
    """Return the row (m,) of the same identity before each, less than 0.25 s ago; -1: none."""
    earlier = np.full(len(stream.identities), -1, np.int64)
    last: dict[str, tuple[float, int]] = {}
    is_ascending = bool((np.diff(stream.seconds) >= 0).all())
    for i, second in enumerate(stream.seconds.tolist()):
        for row in range(*stream.starts[i : i + 2].tolist()):
            identity = stream.identities[row]
            before, last[identity] = last.get(identity), (second, row)
            if before is not None and second - before[0] <= _NEIGHBOUR:
                earlier[row] = before[1]
        if is_ascending and i % _BLOCK == 0:  # identities that are gone need no memory
            last = {k: v for k, v in last.items() if second - v[0] <= _NEIGHBOUR}
    return earlier


def lift_stream(
    lift: LiftFrame,
    memory: Memory,
    stream: Stream,
    over_time: OverTime,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Lifted:
    """Return the lifted objects (m,) of a recording; large results are in temporary files.

    `both` is the mean of a pass forward and a pass backward in time, each with the bones that a
    first pass has learned.

    Args:
        lift: of the points, the confidence and the context of a frame.
        memory: empty, of the lifter.
        stream: the recording.
        over_time: how its frames help each other.
        on_progress: called with the number of objects done and their total number.
    """
    passes = 3 if over_time.smooth == BOTH else 1
    m = len(stream.identities)
    end = float(stream.seconds[-1]) + _BETWEEN if len(stream.seconds) else 0.0
    results: list[Lifted] = []
    for number in range(passes):
        backward = number == 1
        whole: Lifted | None = None
        for i, rows, points, confidence in _frames(stream, backward=backward):
            second = float(stream.seconds[i])
            time = 2 * number * end + (end - second if backward else second)
            names = tuple(stream.identities[rows]) if over_time.smooth != NONE else ()
            names = names or ("",) * (rows.stop - rows.start)
            context = memory(names, time, over_time.up)
            part = steady_depths(lift(points, confidence, context), memory, context)
            if whole is None:
                whole = Lifted._make(empty((m, *each.shape[1:]), each.dtype) for each in part)
            # Each frame goes to its place, so that memory holds the objects but once.
            for each, values in zip(whole, part, strict=True):
                each[rows] = values
            if i % _BLOCK == 0:
                release(whole)
            on_progress((number * m + (m - rows.start if backward else rows.stop)) // passes, m)
        assert whole is not None  # a stream has frames
        results = [*results[-1:], whole]  # the first of three passes learns the bones only
    return results[0] if passes == 1 else _mean(*results)


def _mean(a: Lifted, b: Lifted) -> Lifted:
    """Return the mean of two lifts of the same objects."""
    means = Lifted._make(empty(each.shape, each.dtype) for each in a)
    for rows in slices(len(a.shapes), _BLOCK):
        for mean, x, y in zip(means[:-1], a[:-1], b[:-1], strict=True):
            mean[rows] = (x[rows] + y[rows]) / np.float32(2)
        means.wrong[rows] = a.wrong[rows] | b.wrong[rows]
        rotations = means.rotations[rows]
        lifted = np.isfinite(rotations).all((1, 2))
        U, _, Vt = np.linalg.svd(rotations[lifted].astype(np.float64))
        U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
        rotations[lifted] = U @ Vt
        release((*means, *a, *b))
    return means
