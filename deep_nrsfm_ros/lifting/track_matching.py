# SPDX-License-Identifier: Apache-2.0
"""How well each detected object matches each track, and tracks after their detections.

A track predicts its keypoints at constant velocity that decays. The keypoint similarity (OKS) is a
mean over keypoints of a bell curve of their distances, so that a few wrong keypoints, which people
who cross exchange, do not decide. `match` and `update` compute this in NumPy; the kernel
(tracking.c) computes the same.

Source: COCO, "Keypoint Evaluation": the similarity and its constants.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.layouts.layout import KeypointLayout

MAX_MOTION = 1.5
"""Largest mean distance from the prediction, in sizes of the object."""
MOTION_GROWTH = 1.5
"""Growth of `MAX_MOTION`, in sizes per second without a detection."""
DECAY = 0.4
"""Time constant in seconds with which the predicted velocity falls to 0."""
VELOCITY_GAIN = 0.3
"""Share of an error of the prediction that corrects the velocity."""
SIZE_DECAY = 1.0
"""Time constant in seconds with which a track forgets that it was larger."""

_UNCERTAINTY = 1.0  # growth of a predicted keypoint's standard deviation, in sizes per second
_SHRINKAGE = 1.0  # added to the number of common keypoints, so that few keypoints score lower
_NEARNESS = 0.1  # weight of the mean motion, which decides where all keypoints are far away
_REACH = 2.0  # sizes by which the centre moves where keypoints are hidden
_CONSTANTS = np.array(
    [
        *(MAX_MOTION, MOTION_GROWTH, DECAY, VELOCITY_GAIN, SIZE_DECAY),
        *(_UNCERTAINTY, _SHRINKAGE, _NEARNESS, _REACH),
    ],
    np.float32,
)

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

Complex = NDArray[Any]
"""Array of complex64; a keypoint x, y in pixels is the number x + iy."""
Floats = NDArray[Any]
"""Array of float32."""


class Tracks(NamedTuple):
    """The state of m tracks, in arrays, so that all are compared at once.

    Attributes:
        points: (m, q) complex64, last position in pixels; hidden keypoints move with the visible
            ones.
        age: (m, q) float32, seconds from the last detection of a keypoint to `time`; inf: never
            detected.
        velocity: (m,) complex64, pixels per second.
        size: (m,) float32, RMS distance of the keypoints from their centre, pixels.
        time: (m,) float64, of the last detection, seconds.
    """

    points: Complex
    age: Floats
    velocity: Complex
    size: Floats
    time: NDArray[Any]


class Matches(NamedTuple):
    """All pairs of n detections and m tracks.

    Attributes:
        score: (n, m) float32, 0 where a pair does not match; the largest sum is the best
            assignment.
        shift: (n, m) complex64, pixels from the prediction to the detection, wrong keypoints left
            out.
        best: (n,) int32, the track of each detection's highest score above 0; -1: none.
    """

    score: Floats
    shift: Complex
    best: NDArray[np.int32]


class _Detections(NamedTuple):
    """The n objects of a message."""

    points: Complex  # (n, q), 0 where missing
    visible: Floats  # (n, q) 1 or 0
    centre: Complex  # (n,) mean of the visible keypoints
    size: Floats  # (n,) RMS distance of the visible keypoints from the centre, pixels


def keypoint_tolerances(layout: KeypointLayout) -> Floats:
    """Return for each keypoint the standard deviation (p,) of its similarity, in object sizes.

    Keypoints that COCO names have COCO's, any side of the body; others have 0.2.
    """
    parts = (name.removeprefix("left_").removeprefix("right_") for name in layout.keypoints)
    sigmas = [_SIZES * _COCO_SIGMAS[part] if part in _COCO_SIGMAS else _SIGMA for part in parts]
    return np.maximum(np.array(sigmas, np.float32), np.float32(_MIN_SIGMA))


def to_complex(points: NDArray[np.float32]) -> Complex:
    """Return points (n, q, 2) as complex numbers (n, q)."""
    z: Complex = np.ascontiguousarray(points, np.float32).view(np.complex64)[..., 0]
    return z


def new_tracks(points: NDArray[np.float32], confidence: Floats, now: float) -> Tracks:
    """Return tracks that begin with detections, at rest.

    Args:
        points: (n, q, 2) in pixels; each object has a visible keypoint.
        confidence: (n, q), 0 where missing.
        now: time of the detections, seconds.
    """
    detections = _detections(points, confidence)
    return Tracks(
        detections.points * detections.visible,
        np.where(detections.visible > 0, np.float32(0), np.float32(np.inf)),
        np.zeros(len(points), np.complex64),
        detections.size,
        np.full(len(points), now),
    )


def match(
    tracks: Tracks,
    passed: Floats,
    points: NDArray[np.float32],
    confidence: Floats,
    tolerances: Floats | None = None,
) -> Matches:
    """Return how well each of n detections matches each of m tracks.

    Args:
        tracks: m tracks.
        passed: (m,) seconds since their last detection.
        points: (n, q, 2) float32 in pixels; each object has a visible keypoint.
        confidence: (n, q) float32, 0 where missing.
        tolerances: (q,) of `keypoint_tolerances`; None: all 0.2.
    """
    if tolerances is None:
        tolerances = np.full(points.shape[1], _SIGMA, np.float32)
    if not kernel.AVAILABLE:
        return match_by_numpy(tracks, passed, points, confidence, tolerances)
    n, m = len(points), len(passed)
    score, shift = np.empty((n, m), np.float32), np.empty((n, m), np.complex64)
    best = np.empty(n, np.int32)
    kernel._kernel.match_tracks(
        *_kernel_arguments(tracks, passed, points, confidence),
        tolerances,
        score,
        shift.view(np.float32),
        best,
    )
    return Matches(score, shift, best)


def match_by_numpy(
    tracks: Tracks,
    passed: Floats,
    points: NDArray[np.float32],
    confidence: Floats,
    tolerances: Floats,
) -> Matches:
    """Return what `match` returns, computed in NumPy."""
    detections = _detections(points, confidence)
    predicted = _predicted(tracks, passed)
    known = (predicted.age < np.inf).astype(np.float32)
    limit = np.float32(MAX_MOTION) + np.float32(MOTION_GROWTH) * passed
    distance = _centre_distance(detections, predicted, known)
    near = distance < limit + np.float32(_REACH)
    if near.size == 1:
        near[:] = True
    rows, columns = np.nonzero(near)
    size = np.maximum(detections.size[rows], predicted.size[columns])
    both = detections.visible[rows] * known[columns]
    common = both.sum(1)
    gap = (detections.points[rows] - predicted.points[columns]) * both
    spread = np.hypot(tolerances, np.float32(_UNCERTAINTY) * predicted.age)[columns]
    scaled = np.abs(gap) / (size[:, None] * spread)
    similarity = np.exp(np.float32(-0.5) * scaled * scaled) * both
    # Where a hidden keypoint may be anywhere, a detection nearby proves less.
    oks = (similarity * (tolerances / spread)).sum(1) / (common + np.float32(_SHRINKAGE))
    weight = similarity + np.float32(1e-6) * both
    some = np.maximum(common, np.float32(1))
    motion = np.abs(gap.sum(1)) / (some * size * limit[columns])
    # No common keypoint: the upper half of a person, and then the lower one.
    by_centre = 1 - distance[rows, columns] / (limit[columns] + np.float32(_REACH))
    by_centre = np.float32(_NEARNESS) * by_centre * by_centre
    by_points = oks + np.float32(_NEARNESS) * (1 - motion)
    score, shift = np.zeros(near.shape, np.float32), np.zeros(near.shape, np.complex64)
    scored = np.where(common > 0, by_points, by_centre)
    score[rows, columns] = np.where(motion < 1, scored, np.float32(0))
    shifted = (gap * weight).sum(1) / np.maximum(weight.sum(1), np.float32(1e-9))
    shift[rows, columns] = shifted
    best = np.where(score.max(1) > 0, score.argmax(1), -1).astype(np.int32)
    return Matches(score, shift, best)


def update(
    tracks: Tracks,
    passed: Floats,
    points: NDArray[np.float32],
    confidence: Floats,
    assigned: NDArray[np.int32],
    shift: Complex,
) -> Tracks:
    """Return the tracks after their assigned detections; the others as they were.

    The time of the tracks is left to the caller.

    Args:
        tracks: m tracks.
        passed: as in `match`.
        points: as in `match`.
        confidence: as in `match`.
        assigned: (n,) int32, track of each detection, at most one each; -1: none.
        shift: (n, m) of `Matches`.
    """
    if not kernel.AVAILABLE:
        return update_by_numpy(tracks, passed, points, confidence, assigned, shift)
    updated = Tracks(*(part.copy() for part in tracks))
    kernel._kernel.update_tracks(
        *_kernel_arguments(updated, passed, points, confidence),
        assigned,
        shift.view(np.float32),
    )
    return updated


def update_by_numpy(
    tracks: Tracks,
    passed: Floats,
    points: NDArray[np.float32],
    confidence: Floats,
    assigned: NDArray[np.int32],
    shift: Complex,
) -> Tracks:
    """Return what `update` returns, computed in NumPy."""
    detections = _detections(points, confidence)
    predicted = _predicted(tracks, passed)
    rows = np.flatnonzero(assigned >= 0)
    columns = assigned[rows]
    moved = shift[rows, columns]
    updated = Tracks(*(part.copy() for part in tracks))
    visible = detections.visible[rows] > 0
    updated.points[columns] = np.where(
        visible, detections.points[rows], predicted.points[columns] + moved[:, None]
    )
    updated.age[columns] = np.where(visible, np.float32(0), predicted.age[columns])
    gain = np.float32(VELOCITY_GAIN) / np.maximum(passed[columns], np.float32(1e-3))
    updated.velocity[columns] = predicted.velocity[columns] + moved * gain
    updated.size[columns] = np.maximum(detections.size[rows], predicted.size[columns])
    return updated


def _kernel_arguments(
    tracks: Tracks, passed: Floats, points: NDArray[np.float32], confidence: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats, Floats]:
    """Return what both entry points of the kernel take; complex numbers are pairs of float32."""
    return (
        _CONSTANTS,
        np.ascontiguousarray(points),
        np.ascontiguousarray(confidence),
        passed,
        tracks.points.view(np.float32),
        tracks.age,
        tracks.velocity.view(np.float32),
        tracks.size,
    )


def _detections(points: NDArray[np.float32], confidence: Floats) -> _Detections:
    """Return objects with points (n, q, 2), each with a visible keypoint."""
    z = to_complex(points)
    mask = (confidence > 0).astype(np.float32)
    weight = mask / mask.sum(1, keepdims=True)
    centre = (z * weight).sum(1)
    distance = np.abs(z - centre[:, None])
    size = np.sqrt((distance * distance * weight).sum(1))
    return _Detections(z, mask, centre, np.maximum(size, np.float32(1e-9)))


def _predicted(tracks: Tracks, passed: Floats) -> Tracks:
    """Return the tracks (m,) some seconds later."""
    decay = np.exp(passed * np.float32(-1 / DECAY))
    return tracks._replace(
        points=tracks.points + (tracks.velocity * (np.float32(DECAY) * (1 - decay)))[:, None],
        age=tracks.age + passed[:, None],
        velocity=tracks.velocity * decay,
        size=tracks.size * np.exp(passed * np.float32(-1 / SIZE_DECAY)),
    )


def _centre_distance(detections: _Detections, predicted: Tracks, known: Floats) -> Floats:
    """Return the distance of the centres (n, m) in object sizes."""
    centre = (predicted.points * known).sum(1) / known.sum(1)
    size = np.maximum(detections.size[:, None], predicted.size)
    distance: Floats = np.abs(detections.centre[:, None] - centre) / size
    return distance
