"""Confidence: the chance that a lifted point is near its true place.

Near is within `CORRECT_DISTANCE` of the object's size, twice its RMS radius (1.1 m of an
adult), after the best scale, in the camera's axes: it covers shape and rotation. The odds of a
point that is seen are

    odds = exp(constant) spread^a residual^b share^c

with its spread, the standard deviation of the model's errors there relative to the object's RMS
radius, which the model has learned without labels; the reprojection residual of its object; and
the share of the object's points that are seen. Those of a missing point are less by a factor. A
point that the detector is sure of by 0.7 counts as seen with the chance 0.7, else as missing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]

CORRECT_DISTANCE = 0.1
"""Distance, in sizes of the object, within which a point is near its true place."""
RESIDUAL_OFFSET = 0.02  # what a residual is never better than


class Calibration(NamedTuple):
    """Exponents of the odds, and the logarithms of their factors."""

    constant: float
    spread: float
    residual: float
    share: float
    missing: float


CALIBRATED = Calibration(-6.47, -2.29, -1.49, 1.29, -0.27)
"""Fitted to subjects that no model was trained on.

Source: `python -m benchmarks.robustness.confidence_calibration --data DATA`.
"""


def log_odds_terms(visible: NDArray[np.bool_], residual: Floats, spread: Floats) -> Floats:
    """Return what the log odds of a seen point are a sum of, (n, p, 4), by `Calibration`.

    visible: (n, p). residual: (n,). spread: (n, p).
    """
    n, p = visible.shape
    values = np.ones((n, p, 4), np.float32)
    values[..., 1] = np.log(spread)
    values[..., 2] = np.log(residual + RESIDUAL_OFFSET)[:, None]
    values[..., 3] = np.log(np.maximum(visible.sum(1), 1) / p)[:, None]
    return values


def keypoint_confidence(
    confidence: Floats, residual: Floats, spread: Floats, by: Calibration = CALIBRATED
) -> NDArray[np.float32]:
    """Return the chance (n, p) that each point is near its true place.

    confidence: (n, p) of the detector, 0 = missing. The rest as in `log_odds_terms`.
    """
    sure = np.minimum(confidence, np.float32(1))
    seen = np.exp(
        -(log_odds_terms(confidence > 0, residual, spread) @ np.array(by[:4], np.float32))
    )
    chance: NDArray[np.float32] = sure / (1 + seen)
    chance += (1 - sure) / (1 + seen * np.float32(np.exp(-by.missing)))
    return chance
