# SPDX-License-Identifier: Apache-2.0
"""The lifter's own diagnosis, by its stated rules."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.node.diagnostics import ERROR, OK, WARN, LifterDiagnostics


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def health(clock: Clock) -> LifterDiagnostics:
    return LifterDiagnostics(clock)


GOOD, POOR = np.full(2, 0.05, np.float32), np.full(2, 0.6, np.float32)
SURE, UNSURE = np.full((2, 5), 0.8, np.float32), np.full((2, 5), 0.2, np.float32)


def test_lifting_is_ok_and_measured(health: LifterDiagnostics, clock: Clock) -> None:
    for milliseconds in (1, 2, 9):
        health.lifted(milliseconds / 1e3, GOOD, SURE)
    clock.now += 2
    level, message, values = health.report()
    assert (level, message) == (OK, "lifting")
    assert values["rate [Hz]"] == "1.5"
    assert values["processing time p50 [ms]"] == "2.000"
    assert values["processing time max [ms]"] == "9.000"
    assert values["residual"] == "0.0500"
    assert values["confidence"] == "0.80"
    assert values["messages lifted"] == "3"


def test_each_report_begins_anew_but_totals_stay(health: LifterDiagnostics, clock: Clock) -> None:
    health.rejected("too short")
    health.lifted(0.001, POOR, SURE)
    assert health.report().level == WARN
    health.lifted(0.001, GOOD, SURE)
    clock.now += 1
    level, _, values = health.report()
    assert level == OK
    assert (values["messages lifted"], values["messages rejected"]) == ("2", "1")
    assert values["last problem"] == "too short"


def test_a_detector_that_sees_nothing_is_heard(health: LifterDiagnostics, clock: Clock) -> None:
    health.publisher_problem("a publisher that is gone by now")
    clock.now += 10
    health.empty()
    assert not health.idle
    level, message, values = health.report()
    assert (level, message) == (OK, "the detector sees no object")
    assert values["messages without objects"] == "1" and health.idle


def test_nothing_but_rejected_messages_is_an_error_that_says_why(health: LifterDiagnostics) -> None:
    health.rejected("5 keypoints, not 17")
    level, message, _ = health.report()
    assert level == ERROR and "1 of 1" in message and "5 keypoints, not 17" in message


def test_silence_is_a_warning_after_three_seconds(health: LifterDiagnostics, clock: Clock) -> None:
    clock.now += 2.9
    assert health.report().level == OK
    clock.now += 0.2
    level, message, _ = health.report()
    assert level == WARN and "no keypoints for 3 s" in message


def test_an_unheard_publisher_is_an_error_until_something_is_lifted(
    health: LifterDiagnostics,
) -> None:
    health.publisher_problem("wrong type")
    assert health.report()[:2] == (ERROR, "wrong type")
    assert health.report().level == ERROR
    health.lifted(0.001, GOOD, SURE)
    assert health.report().level == OK


def test_a_poor_fit_is_a_warning(health: LifterDiagnostics) -> None:
    health.lifted(0.001, POOR, SURE)
    level, message, _ = health.report()
    assert level == WARN and "0.60" in message


def test_low_confidence_is_a_warning_of_half_of_the_objects(health: LifterDiagnostics) -> None:
    health.lifted(0.001, GOOD, UNSURE)
    level, message, values = health.report()
    assert level == WARN and "confidence" in message and values["confidence"] == "0.20"
    for confidence in (UNSURE, SURE, SURE):
        health.lifted(0.001, GOOD, confidence)
    assert health.report().level == OK


def test_points_without_a_frame_are_a_warning_beside_others(health: LifterDiagnostics) -> None:
    health.lifted(0.001, GOOD, SURE)
    health.frame_problem = "no frame_id"
    assert health.report()[:2] == (WARN, "no frame_id")
    health.lifted(0.001, POOR, SURE)
    assert "no frame_id" not in health.report().message
    health.lifted(0.001, POOR, SURE)
    health.frame_problem = "no frame_id"
    assert health.report().message == "poor fit: median residual 0.60; no frame_id"


def test_a_model_of_fewer_keypoints_may_take_over_between_two_reports(
    health: LifterDiagnostics,
) -> None:
    health.lifted(0.001, GOOD, SURE)
    health.lifted(0.001, GOOD, UNSURE[:, :3])
    assert health.report().values["confidence"] == "0.50"


def test_objects_that_could_not_be_lifted_do_not_spoil_the_error(health: LifterDiagnostics) -> None:
    health.lifted(0.001, np.array([np.nan, 0.1], np.float32), SURE)
    values = health.report().values
    assert (values["residual"], values["confidence"]) == ("0.1000", "0.80")
    health.lifted(0.001, np.array([np.nan], np.float32), SURE[:1])
    assert health.report().level == OK


def test_idle_tells_whether_anything_came(health: LifterDiagnostics) -> None:
    assert health.idle
    health.rejected("x")
    assert not health.idle
    health.report()
    assert health.idle


def test_more_dropped_than_lifted_is_a_warning_with_the_mend(health: LifterDiagnostics) -> None:
    health.lifted(0.01, np.array([0.1], np.float32), np.array([[0.9]], np.float32))
    health.dropped(1)
    assert health.report().level == OK
    health.lifted(0.01, np.array([0.1], np.float32), np.array([[0.9]], np.float32))
    health.dropped(2)
    level, message, values = health.report()
    assert (
        level == WARN
        and message.startswith("2 of 3 messages dropped")
        and "test_time_rotations" in message
    )
    assert values["messages dropped"] == "3"
    assert health.report().level == OK


def test_the_last_problem_has_its_age_and_is_gone_after_a_minute(
    health: LifterDiagnostics, clock: Clock
) -> None:
    assert health.report().values["last problem"] == "none"
    health.rejected("no CameraInfo")
    assert health.report().values["last problem"] == "no CameraInfo"
    clock.now += 12
    health.lifted(0.001, GOOD, SURE)
    assert health.report().values["last problem"] == "no CameraInfo (12 s ago)"
    clock.now += 50
    health.lifted(0.001, GOOD, SURE)
    assert health.report().values["last problem"] == "none"
    assert health.report().values["messages rejected"] == "1"
    health.publisher_problem("another type")
    assert health.report().values["last problem"] == "another type"
