"""Points that disagree with the others of their frame: a detector's swaps and jumps.

No time, no labels, no trained model: a Gaussian over whole frames (all 2 p coordinates) is fitted
robustly to the data, and each point is compared with what the other visible points of its frame
foretell. This is the low rank of NRSfM in a soft form: with K basis shapes the frames lie near 3 K
dimensions, which for p = 17 and a person are not far from 2 p, so that a hard rank leaves no
residual to look at; the spectrum of the covariance still does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.batched import slices

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_SAMPLE = 4000  # frames that the Gaussian is fitted to
_ROUNDS = 3  # of fitting, each without the outliers of the last
_STEPS = 5  # of expectation-maximisation in a round
_FLOOR = 0.02  # deviation that no coordinate falls below, in sizes of the object
_QUIET = 0.5  # least typical deviation of a point: nothing within 6 % of the size stands out
_FREE = 100.0  # variance of where a frame is: the median that centres it is only a guess
_MISSING = 1e6  # variance of a missing coordinate
_RAYLEIGH_MEDIAN = 1.1774  # median length of a standard normal vector in the plane
_LEAST = 4  # points of a frame that are never doubted


def normalised(points: NDArray[np.float32], visible: Bools) -> Floats:
    """Return points (f, p, 2) centred and scaled by medians, which a few outliers do not move.

    Missing points are 0.
    """
    X = np.where(visible[..., None], points.astype(np.float64), np.nan)
    seen = visible.any(1)
    X[seen] -= np.nanmedian(X[seen], axis=1, keepdims=True)
    radius = np.ones(len(X))
    radius[seen] = np.nanmedian(np.linalg.norm(X[seen], axis=2), axis=1)
    scaled: Floats = np.nan_to_num(X / np.maximum(radius, 1e-9)[:, None, None])
    return scaled


@dataclass(frozen=True)
class PointModel:
    """What one point of a frame should be, given the others.

    mean: (p, 2) and covariance: (2 p, 2 p) of normalised frames. typical: (p,) the median
    deviation of each point, so that a restless hand may do what a hip may not.
    """

    mean: Floats
    covariance: Floats
    typical: Floats

    @classmethod
    def fit(cls, points: NDArray[np.float32], visible: Bools, threshold: float) -> PointModel:
        """Fit to frames (f, p, 2), or to some of many; deterministic.

        Points beyond `threshold` are left out and it is fitted again. Missing points are filled by
        expectation-maximisation.
        """
        if len(points) > _SAMPLE:
            chosen = np.random.default_rng(0).choice(len(points), _SAMPLE, replace=False)
            points, visible = points[chosen], visible[chosen]
        X = normalised(points, visible)
        p = X.shape[1]
        mean = np.zeros((p, 2))
        for j in np.flatnonzero(visible.any(0)):
            mean[j] = np.median(X[visible[:, j], j], axis=0)
        model = cls(mean, np.eye(2 * p), np.ones(p))
        trusted = visible
        for _ in range(_ROUNDS):
            for _ in range(_STEPS):
                model = model._step(X, trusted)
            away = model._distances(X, visible)
            typical = np.ones(p)
            for j in np.flatnonzero(visible.any(0)):
                typical[j] = np.median(away[visible[:, j], j]) / _RAYLEIGH_MEDIAN
            model = cls(model.mean, model.covariance, np.maximum(typical, _QUIET))
            trusted = visible & (away < threshold * model.typical)
            doubtful = trusted.sum(1) < _LEAST
            trusted[doubtful] = visible[doubtful]
        return model

    def deviations(self, X: Floats, visible: Bools) -> Floats:
        """Return how far each point (f, p) is from what the others foretell, in typical sizes.

        A Mahalanobis distance, 1 being usual; 0 for missing points.
        """
        away: Floats = self._distances(X, visible) / self.typical
        return away

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
        covariance = spread + C - C @ used @ C + _FLOOR**2 * np.eye(2 * p)
        mean = self.mean + shift.reshape(p, 2)
        return PointModel(mean, (covariance + covariance.T) / 2, self.typical)

    def _distances(self, X: Floats, visible: Bools) -> Floats:
        """Return the Mahalanobis distance (f, p) of each point given the others of its frame.

        With the precision L of the visible coordinates, d = x - mean and y = L d, a point i is
        off by r_i = L_ii^-1 y_i, and r_i^T L_ii r_i = y_i^T L_ii^-1 y_i.
        """
        f, p = visible.shape
        distances = np.zeros((f, p))
        own = np.arange(p)
        for frames, precision in self._precisions(visible):
            d = ((X[frames] - self.mean) * visible[frames][..., None]).reshape(-1, 2 * p)
            y = (d @ precision).reshape(-1, p, 2)
            blocks = np.linalg.inv(precision.reshape(p, 2, p, 2)[own, :, own])
            squares = np.einsum("fpi,pij,fpj->fp", y, blocks, y)
            distances[frames] = np.sqrt(np.maximum(squares, 0))
        return np.where(visible, distances, 0.0)

    def _precisions(self, visible: Bools) -> Iterator[tuple[NDArray[np.intp], Floats]]:
        """Yield (frames, precision (2 p, 2 p)) for each pattern of visible points.

        Missing coordinates and the place of the frame are variables of very large variance, which
        drop out.
        """
        p = visible.shape[1]
        covariance = self.covariance + np.kron(np.ones((p, p)), np.eye(2)) * _FREE
        patterns, which, counts = np.unique(
            visible, axis=0, return_inverse=True, return_counts=True
        )
        frames = np.split(np.argsort(which.ravel(), kind="stable"), np.cumsum(counts)[:-1])
        for pattern, those in zip(patterns, frames, strict=True):
            yield those, np.linalg.inv(covariance + np.diag(_MISSING * np.repeat(~pattern, 2)))


def find_outliers(
    points: NDArray[np.float32], visible: Bools, threshold: float
) -> tuple[Bools, Floats]:
    """Return the outliers (f, p) among the visible points and the deviation (f,) of the worst.

    In each frame the worst point is taken out and the others are judged again without it, until
    none deviates by more than `threshold` or `_LEAST` are left.
    """
    model = PointModel.fit(points, visible, threshold)
    outliers, worst = np.zeros_like(visible), np.zeros(len(points))
    for part in slices(len(points)):
        outliers[part], worst[part] = _judge(model, points[part], visible[part], threshold)
    return outliers, worst


def _judge(
    model: PointModel, points: NDArray[np.float32], visible: Bools, threshold: float
) -> tuple[Bools, Floats]:
    """Return what `find_outliers` does, of some of its frames."""
    X = normalised(points, visible)
    kept, worst = visible.copy(), np.zeros(len(X))
    left = np.arange(len(X))
    while len(left):
        deviations = model.deviations(X[left], kept[left])
        top = deviations.max(1)
        worst[left] = np.maximum(worst[left], top)
        more = (top > threshold) & (kept[left].sum(1) > _LEAST)
        left = left[more]
        kept[left, deviations[more].argmax(1)] = False
    return visible & ~kept, worst
