# SPDX-License-Identifier: Apache-2.0
"""Outliers: keypoints that contradict the others of their frame, e.g. swapped left and right.

A Gaussian over whole frames (all 2 p coordinates) is fitted robustly to the data. Each keypoint is
compared with its prediction from the other visible keypoints of its frame. No order in time, labels
or trained model are needed.

This is the low rank of NRSfM in a soft form. With K basis shapes the frames lie near 3 K
dimensions. For a person and p = 17 that is not far from 2 p, so that a hard limit of the rank
leaves no residual; the spectrum of the covariance does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import Progress, no_progress, slices
from deep_nrsfm_ros.large_arrays import empty
from deep_nrsfm_ros.nrsfm.geometry import finite_median

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_SAMPLE = 4000  # frames to which the Gaussian is fitted
_ROUNDS = 3  # fits, each without the outliers of the one before
_STEPS = 5  # steps of expectation-maximisation in a fit
_MIN_DEVIATION = 0.02  # least standard deviation of a coordinate, in sizes of the object
_MIN_TYPICAL = 0.5  # least typical distance of a point: no outliers within 6 % of the size
_POSITION_VARIANCE = 100.0  # of a whole frame: the median that centres it is only an estimate
_MISSING_VARIANCE = 1e6  # of a missing coordinate
_RAYLEIGH_MEDIAN = 1.1774  # median length of a standard normal vector in the plane
_MIN_POINTS = 4  # points of a frame that are never outliers


def median_normalised(points: NDArray[np.float32], visible: Bools) -> Floats:
    """Return points centred by their median and scaled by their median radius.

    A few outliers have little influence on medians.

    Args:
        points: (f, p, 2), in any unit.
        visible: (f, p).

    Returns:
        (f, p, 2), 0 where missing.
    """
    X = np.where(visible[..., None], points.astype(np.float64), np.nan)
    X -= np.nan_to_num(finite_median(X.swapaxes(1, 2)))[:, None]
    radius = np.nan_to_num(finite_median(np.sqrt((X**2).sum(2))))
    scaled: Floats = np.nan_to_num(X / np.maximum(radius, 1e-9)[:, None, None])
    return scaled


@dataclass(frozen=True)
class PointModel:
    """Predicts each point of a frame from the others: a Gaussian over normalised frames.

    Attributes:
        mean: (p, 2).
        covariance: (2 p, 2 p).
        typical: (p,) typical Mahalanobis distance of each point, from its median; 1 for a Gaussian.
            It is larger for a point that moves freely, such as a hand.
    """

    mean: Floats
    covariance: Floats
    typical: Floats

    @classmethod
    def fit(cls, points: NDArray[np.float32], visible: Bools, threshold: float) -> PointModel:
        """Return the model of some frames; deterministic.

        After each fit, points beyond the threshold are left out of the next one. Missing points
        are filled in by expectation-maximisation.

        Args:
            points: (f, p, 2), in any unit; of more than 4000 frames a sample is taken.
            visible: (f, p).
            threshold: in typical distances, 6 typical.
        """
        if len(points) > _SAMPLE:
            chosen = np.random.default_rng(0).choice(len(points), _SAMPLE, replace=False)
            points, visible = points[chosen], visible[chosen]
        X = median_normalised(points, visible)
        p = X.shape[1]
        mean = np.zeros((p, 2))
        for j in np.flatnonzero(visible.any(0)):
            mean[j] = np.median(X[visible[:, j], j], axis=0)
        model = cls(mean, np.eye(2 * p), np.ones(p))
        trusted = visible
        for _ in range(_ROUNDS):
            for _ in range(_STEPS):
                model = model._step(X, trusted)
            distances = model._distances(X, visible)
            typical = np.ones(p)
            for j in np.flatnonzero(visible.any(0)):
                typical[j] = np.median(distances[visible[:, j], j]) / _RAYLEIGH_MEDIAN
            model = cls(model.mean, model.covariance, np.maximum(typical, _MIN_TYPICAL))
            trusted = visible & (distances < threshold * model.typical)
            too_few = trusted.sum(1) < _MIN_POINTS
            trusted[too_few] = visible[too_few]
        return model

    def deviations(self, X: Floats, visible: Bools) -> Floats:
        """Return the distance between each point and its prediction from the others of its frame.

        Args:
            X: (f, p, 2) from `median_normalised`.
            visible: (f, p).

        Returns:
            (f, p) Mahalanobis distances in typical distances of the point: 1 typical, 6 an outlier,
            0 for missing points.
        """
        relative: Floats = self._distances(X, visible) / self.typical
        return relative

    def _step(self, X: Floats, visible: Bools) -> PointModel:
        """Return the model after one step of expectation-maximisation."""
        f, p = visible.shape
        C = self.covariance
        used, filled = np.zeros_like(C), np.empty((f, 2 * p))
        for frames, precision in self._precisions(visible):
            x = ((X[frames] - self.mean) * visible[frames][..., None]).reshape(-1, 2 * p)
            filled[frames] = x @ precision @ C
            used += len(frames) / f * precision
        shift = filled.mean(0)
        spread = (filled - shift).T @ (filled - shift) / f
        covariance = spread + C - C @ used @ C + _MIN_DEVIATION**2 * np.eye(2 * p)
        mean = self.mean + shift.reshape(p, 2)
        return PointModel(mean, (covariance + covariance.T) / 2, self.typical)

    def _distances(self, X: Floats, visible: Bools) -> Floats:
        """Return the Mahalanobis distance (f, p) of each point given the others of its frame.

        With the precision L of the visible coordinates, d = x - mean and y = L d, the residual of
        point i is r_i = L_ii^-1 y_i, and r_i^T L_ii r_i = y_i^T L_ii^-1 y_i.
        """
        f, p = visible.shape
        distances = np.zeros((f, p))
        own = np.arange(p)
        for frames, precision in self._precisions(visible):
            d = ((X[frames] - self.mean) * visible[frames][..., None]).reshape(-1, 2 * p)
            y = (d @ precision).reshape(-1, p, 2)
            variances = np.linalg.inv(precision.reshape(p, 2, p, 2)[own, :, own])  # (p, 2, 2)
            squares = np.einsum("fpi,pij,fpj->fp", y, variances, y)
            distances[frames] = np.sqrt(np.maximum(squares, 0))
        return np.where(visible, distances, 0.0)

    def _precisions(self, visible: Bools) -> Iterator[tuple[NDArray[np.intp], Floats]]:
        """Yield (frames, precision (2 p, 2 p)) for each pattern of visible points.

        Missing coordinates, and the position of the frame, have a very large variance. So they
        have no influence.
        """
        p = visible.shape[1]
        covariance = self.covariance + np.kron(np.ones((p, p)), np.eye(2)) * _POSITION_VARIANCE
        for members in _alike(visible):
            missing = np.repeat(~visible[members[0]], 2)
            yield members, np.linalg.inv(covariance + np.diag(_MISSING_VARIANCE * missing))


def _alike(visible: Bools) -> list[NDArray[np.intp]]:
    """Return the indices of the frames of each pattern of visible points, ascending.

    Patterns are compared as whole numbers of 64 bits: sorting rows of booleans takes most of the
    time of a comparison otherwise.
    """
    packed = np.packbits(visible, 1)
    words = np.zeros((len(packed), -(-packed.shape[1] // 8) * 8), np.uint8)
    words[:, : packed.shape[1]] = packed
    keys = words.view(np.uint64)
    order = np.lexsort(keys.T)
    changes = (keys[order[1:]] != keys[order[:-1]]).any(1)
    return np.split(order, np.flatnonzero(changes) + 1)


def find_outliers(
    points: NDArray[np.float32],
    visible: Bools,
    threshold: float,
    on_progress: Progress = no_progress,
) -> tuple[Bools, Floats]:
    """Return the outliers among the visible points, and the deviation of the worst.

    The worst point of a frame is removed and the others are compared again without it, until none
    is beyond the threshold or 4 points are left.

    Args:
        points: (f, p, 2), in any unit.
        visible: (f, p).
        threshold: Mahalanobis distance in typical distances of a point, 6 typical.
        on_progress: called with the frames done and f.

    Returns:
        Outliers (f, p) bool, and the largest deviation (f,) of each frame; see
        `PointModel.deviations`.
    """
    model = PointModel.fit(points, visible, threshold)
    outliers, worst = empty(visible.shape, bool), np.zeros(len(points))
    for part in slices(len(points)):
        outliers[part], worst[part] = _find_outliers(model, points[part], visible[part], threshold)
        on_progress(part.stop, len(points))
    return outliers, worst


def _find_outliers(
    model: PointModel, points: NDArray[np.float32], visible: Bools, threshold: float
) -> tuple[Bools, Floats]:
    """Return `find_outliers` of some frames."""
    X = median_normalised(points, visible)
    kept, worst = visible.copy(), np.zeros(len(X))
    active = np.arange(len(X))  # frames that may have another outlier
    while len(active):
        deviations = model.deviations(X[active], kept[active])
        largest = deviations.max(1)
        worst[active] = np.maximum(worst[active], largest)
        more = (largest > threshold) & (kept[active].sum(1) > _MIN_POINTS)
        active = active[more]
        kept[active, deviations[more].argmax(1)] = False
    return visible & ~kept, worst
