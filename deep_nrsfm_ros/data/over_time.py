"""Lifting of recordings over time: identities, and what is remembered of each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.lifting.history import MAX_BACK, MAX_GAP, Context, Memory
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.observation import Identities, Observation
from deep_nrsfm_ros.lifting.tracking import Tracker

Floats = NDArray[Any]
LiftFrame = Callable[[Floats, Floats, Context], Lifted]

NONE, CAUSAL, BOTH = "none", "causal", "both"
SMOOTH = (CAUSAL, BOTH, NONE)
"""How a recording is lifted: by the frames so far, by those before and after, or each by itself."""
_MAX_MOTION = 0.25  # of the size of an object from one frame to the next, median
_NEIGHBOUR = 0.25  # s, the longest time between two frames of which the motion counts
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
        points: (m, p, 2) in the model's layout.
        confidence: (m, p).
        frames: of each frame with objects its rows, in order of time.
        seconds: of each of these frames.
        identities: (m,) from frame to frame; "": unknown.
    """

    points: Floats
    confidence: Floats
    frames: list[slice]
    seconds: Floats
    identities: list[str]


def stream_of(
    detections: Detections, points: Floats, confidence: Floats, tolerances: Floats | None
) -> Stream:
    """Return the objects of a recording with identities; those that it lacks are found.

    Args:
        detections: of the recording.
        points: (m, p, 2) its keypoints in the model's layout.
        confidence: (m, p) of the keypoints.
        tolerances: (p,) of the keypoints, as in `Tracker`.
    """
    first, count = np.unique(detections.frame, return_index=True, return_counts=True)[1:]
    frames = [slice(a, a + n) for a, n in zip(first.tolist(), count.tolist(), strict=True)]
    stamps = detections.stamps[detections.frame[first]]
    seconds = 1e-9 * (stamps - (stamps[0] if len(stamps) else 0)).astype(np.float64)
    index = np.concatenate([np.arange(n) for n in count] or [np.zeros(0, int)])
    # A source without identities has the index in the frame instead.
    given = bool((detections.identities != index.astype(str)).any())
    tracker = Tracker()
    period = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    identities: list[str] = []
    for rows, second in zip(frames, seconds.tolist(), strict=True):
        names: Identities = tuple(detections.identities[rows].tolist()) if given else ()
        seen = Observation(points[rows], confidence[rows], tuple(n or None for n in names))
        identities += tracker(seen, second, period, tolerances)
    return Stream(points, confidence, frames, seconds, identities)


def is_in_time(stream: Stream) -> bool:
    """Return whether the frames follow each other as those of a video.

    In unrelated images, objects move by as much as they are large. A stream of which no object is
    in two frames less than 0.25 s apart has nothing to smooth: it counts as in time.
    """
    last: dict[str, tuple[float, int]] = {}
    motions = []
    for rows, second in zip(stream.frames, stream.seconds.tolist(), strict=True):
        for row in range(rows.start, rows.stop):
            before, last[stream.identities[row]] = (
                last.get(stream.identities[row]),
                (second, row),
            )
            if before is None or second - before[0] > _NEIGHBOUR:
                continue
            both = (stream.confidence[row] > 0) & (stream.confidence[before[1]] > 0)
            if both.sum() < 2:
                continue
            a, b = stream.points[row, both], stream.points[before[1], both]
            size = np.sqrt(np.square(a - a.mean(0)).sum(1).mean())
            motions.append(np.median(np.linalg.norm(a - b, axis=1)) / max(size, 1e-9))
    return not motions or float(np.median(motions)) <= _MAX_MOTION


def lift_stream(
    lift: LiftFrame,
    memory: Memory,
    stream: Stream,
    over_time: OverTime,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Lifted:
    """Return the lifted objects (m,) of a recording.

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
        order = range(len(stream.frames))
        whole: Lifted | None = None
        for i in reversed(order) if backward else order:
            rows, second = stream.frames[i], float(stream.seconds[i])
            time = 2 * number * end + (end - second if backward else second)
            names = tuple(stream.identities[rows]) if over_time.smooth != NONE else ()
            names = names or ("",) * (rows.stop - rows.start)
            context = memory(names, time, over_time.up)
            part = lift(stream.points[rows], stream.confidence[rows], context)
            if whole is None:
                whole = Lifted(*(np.empty((m, *each.shape[1:]), each.dtype) for each in part))
            # Each frame goes to its place, so that memory holds the objects but once.
            for array, values in zip(whole, part, strict=True):
                array[rows] = values
            on_progress((number * m + (m - rows.start if backward else rows.stop)) // passes, m)
        assert whole is not None  # a stream has frames
        results = [*results[-1:], whole]  # the first of three passes learns the bones only
    return results[0] if passes == 1 else _mean(*results)


def _mean(a: Lifted, b: Lifted) -> Lifted:
    """Return the mean of two lifts of the same objects."""
    means = Lifted(*((x + y) / np.float32(2) for x, y in zip(a, b, strict=True)))
    lifted = np.isfinite(means.rotations).all((1, 2))
    U, _, Vt = np.linalg.svd(means.rotations[lifted].astype(np.float64))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    rotations = means.rotations.copy()
    rotations[lifted] = U @ Vt
    return means._replace(rotations=rotations)
