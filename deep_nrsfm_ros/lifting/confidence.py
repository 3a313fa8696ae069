"""Confidence: the probability that a lifted point is close to its true position.

Close means within `CORRECT_DISTANCE` = 10 % of the object's size. The size is twice the RMS radius,
1.1 m for an adult. The distance is measured in camera axes after the best scale, so it includes the
errors of shape and rotation. The odds of a visible point are

    odds = exp(constant) spread^a residual^b visible^c

spread: standard deviation of the model's error at this point, relative to the object's RMS radius.
    The model has estimated it without 3D labels.
residual: relative reprojection error of the object.
visible: fraction of the object's points that are visible.

A factor lowers the odds of a missing point. A point with detector confidence 0.7 counts as visible
with probability 0.7 and as missing with probability 0.3.

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


class Calibration(NamedTuple):
    """Coefficients of the log odds.

    Attributes:
        constant: log odds where all other terms are 0.
        spread: exponent of the spread.
        residual: exponent of the residual.
        visible: exponent of the fraction of visible points.
        missing: added to the log odds of a missing point.
    """

    constant: float
    spread: float
    residual: float
    visible: float
    missing: float


CALIBRATED = Calibration(-6.47, -2.29, -1.49, 1.29, -0.27)
"""Fitted to subjects that no model was trained on.

Source: `python -m benchmarks.robustness.confidence_calibration --data DATA`.
"""


def log_odds_terms(visible: NDArray[np.bool_], residual: Floats, spread: Floats) -> Floats:
    """Return the terms (n, p, 4) that the first four coefficients of `Calibration` multiply.

    Args:
        visible: (n, p).
        residual: (n,) relative reprojection error, typically 0.05 to 0.3.
        spread: (n, p) standard deviation of the error relative to the RMS radius, typically 0.2.
    """
    n, p = visible.shape
    values = np.ones((n, p, 4), np.float32)
    values[..., 1] = np.log(spread)
    values[..., 2] = np.log(residual + RESIDUAL_OFFSET)[:, None]
    values[..., 3] = np.log(np.maximum(visible.sum(1), 1) / p)[:, None]
    return values


def keypoint_confidence(
    confidence: Floats, residual: Floats, spread: Floats, calibration: Calibration = CALIBRATED
) -> NDArray[np.float32]:
    """Return the probability (n, p) in [0, 1] that each lifted point is correct.

    Args:
        confidence: (n, p) of the detector; 0 where missing, above 1 counts as 1.
        residual: (n,) as in `log_odds_terms`.
        spread: (n, p) as in `log_odds_terms`.
        calibration: coefficients of the log odds.
    """
    detected = np.minimum(confidence, np.float32(1))
    coefficients = np.array(calibration[:4], np.float32)
    inverse_odds = np.exp(-(log_odds_terms(confidence > 0, residual, spread) @ coefficients))
    missing_factor = np.float32(np.exp(-calibration.missing))
    probability: NDArray[np.float32] = detected / (1 + inverse_odds)
    probability += (1 - detected) / (1 + inverse_odds * missing_factor)
    return probability
