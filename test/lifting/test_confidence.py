"""Confidence: a chance, and less of it wherever less is known."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.lifting.confidence import CALIBRATED, Calibration, keypoint_confidence

P = 10
EVEN = Calibration(0.0, 0.0, 0.0, 0.0, 0.0)


def chance(
    visible: int = P,
    detected: float = 1.0,
    residual: float = 0.1,
    spread: float = 0.2,
    point: int = 0,
) -> float:
    """Return the confidence of a point of an object of P, of which the first are visible."""
    confidence = np.where(np.arange(P) < visible, detected, 0).astype(np.float32)[None]
    spreads = np.full((1, P), spread, np.float32)
    found = keypoint_confidence(confidence, np.array([residual], np.float32), spreads)
    assert found.shape == (1, P) and found.dtype == np.float32
    return float(found[0, point])


def test_what_is_worse_known_is_less_likely_near() -> None:
    assert chance(residual=0.0) > chance(residual=0.1) > chance(residual=0.5) > chance(residual=2)
    assert chance(spread=0.05) > chance(spread=0.2) > chance(spread=1) > chance(spread=1e6) >= 0
    assert chance(visible=10) > chance(visible=7) > chance(visible=4)
    assert chance(visible=9) > chance(visible=9, point=9)


def test_it_is_a_chance_whatever_comes() -> None:
    rng = np.random.default_rng(0)
    confidence = rng.uniform(-1, 2, (500, P)).clip(0).astype(np.float32)
    residual = rng.uniform(0, 3, 500).astype(np.float32)
    spread = 10 ** rng.uniform(-6, 6, (500, P))
    found = keypoint_confidence(confidence, residual, spread)
    assert ((found >= 0) & (found <= 1)).all()
    assert found.min() < 0.01 and found.max() > 0.99


def test_the_formula() -> None:
    by = Calibration(0.3, -2.0, -1.5, 1.1, -0.7)
    confidence = np.ones((1, P), np.float32)
    confidence[0, 0] = 0
    found = keypoint_confidence(
        confidence, np.array([0.08], np.float32), np.full((1, P), 0.25), by
    )[0]
    odds = np.exp(0.3) * 0.25**-2.0 * 0.1**-1.5 * 0.9**1.1
    assert found[1] == pytest.approx(odds / (1 + odds))
    odds *= np.exp(-0.7)
    assert found[0] == pytest.approx(odds / (1 + odds))
    assert keypoint_confidence(
        confidence, np.array([0.08]), np.full((1, P), 0.25), EVEN
    ) == pytest.approx(0.5)


def test_a_point_the_detector_doubts_is_between_seen_and_missing() -> None:
    visible, missing = chance(visible=9, point=0), chance(visible=9, point=9)
    by = np.ones((1, P), np.float32)
    by[0, 9], by[0, 0] = 0, 0.25
    found = keypoint_confidence(by, np.array([0.1], np.float32), np.full((1, P), 0.2))
    assert found[0, 0] == pytest.approx(0.25 * visible + 0.75 * missing)


def test_what_is_shipped_was_fitted() -> None:
    assert CALIBRATED.spread < 0 and CALIBRATED.residual < 0 and CALIBRATED.missing < 0
    assert CALIBRATED.visible > 0
