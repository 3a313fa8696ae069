# SPDX-License-Identifier: Apache-2.0
"""Confidence: the probability that a lifted point is close to its true position.

Close means within `CORRECT_DISTANCE` = 10 % of the object's size. The size is twice the RMS radius,
1.1 m for an adult. The distance is measured in camera axes, after the translation and the scale
that fit the visible points best: these place an object in the image. It includes the errors of
shape and rotation. The odds of a point are

    odds = exp(constant + distance_i d + gap_i g) spread_i^a residual^b known^c extent^e

with one set of coefficients for visible points and another for missing ones.

spread_i: standard deviation of the model's error at this point, relative to the object's RMS
    radius. The model has estimated it without 3D labels, of complete objects.
residual: relative reprojection error of the object.
known: for a visible point, the fraction of the object's points that are visible; for a missing
    point, the fraction of the variance of all points that the visible ones explain.
extent: RMS distance of the visible points from their centroid, relative to the RMS radius. Of a
    person cut off at the waist, it is small; of a person with random gaps, it is near 1.
distance_i: distance of the point from that centroid, relative to the RMS radius.
gap_i: standard deviation of a missing point's position in the image, given the visible ones,
    relative to the RMS radius; from the second moment of the training's keypoints, which the
    network's whitening holds. It rises with the distance from the visible points: of `human`, a
    knee between hip and ankle has 0.46, toes of a person cut off at the hips have 0.96.

A point whose detector confidence, relative to the object's others (`weights.relative_confidence`),
is 0.7 counts as visible with probability 0.7 and as missing with probability 0.3; its gap is then
that of a point whose neighbours are all visible.

Source: ours, not in the paper.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]

CORRECT_DISTANCE = 0.1
"""Distance, in sizes of the object, below which a lifted point counts as correct."""
RESIDUAL_OFFSET = 0.02  # added to a residual, so that a residual of 0 has a finite logarithm
EXTENT_OFFSET = 0.05  # added to an extent, for the same reason
MIN_KNOWN = 0.01
"""Least fraction of the variance that visible points explain."""


class Coefficients(NamedTuple):
    """Coefficients of the log odds of a point.

    Attributes:
        constant: log odds where all other terms are 0.
        spread: exponent of the spread.
        residual: exponent of the residual.
        known: exponent of the known fraction.
        extent: exponent of the extent of the visible points.
        distance: log odds for each RMS radius of distance from the visible points' centroid.
        gap: log odds for each RMS radius of the gap; unused for visible points.
    """

    constant: float
    spread: float
    residual: float
    known: float
    extent: float
    distance: float
    gap: float


class Calibration(NamedTuple):
    """Coefficients of visible and of missing points."""

    visible: Coefficients
    missing: Coefficients


CALIBRATED = Calibration(
    visible=Coefficients(-3.48, -1.34, -1.82, 0.83, -1.41, -1.76, 0.00),
    missing=Coefficients(-1.22, -0.78, -1.29, 0.67, -0.60, -0.68, -4.71),
)
"""Fitted to a subject that no model was trained on.

Source: `python -m benchmarks.robustness.confidence_calibration --data DATA --fit`.
"""


class Evidence(NamedTuple):
    """What the confidence of n objects with p points follows from.

    Attributes:
        certainty: (n, p) `weights.relative_confidence` of the detector, from 0 to 1.
        visible: (n, p) whether the lifter takes the point as visible.
        residual: (n,) relative reprojection error, typically 0.05 to 0.3.
        shapes: (n, p, 3) lifted shapes, centred.
    """

    certainty: Floats
    visible: NDArray[np.bool_]
    residual: Floats
    shapes: Floats


def gaps(visible: NDArray[np.bool_], precision: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gap (n, p) of each point; of a visible one as if it were missing alone.

    Args:
        visible: (n, p).
        precision: (p, p) inverse second moment of the keypoints, in units of the RMS radius.
    """
    missing = ~visible
    both = missing[:, :, None] & missing[:, None]
    conditional = np.linalg.inv(np.where(both, precision, np.eye(len(precision))))
    alone = 1 / precision.diagonal()
    variance = np.where(visible, alone, np.diagonal(conditional, axis1=1, axis2=2))
    gap: NDArray[np.float64] = np.sqrt(variance)
    return gap


def log_odds_terms(
    evidence: Evidence, error_std: Floats, precision: NDArray[np.float64]
) -> tuple[Floats, Floats]:
    """Return the terms (n, p, 7) that `Coefficients` multiply, as visible and as missing points.

    Args:
        evidence: of the objects.
        error_std: (p,) standard deviation of the model's error at each point, in units of the
            shapes.
        precision: as in `gaps`.
    """
    visible, shapes = evidence.visible, evidence.shapes.astype(np.float64)
    n, p = visible.shape
    radius = np.maximum(np.sqrt((shapes * shapes).sum(2).mean(1)), 1e-9)
    weight = visible / np.maximum(visible.sum(1), 1)[:, None]
    offset = shapes - (weight[..., None] * shapes).sum(1)[:, None]
    distance = np.linalg.norm(offset, axis=2) / radius[:, None]
    extent = np.sqrt((weight * distance**2).sum(1))
    gap = gaps(visible, precision)
    explained = 1 - np.where(visible, 0, gap**2).sum(1) / p
    terms = np.ones((n, p, 7))
    terms[..., 1] = np.log(error_std / radius[:, None])
    terms[..., 2] = np.log(evidence.residual + RESIDUAL_OFFSET)[:, None]
    terms[..., 4] = np.log(extent + EXTENT_OFFSET)[:, None]
    terms[..., 5] = distance
    terms[..., 6] = gap
    as_visible, as_missing = terms, terms.copy()
    as_visible[..., 6] = 0  # the gap of a visible point is no evidence
    as_visible[..., 3] = np.log(np.maximum(visible.sum(1), 1) / p)[:, None]
    as_missing[..., 3] = np.log(np.maximum(explained, MIN_KNOWN))[:, None]
    return as_visible, as_missing


def keypoint_confidence(
    evidence: Evidence,
    error_std: Floats,
    precision: NDArray[np.float64],
    calibration: Calibration,
) -> NDArray[np.float32]:
    """Return the probability (n, p) in [0, 1] that each lifted point is correct.

    Args:
        evidence: of the objects.
        error_std: as in `log_odds_terms`.
        precision: as in `gaps`.
        calibration: coefficients of the log odds.
    """
    terms = log_odds_terms(evidence, error_std, precision)
    visible, missing = (
        1 / (1 + np.exp(np.minimum(-(of @ np.array(coefficients)), 700)))
        for of, coefficients in zip(terms, calibration, strict=True)
    )
    detected = np.where(evidence.visible, evidence.certainty, 0)
    probability: NDArray[np.float32] = detected * visible + (1 - detected) * missing
    return probability.astype(np.float32)
