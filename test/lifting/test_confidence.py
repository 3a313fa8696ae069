# SPDX-License-Identifier: Apache-2.0
"""Confidence: a probability, and less of it wherever less is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.confidence import (
    CALIBRATED,
    EXTENT_OFFSET,
    MIN_KNOWN,
    RESIDUAL_OFFSET,
    Calibration,
    Coefficients,
    Evidence,
    gaps,
    keypoint_confidence,
)
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import find_model, load_model
from deep_nrsfm_ros.nrsfm.network import point_precision

P = 10
# A chain: each point near its neighbours.
CHAIN = np.minimum.outer(np.arange(P), np.arange(P)) + 1.0
RNG = np.random.default_rng(0)
SHAPE = np.column_stack((np.arange(P) - (P - 1) / 2, np.tile((0.5, -0.5), P // 2), np.zeros(P)))


def precision() -> NDArray[np.float64]:
    """Return the precision (P, P) of the chain, translation free, as `point_precision` does."""
    Q = np.linalg.inv(CHAIN)
    sums = Q.sum(1)
    Q -= sums[:, None] * sums / sums.sum()
    Q *= np.linalg.pinv(Q).trace() / P
    return Q + 1e-6 * Q.trace() * np.eye(P)


def evidence(
    confidence: NDArray[np.float64], residual: float = 0.1, shape: NDArray[np.float64] = SHAPE
) -> Evidence:
    """Return that of one object of confidence (P,)."""
    return Evidence(
        confidence[None].copy(),
        confidence[None] > 0,
        np.array([residual], np.float32),
        shape[None].astype(np.float32),
    )


def confidences(
    visible: int = P,
    detected: float = 1.0,
    residual: float = 0.1,
    spread: float = 0.2,
    calibration: Calibration = CALIBRATED,
) -> NDArray[np.float32]:
    """Return the confidence (P,) of an object of P, of which the first are visible."""
    radius = np.sqrt((SHAPE**2).sum(1).mean())
    found = keypoint_confidence(
        evidence(np.where(np.arange(P) < visible, detected, 0), residual),
        np.full(P, spread * radius),
        precision(),
        calibration,
    )
    assert found.shape == (1, P) and found.dtype == np.float32
    return found[0]


def test_what_is_worse_known_is_less_likely_near() -> None:
    for worse, better in (
        (confidences(residual=0.1), confidences(residual=0.0)),
        (confidences(residual=2), confidences(residual=0.5)),
        (confidences(spread=0.2), confidences(spread=0.05)),
        (confidences(spread=1e6), confidences(spread=1)),
        (confidences(detected=0.5, visible=9), confidences(visible=9)),
    ):
        assert (worse <= better).all() and worse.sum() < better.sum()


def test_farther_from_the_visible_points_is_less_confident() -> None:
    for visible in range(4, P - 1):
        found = confidences(visible)
        assert (np.diff(found[visible:]) < 0).all()
        assert found[visible] < found[:visible].min()


def test_a_point_becomes_less_confident_as_those_around_it_are_hidden() -> None:
    last = [confidences(visible)[-1] for visible in range(P, 3, -1)]
    assert (np.diff(last) < 0).all()


def test_the_gap_is_the_deviation_given_the_visible_points() -> None:
    visible = np.ones((2, P), bool)
    visible[0, [2, 3, 7]] = visible[1, 5:] = False
    found = gaps(visible, precision())
    samples = RNG.multivariate_normal(np.zeros(P), CHAIN, 40000)
    centred = samples - samples.mean(1, keepdims=True)
    unit = np.sqrt((centred**2).mean())
    for mask, gap in zip(visible, found, strict=True):
        # The error of the best linear prediction of the missing ones, of which translation is free.
        shown = samples - samples[:, mask].mean(1, keepdims=True)
        weights = np.linalg.lstsq(shown[:, mask], shown[:, ~mask], rcond=None)[0]
        error = shown[:, ~mask] - shown[:, mask] @ weights
        np.testing.assert_allclose(gap[~mask], error.std(0) / unit, rtol=0.03)
        assert (np.diff(gap[5:]) > 0).all() or mask[5]


def test_it_is_a_probability_whatever_comes() -> None:
    confidence = RNG.uniform(-1, 2, (500, P)).clip(0, 1).astype(np.float32)
    shapes = RNG.standard_normal((500, P, 3)) * 10 ** RNG.uniform(-3, 3, (500, 1, 1))
    found = keypoint_confidence(
        Evidence(
            confidence, confidence > 0, RNG.uniform(0, 3, 500), shapes - shapes.mean(1)[:, None]
        ),
        10 ** RNG.uniform(-6, 6, P),
        precision(),
        CALIBRATED,
    )
    assert ((found >= 0) & (found <= 1)).all()
    assert found.min() < 0.01 and found.max() > 0.99


def test_the_formula() -> None:
    by = Calibration(
        Coefficients(0.3, -2.0, -1.5, 1.1, -0.7, -1.2, 0.0),
        Coefficients(-0.4, -1.0, -1.1, 0.9, -0.5, -0.8, -3.0),
    )
    visible = 7
    found = confidences(visible, residual=0.08, spread=0.25, calibration=by)
    radius = np.sqrt((SHAPE**2).sum(1).mean())
    distance = np.linalg.norm(SHAPE - SHAPE[:visible].mean(0), axis=1) / radius
    extent = np.sqrt((distance[:visible] ** 2).mean())
    conditional = np.linalg.inv(precision()[visible:, visible:]).diagonal()
    explained = 1 - conditional.sum() / P
    assert MIN_KNOWN < explained < 1
    for i, c, known, gap in (
        (2, by.visible, 0.7, 0.0),
        (8, by.missing, explained, conditional[1] ** 0.5),
    ):
        odds = np.exp(c.constant + c.distance * distance[i] + c.gap * gap) * 0.25**c.spread
        odds *= (0.08 + RESIDUAL_OFFSET) ** c.residual * known**c.known
        odds *= (extent + EXTENT_OFFSET) ** c.extent
        assert found[i] == pytest.approx(odds / (1 + odds), rel=1e-4)


def test_a_point_the_detector_doubts_is_between_seen_and_missing() -> None:
    found = []
    for certainty in (1.0, 0.25, 0.0):
        of = evidence(np.ones(P))
        of.certainty[0, 4] = certainty
        found.append(keypoint_confidence(of, np.full(P, 0.5), precision(), CALIBRATED)[0])
    sure, doubted, missing = found
    assert missing[4] < doubted[4] < sure[4]
    assert doubted[4] == pytest.approx(0.25 * sure[4] + 0.75 * missing[4])
    np.testing.assert_array_equal(np.delete(doubted, 4), np.delete(sure, 4))


def test_what_is_shipped_was_fitted() -> None:
    for part in CALIBRATED:
        assert part.spread < 0 and part.residual < 0 and part.distance < 0 and part.known > 0
    assert CALIBRATED.missing.gap < 0 == CALIBRATED.visible.gap


_BELOW_THE_HIPS = ("knee", "ankle", "heel", "big_toe", "small_toe")


def test_legs_out_of_the_picture_have_little_confidence() -> None:
    """The model `human`: the farther from the visible points, the less; the trunk keeps its own."""
    model = load_model(find_model("human", model_folders(default_models_dir())))
    at, visible = model.layout.index, np.ones((1, len(model.layout)), bool)
    for side in ("left", "right"):
        visible[:, [at(f"{side}_{part}") for part in _BELOW_THE_HIPS]] = False
    gap = gaps(visible, point_precision(model.network))[0]
    for side in ("left", "right"):
        knee, ankle, toe = (gap[at(f"{side}_{part}")] for part in ("knee", "ankle", "big_toe"))
        assert 0.2 < knee < ankle < toe < 2
    alone = np.ones((1, len(model.layout)), bool)
    alone[0, at("left_knee")] = False
    assert (
        gaps(alone, point_precision(model.network))[0, at("left_knee")] < 0.8 * gap[at("left_knee")]
    )
    assert Lifter(model).constants.calibration == CALIBRATED
