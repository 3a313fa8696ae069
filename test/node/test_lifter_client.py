# SPDX-License-Identifier: Apache-2.0
"""The client joins the keypoints and the points of a lifter, over DDS."""

from __future__ import annotations

import dataclasses
import time
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import PointCloud2, PointField

from deep_nrsfm_ros.data.recording import Recording
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.messages.decoding import POINT_FIELDS, POINT_STEP, pack_points
from deep_nrsfm_ros.node.lifter_client import LifterClient, LifterTopics
from test.node.conftest import DEADLINE

KEYPOINTS = 17
TOPICS = LifterTopics("/lifter", "/keypoints", HUMAN17, HUMAN17, 0.1)


def message(second: int, objects: int = 2) -> PointCloud2:
    points = np.random.default_rng(second).uniform(1, 900, (objects, KEYPOINTS, 2))
    fields = [PointField(name=n, offset=at, datatype=7, count=1) for n, at in POINT_FIELDS]
    cloud = PointCloud2(height=objects, width=KEYPOINTS, fields=fields, point_step=POINT_STEP)
    cloud.row_step = POINT_STEP * KEYPOINTS
    cloud.data = array("B", pack_points(points, np.full((objects, KEYPOINTS), 0.9)))
    cloud.header.stamp.sec = second
    return cloud


def test_keypoints_and_answers_are_joined(
    start_lifter: Callable[..., Any],
    connect: Callable[[], Any],
    domain: int,
) -> None:
    start_lifter()
    client = connect()
    publisher = client.publisher(PointCloud2)
    shown: list[list[Recording]] = [[], []]
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    executor = SingleThreadedExecutor(context=context)
    found_topic = dataclasses.replace(TOPICS, keypoints="")
    client_nodes = [
        LifterClient(topics, frames.append, context)
        for topics, frames in zip((TOPICS, found_topic), shown, strict=True)
    ]
    for client_node in client_nodes:
        executor.add_node(client_node)
    try:
        second = 0

        def last_joined(frames: list[Recording]) -> list[Recording]:
            found = [r for r in frames if r.detections.confidence.any() and r.is_lifted.all()]
            # The rotation is a message of its own, which may come too late for a frame.
            return [r for r in found if np.isfinite(r.lifted.rotations[0]).all()][-1:]

        def joined() -> list[Recording] | None:
            nonlocal second
            second += 1
            publisher.publish(message(second))
            executor.spin_once(timeout_sec=0.2)
            found = [recording for frames in shown for recording in last_joined(frames)]
            return found if len(found) == len(shown) else None

        recordings = client.wait(joined, "frames with keypoints, points and rotation")
    finally:
        executor.shutdown()
        for client_node in client_nodes:
            client_node.destroy_node()
        rclpy.shutdown(context=context)
    for recording in recordings:
        (stamp,) = recording.detections.stamps.tolist()
        expected = np.random.default_rng(stamp // 10**9).uniform(1, 900, (2, KEYPOINTS, 2))
        np.testing.assert_allclose(recording.detections.points, expected, rtol=1e-6)
        R = recording.lifted.rotations
        np.testing.assert_allclose(R[0] @ R[0].T, np.eye(3), atol=1e-5)
        assert np.isnan(R[1]).all() and len(recording.detections) == 2
        W = recording.lifted.scale[:, None, None] * recording.lifted.shapes[..., :2]
        W += recording.lifted.translation[:, None]
        assert np.linalg.norm(W - expected) < np.linalg.norm(
            expected - expected.mean(1, keepdims=True)
        )


@pytest.mark.parametrize("wrong", ["fields", "width"])
def test_odd_points_are_complained_of(
    domain: int, wrong: str, capfd: pytest.CaptureFixture[str]
) -> None:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    shown: list[Recording] = []
    client_node = LifterClient(TOPICS, shown.append, context)
    publisher = client_node.create_publisher(PointCloud2, "/lifter/points", 10)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(client_node)
    odd = message(1)
    if wrong == "fields":
        odd.fields = odd.fields[:2]
    else:
        odd.width, odd.height = 34, 1
    log, end = "", time.monotonic() + DEADLINE
    while "[lifter_client]" not in log and time.monotonic() < end:
        publisher.publish(odd)
        publisher.publish(odd)  # the one before is joined when the next one arrives
        executor.spin_once(timeout_sec=0.1)
        log += "".join(capfd.readouterr())
    executor.shutdown()
    client_node.destroy_node()
    rclpy.shutdown(context=context)
    assert not shown and ("fields" if wrong == "fields" else "34") in log
