# SPDX-License-Identifier: Apache-2.0
"""Keypoints that contradict the others are lifted as missing, and only those."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.data.walking_person import in_layout
from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN25
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter
from deep_nrsfm_ros.lifting.numpy_backend import NumpyBackend
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.wrong_keypoints import FEWEST, MIN_DISTANCE, Fit, without_wrong

KEPT = LiftingOptions(leave_out_wrong=False)
NONE = np.zeros((0, 2), np.int32)
WRIST = HUMAN25.index("left_wrist")
PERSON, SEEN = (part[2:3] for part in in_layout(HUMAN25, 4))
"""(1, 25, 2) and (1, 25): one without heels and toes."""
RADIUS = PERSON[SEEN > 0].std(0).max()


def far(points: np.ndarray, keypoint: int, radii: float = 2.0) -> np.ndarray:
    """Return the points (1, p, 2) with one at a wrong place, that many radii away."""
    moved = points.copy()
    moved[0, keypoint] += radii * RADIUS * np.array([0.8, 0.6], np.float32)
    return moved


def without(confidence: np.ndarray, *keypoints: int) -> np.ndarray:
    """Return the confidence (1, p) with some keypoints missing."""
    left = confidence.copy()
    left[0, list(keypoints)] = 0
    return left


def same(a: Lifted, b: Lifted) -> None:
    """Check that two lifts are the same to the last digit, whatever was left out."""
    for one, other in zip(a[:-1], b[:-1], strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ["left_wrist", "right_ankle", "nose", "left_knee", "right_elbow"])
def test_a_wrong_keypoint_is_lifted_as_a_missing_one(name: str) -> None:
    lifter, keypoint = Lifter("human"), HUMAN25.index(name)
    lifted = lifter(far(PERSON, keypoint), SEEN)
    same(lifted, lifter(PERSON, without(SEEN, keypoint)))
    assert np.flatnonzero(lifted.wrong).tolist() == [keypoint]
    kept = Lifter("human", KEPT)(far(PERSON, keypoint), SEEN)
    others, right = np.arange(25) != keypoint, lifter(PERSON, SEEN).shapes
    near, off = (np.abs(each.shapes - right)[0, others].mean() for each in (lifted, kept))
    assert near < 0.3 * off


def test_two_wrong_keypoints_are_found() -> None:
    lifter, ankle = Lifter("human"), HUMAN25.index("right_ankle")
    wrong = far(far(PERSON, WRIST, 5.0), ankle, 1.5)
    lifted = lifter(wrong, SEEN)
    same(lifted, lifter(PERSON, without(SEEN, WRIST, ankle)))
    assert set(np.flatnonzero(lifted.wrong)) == {WRIST, ankle}


def test_a_neck_goes_with_its_shoulder() -> None:
    points, confidence = (part[2:3] for part in in_layout(COCO17, 4))
    lifter, shoulder = Lifter("human", layout="coco17"), COCO17.index("left_shoulder")
    lifted = lifter(far(points, shoulder), confidence)
    same(lifted, lifter(points, without(confidence, shoulder)))
    assert {HUMAN25.keypoints[i] for i in np.flatnonzero(lifted.wrong)} == {"left_shoulder", "neck"}


def test_people_as_they_are_keep_all_keypoints() -> None:
    points, confidence = in_layout(HUMAN25, 60)
    lifted = Lifter("human")(points, confidence)
    same(lifted, Lifter("human", KEPT)(points, confidence))
    assert not lifted.wrong.any()


def test_too_few_keypoints_do_not_tell_which_one_is_wrong() -> None:
    few = without(SEEN, *range(FEWEST, 25))
    wrong = far(PERSON, 2)
    same(Lifter("human")(wrong, few), Lifter("human", KEPT)(wrong, few))


def test_as_many_keypoints_are_left_as_a_lift_needs() -> None:
    needs = Lifter("human").detected_count(SEEN)[0]
    lifted = Lifter("human", LiftingOptions(min_visible=int(needs)))(far(PERSON, WRIST), SEEN)
    assert np.isfinite(lifted.shapes).all()


def test_numpy_leaves_out_the_same() -> None:
    lifter, points = Lifter("human"), np.concatenate([far(PERSON, WRIST), PERSON])
    confidence = np.concatenate([SEEN, SEEN])
    found, _ = NumpyBackend(lifter.constants)(points, confidence, False)
    np.testing.assert_allclose(found[0], lifter(points, confidence).shapes, atol=1e-4)


def contradicted(wrong: int, distance: float, residual: float) -> Callable[[np.ndarray], Fit]:
    """Return a fit of 10 keypoints that is bad, or has `residual` without the wrong one."""

    def fit(visible: np.ndarray) -> Fit:
        distances = np.full(10, 0.2)
        distances[wrong] = distance
        return Fit(np.array(0.4 if visible[wrong] else residual), distances)

    return fit


@pytest.mark.parametrize(
    ("distance", "residual", "left_out"),
    [
        (2 * MIN_DISTANCE, 0.1, True),
        (0.9 * MIN_DISTANCE, 0.1, False),  # near its place
        (2 * MIN_DISTANCE, 0.35, False),  # the others fit no better without it
    ],
)
def test_both_signs_are_asked_for(distance: float, residual: float, left_out: bool) -> None:
    points, visible = np.random.default_rng(0).standard_normal((10, 2)), np.ones(10, bool)
    left = without_wrong(contradicted(3, distance, residual), points, visible, NONE, 4)
    np.testing.assert_array_equal(left, (np.arange(10) != 3) | (not left_out))
