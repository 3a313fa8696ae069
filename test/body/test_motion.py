# SPDX-License-Identifier: Apache-2.0
"""Velocities and states of identities."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.body.motion import BRIDGED, LOST, NEW, TRACKED, MotionTracker

RATE = 30.0


def test_a_steady_motion_has_its_velocity() -> None:
    tracker = MotionTracker(0.1)
    velocity = np.array([1.2, 0, -0.5])
    for i in range(60):
        points = (i / RATE * velocity)[None, None].repeat(2, 1)
        motion = tracker(("anna",), points, i / RATE)
    np.testing.assert_allclose(motion.velocities[0], [velocity] * 2, atol=1e-3)


@pytest.mark.parametrize("time_constant", [0.0, 0.1, 0.3])
def test_the_lag_is_the_time_constant_and_half_an_interval(time_constant: float) -> None:
    tracker = MotionTracker(time_constant)
    acceleration, lag = 2.0, 0.0
    for i in range(300):
        t = i / RATE
        points = np.full((1, 1, 3), acceleration * t * t / 2)
        motion = tracker(("anna",), points, t)
        lag = t - float(motion.velocities[0, 0, 0]) / acceleration
    assert lag == pytest.approx(time_constant + 0.5 / RATE, abs=1e-6)


def test_noise_of_the_points_is_filtered() -> None:
    rng = np.random.default_rng(0)
    spread = []
    for time_constant in (0.0, 0.1):
        tracker = MotionTracker(time_constant)
        found = [
            tracker(("a",), 0.01 * rng.standard_normal((1, 1, 3)), i / RATE).velocities
            for i in range(600)
        ]
        spread.append(np.nanstd(found))
    assert spread[1] < 0.35 * spread[0]


def test_states_follow_an_identity_through_its_life() -> None:
    tracker = MotionTracker(0.1)
    points = np.zeros((1, 1, 3))
    assert tracker(("anna",), points, 0.0).states == (NEW,)
    assert np.isnan(tracker(("bert",), points, 0.0).velocities).all()
    for i in range(1, 20):
        motion = tracker(("anna",), points, i / RATE)
    assert motion.states == (TRACKED,) and motion.ages[0] == pytest.approx(19 / RATE)
    assert tracker(("anna",), points, 20 / RATE, bridged=1).states == (BRIDGED,)
    assert tracker(("anna",), np.full((1, 1, 3), np.nan), 21 / RATE).states == (LOST,)
    assert set(tracker((), np.zeros((0, 1, 3)), 3.0).lost) == {"anna", "bert"}
    again = tracker(("anna",), points, 3.1)
    assert again.states == (NEW,) and again.ages[0] == 0


def test_a_gap_and_a_clock_that_begins_anew_give_no_jump() -> None:
    tracker = MotionTracker(0.1)
    for i in range(10):
        tracker(("anna",), np.zeros((1, 1, 3)), 100 + i / RATE)
    far = np.full((1, 1, 3), 50.0)
    assert np.isnan(tracker(("anna",), far, 103.0).velocities).all()
    assert tracker(("anna",), far, 5.0).states == (NEW,)
    assert (tracker(("anna",), far, 5.1).velocities == 0).all()
    assert (tracker(("anna",), far + 1, 5.1).velocities == 0).all()  # the stamp is that of the last


def test_who_is_lost_is_told_for_a_second_unless_back() -> None:
    tracker, point, nobody = MotionTracker(0.1), np.zeros((1, 1, 3)), np.zeros((0, 1, 3))
    for i in range(10):
        tracker(("anna",), point, i / RATE)
        tracker(("bert",), point, i / RATE)
    assert len(tracker) == 2 and not tracker((), nobody, 1.0).lost
    told = [tracker((), nobody, 1.4 + i / RATE).lost for i in range(60)]
    assert [set(lost) for lost in told] == [{"anna", "bert"}] * 31 + [set()] * 29
    assert not len(tracker)
    tracker(("anna",), point, 5.0)
    assert tracker((), nobody, 6.5).lost == ("anna",)
    assert tracker(("anna",), point, 6.6).lost == () == tracker(("anna",), point, 6.7).lost
    tracker((), nobody, 8.0)
    assert tracker((), nobody, 0.0).lost == ()  # the clock begins anew
