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
_BLOCK = 2**24  # floats held at a time
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
    def fit(cls, X: Floats, visible: Bools, threshold: float) -> PointModel:
        """Fit to normalised frames X (f, p, 2): points beyond `threshold` are left out and again.

        Missing points are filled by expectation-maximisation. Deterministic.
        """
        if len(X) > _SAMPLE:
            chosen = np.random.default_rng(0).choice(len(X), _SAMPLE, replace=False)
            X, visible = X[chosen], visible[chosen]
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
        for part, precisions, which in self._precisions(visible):
            x = ((X[part] - self.mean) * visible[part][..., None]).reshape(-1, 2 * p)
            filled[part] = (precisions[which] @ x[..., None])[..., 0] @ C
            counts = np.bincount(which, minlength=len(precisions))
            used += np.tensordot(counts / f, precisions, 1)
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
        for part, precisions, which in self._precisions(visible):
            d = ((X[part] - self.mean) * visible[part][..., None]).reshape(-1, 2 * p)
            y = (precisions[which] @ d[..., None]).reshape(-1, p, 2)
            blocks = precisions.reshape(-1, p, 2, p, 2)[:, own, :, own].swapaxes(0, 1)
            squares = np.einsum("fpi,fpij,fpj->fp", y, np.linalg.inv(blocks)[which], y)
            distances[part] = np.sqrt(np.maximum(squares, 0))
        return np.where(visible, distances, 0.0)

    def _precisions(self, visible: Bools) -> Iterator[tuple[slice, Floats, NDArray[np.intp]]]:
        """Yield (frames, precisions (k, 2 p, 2 p), index (n,) into them), bounded in memory.

        One precision for each pattern of visible points. Missing coordinates and the place of
        the frame are variables of very large variance, which drop out.
        """
        p = visible.shape[1]
        place = np.kron(np.ones((p, p)), np.eye(2)) * _FREE
        rows, diagonal = max(1, _BLOCK // (2 * p) ** 2), np.arange(2 * p)
        for start in range(0, len(visible), rows):
            part = slice(start, start + rows)
            patterns, which = np.unique(visible[part], axis=0, return_inverse=True)
            covariances = np.repeat((self.covariance + place)[None], len(patterns), 0)
            covariances[:, diagonal, diagonal] += _MISSING * np.repeat(~patterns, 2, axis=1)
            yield part, np.linalg.inv(covariances), which.ravel()


def find_outliers(
    points: NDArray[np.float32], visible: Bools, threshold: float
) -> tuple[Bools, Floats]:
    """Return the outliers (f, p) among the visible points and the deviation (f,) of the worst.

    In each frame the worst point is taken out and the others are judged again without it, until
    none deviates by more than `threshold` or `_LEAST` are left.
    """
    X = normalised(points, visible)
    model = PointModel.fit(X, visible, threshold)
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
