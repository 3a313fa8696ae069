# SPDX-License-Identifier: Apache-2.0
"""The direction of gravity, from a parameter or an IMU."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import Imu

from deep_nrsfm_ros.lifting.options import GravityOptions
from deep_nrsfm_ros.node.gravity import GravityDirection, GravitySources

LEVEL = np.array([0.0, -1, 0])


class Clock:
    """A clock that a test sets."""

    seconds = 100.0

    def now(self) -> Time:
        return Time(nanoseconds=round(1e9 * self.seconds), clock_type=ClockType.ROS_TIME)


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    node = Node("gravity_test")
    clock = Clock()
    monkeypatch.setattr(node, "get_clock", lambda: clock)
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


def assert_near(found: np.ndarray | None, expected: np.ndarray) -> None:
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-9)


def measured(gravity: GravityDirection, *acceleration: float, **fields: Any) -> None:
    message = Imu(**fields)
    a = message.linear_acceleration
    a.x, a.y, a.z = map(float, acceleration)
    gravity._receive_imu(message)


def test_the_parameter_is_a_direction_of_any_length() -> None:
    assert GravityOptions().direction is None
    assert_near(GravityOptions((0, -2.0, 0)).direction, LEVEL)
    assert_near(GravityOptions((0, -1e300, 0)).direction, LEVEL)
    for wrong in ((0.0, 1.0), (0.0, float("nan"), 1.0)):
        with pytest.raises(ValueError, match="three finite numbers"):
            GravityOptions(wrong)  # type: ignore[arg-type]


def test_an_imu_comes_before_the_parameter_and_is_averaged(node: Node) -> None:
    gravity = GravityDirection(node, GravitySources(imu="imu"))
    assert gravity(None, "optical") is None
    np.testing.assert_array_equal(gravity(LEVEL, "optical"), LEVEL)
    clock: Any = node.get_clock()
    rng = np.random.default_rng(0)
    for _ in range(300):
        clock.seconds += 0.01
        measured(gravity, *(np.array([0, -9.81, -3.0]) + rng.normal(0, 0.5, 3)))
    found = gravity(LEVEL, "optical")
    assert found is not None
    np.testing.assert_allclose(found, [0, -0.956, -0.292], atol=0.03)
    measured(gravity, 30, 0, 0)  # a bump
    np.testing.assert_array_equal(gravity(LEVEL, "optical"), found)
    assert gravity.status(None, "optical").startswith("up is ")
    clock.seconds += 100
    np.testing.assert_array_equal(gravity(LEVEL, "optical"), LEVEL)


def test_an_imu_in_another_frame_is_turned(node: Node) -> None:
    gravity = GravityDirection(node, GravitySources(imu="imu"))
    gravity._tree.add("link", "optical", (-0.5, 0.5, -0.5, 0.5))
    message = Imu()
    message.header.frame_id = "link"
    message.linear_acceleration.z = 9.81
    gravity._receive_imu(message)
    assert_near(gravity(None, "optical"), LEVEL)


@pytest.mark.skipif(importlib.util.find_spec("tf2_msgs") is not None, reason="tf2_msgs is there")
def test_a_frame_without_tf2_is_an_error(node: Node) -> None:
    with pytest.raises(ValueError, match=r"gravity.frame is 'map'.* install it"):
        GravityDirection(node, GravitySources(frame="map"))


def test_a_frame_on_tf_comes_first(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GravityDirection, "_listen_to_frames", lambda *_, **__: None)
    gravity = GravityDirection(node, GravitySources(frame="map"))
    assert "waiting for frame map" in gravity.status(None, "optical")
    gravity._tree.add("map", "optical", (-0.5, 0.5, -0.5, 0.5))
    assert_near(gravity(None, "optical"), LEVEL)


def test_the_status_names_the_source_and_an_imu_without_a_transform(node: Node) -> None:
    gravity = GravityDirection(node, GravitySources(imu="imu"))
    assert gravity.status(None, "optical") == "waiting for IMU on imu"
    assert gravity.status(LEVEL, "optical").endswith("in the camera's axes, by gravity.up")
    message = Imu()
    message.header.frame_id = "imu_link"
    message.linear_acceleration.z = 9.81
    gravity._receive_imu(message)
    found = gravity.find(None, "optical")
    assert found.status == (
        "up is 0.00 0.00 1.00 in the camera's axes, by the IMU on imu, whose imu_link is taken as "
        "the camera's optical frame"
    )
    assert "the axes of imu_link are those of the camera's optical frame" in found.mend
    gravity._tree.add("imu_link", "optical", (-0.5, 0.5, -0.5, 0.5))
    found = gravity.find(None, "optical")
    assert found.status.endswith("by the IMU on imu") and "imu_link to optical" in found.mend
    assert GravityDirection(node, GravitySources()).status(None, "") == "unknown"
