# SPDX-License-Identifier: Apache-2.0
"""The running lifter looks at its input: layout, unit, options under their documented names."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from benchmarks.data.walking_person import IMAGE, in_layout
from deep_nrsfm_ros.layouts.presets import COCO17, LAYOUTS
from deep_nrsfm_ros.node.lifter_client import running_layout
from test.node.conftest import Client, Connect, StartLifter, values
from test.node.test_lifter import cloud, unpack

AUTO = {"model": "human", "input_type": "auto", "keypoint_layout": "auto"}


@contextmanager
def stream(client: Client, points: np.ndarray, confidence: np.ndarray) -> Iterator[None]:
    """Publish the frames at 30 Hz, over and over."""
    publisher = client.publisher(PointCloud2, topic="keypoints")
    start, frame = time.time_ns(), 0

    def send() -> None:
        nonlocal frame
        message = cloud(points[[frame % len(points)]], confidence[[frame % len(points)]])
        stamp = start + frame * 33_333_333
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        publisher.publish(message)
        frame += 1

    timer = client.node.create_timer(1 / 30, send)
    yield
    client.node.destroy_timer(timer)
    client.node.destroy_publisher(publisher)


@pytest.mark.parametrize("layout", ["coco17", "human17", "mediapipe33"])
def test_the_layout_is_found(
    start_lifter: StartLifter, connect: Connect, domain: int, layout: str
) -> None:
    lifter = start_lifter(listens=False, **AUTO)
    client = connect()
    with stream(client, *in_layout(LAYOUTS[layout])):
        # A busy machine drops some of the first messages, which is a warning of its own.
        client.wait_for_health(
            lambda s, v: (
                s.level == b"\x00"
                and int(v["messages lifted"]) > 20
                and v["keypoint layout"].startswith(layout)
            )
        )
        assert running_layout("lifter", 30, domain) == layout
    assert f"keypoint_layout auto: {layout}" in lifter.log


def test_a_layout_that_does_not_fit_is_said(start_lifter: StartLifter, connect: Connect) -> None:
    lifter = start_lifter(model="human", keypoint_layout="human17")
    client = connect()
    with stream(client, *in_layout(COCO17)):
        status = client.wait_for_health(lambda s, _: "is it coco17?" in s.message)
        assert status.level == b"\x01"
        lifter.wait_for_log("set the keypoint layout to coco17")
        client.wait_for_health(lambda _, v: int(v["messages lifted"]) > 60)
        assert lifter.log.count("is it coco17?") == 1  # at a limited rate
        assert not client.set_parameters(keypoint_layout="auto")
        client.wait_for_health(lambda s, v: s.level == b"\x00" and "coco17" in v["keypoint layout"])


def test_a_size_of_another_image_is_said(start_lifter: StartLifter, connect: Connect) -> None:
    size = {"image_width": 400, "image_height": 1280}
    lifter = start_lifter(model="human", keypoint_layout="coco17", field_of_view=65.0, **size)
    client = connect()
    with stream(client, *in_layout(COCO17)):
        status = client.wait_for_health(lambda s, _: "outside the image of 400 x 1280" in s.message)
        assert status.level != b"\x00" and "not resized or cut" in status.message
        assert not client.set_parameters(image_width=IMAGE[0], image_height=IMAGE[1])
        client.wait_for_health(lambda s, v: s.level == b"\x00" and v["findings"] == "none")
    assert "hint" not in lifter.log


def test_a_field_of_view_is_hinted_at_once(start_lifter: StartLifter, connect: Connect) -> None:
    lifter = start_lifter(model="human", keypoint_layout="coco17")
    client = connect()
    with stream(client, *in_layout(COCO17)):
        client.wait_for_health(lambda _, v: int(v["messages lifted"]) > 60)
    assert lifter.log.count("roughly with -p field_of_view (65 typical of webcams)") == 1


def test_the_size_of_the_image_acts_on_clouds(start_lifter: StartLifter, connect: Connect) -> None:
    points, confidence = in_layout(COCO17)
    # Without history, so that the same keypoints are lifted alike before and after.
    start_lifter(model="human", keypoint_layout="coco17", **{"history.enabled": False})
    client = connect()
    publisher = client.publisher(PointCloud2)
    expected = unpack(client.exchange(publisher, cloud(points[:1], confidence[:1]))).copy()
    normalised = points / np.array(IMAGE, np.float32)
    with stream(client, normalised, confidence):
        status = client.wait_for_health(lambda _, v: "they are normalised" in v["findings"])
        assert status.level == b"\x01" and "image_width" in status.message
        assert not client.set_parameters(image_width=IMAGE[0])
        client.wait_for_health(lambda _, v: "image_height is 0" in v["findings"])
        assert not client.set_parameters(image_height=IMAGE[1])
        client.wait_for_health(lambda s, v: s.level == b"\x00" and v["findings"] == "none")
    message = cloud(normalised[:1], confidence[:1])
    # Answers to the stream may still arrive.
    while (after := client.exchange(publisher, message)).header.stamp != message.header.stamp:
        pass
    np.testing.assert_allclose(unpack(after), expected, atol=1e-3)


def test_qos_overrides_act_on_a_remapped_topic(start_lifter: StartLifter, connect: Connect) -> None:
    program = ("-m", "deep_nrsfm_ros.node.lifter", "--ros-args", "-r", "keypoints:=/detector/out")
    overrides = {"/keypoints": {"subscription": {"reliability": "reliable", "depth": 7}}}
    start_lifter(program, qos_overrides=overrides)
    client = connect()
    (info,) = client.wait(
        lambda: client.node.get_subscriptions_info_by_topic("/detector/out"), "the subscription"
    )
    assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE


CAMERA = {
    "model": "human",
    "keypoint_layout": "coco17",
    "field_of_view": 65.2,
    "image_width": IMAGE[0],
    "image_height": IMAGE[1],
}


@pytest.mark.parametrize(
    ("parameters", "source", "mend"),
    [
        ({"gravity.up": [0.0, 1.0, 0.0]}, "gravity.up", "check its sign and its axes"),
        (
            {"target_frame": "base_link", "camera_pose": [0.0, 0.0, 1.4, 0.0, 0.0, 0.0, 1.0]},
            "camera_pose in target_frame base_link",
            "check the quaternion of camera_pose",
        ),
    ],
)
def test_a_wrong_direction_of_gravity_is_said(
    start_lifter: StartLifter,
    connect: Connect,
    parameters: dict[str, Any],
    source: str,
    mend: str,
) -> None:
    lifter = start_lifter(**CAMERA, **parameters)
    client = connect()
    with stream(client, *in_layout(COCO17)):
        status = client.wait_for_health(lambda s, v: "against gravity" in v["findings"])
        assert status.level == b"\x01" and f"that {source} gives: {mend}" in status.message
        assert values(status)["gravity"].endswith(f"in the camera's axes, by {source}")
        lifter.wait_for_log(mend)
        if source == "gravity.up":
            assert not client.set_parameters(gravity__up=[0.0, -1.0, 0.0])
            client.wait_for_health(lambda s, v: v["findings"] == "none" and s.level == b"\x00")


def test_a_keypoint_that_is_wrong_again_and_again_is_named(
    start_lifter: StartLifter, connect: Connect
) -> None:
    start_lifter(**CAMERA)
    client = connect()
    client.wait_for_health(lambda _, v: v["wrong keypoints"] == "none")
    points, confidence = in_layout(COCO17)
    points[np.arange(len(points)) % 4 > 0, COCO17.index("left_wrist")] += 300
    with stream(client, points, confidence):
        status = client.wait_for_health(lambda s, v: "'left_wrist' contradicts" in v["findings"])
        assert status.level == b"\x01" and "where it is left out: check its place" in status.message
        assert values(status)["wrong keypoints"].startswith("left_wrist ")


def test_the_direction_of_a_target_frame_is_shown(
    start_lifter: StartLifter, connect: Connect
) -> None:
    pose = {"target_frame": "base_link", "camera_pose": [0.0, 0.0, 1.4, -0.5, 0.5, -0.5, 0.5]}
    lifter = start_lifter(**CAMERA, **pose)
    client = connect()
    shown = "up is 0.00 -1.00 0.00 in the camera's axes, by camera_pose in target_frame base_link"
    client.wait_for_health(lambda _, v: v["gravity"] == shown)
    lifter.wait_for_log("gravity: up is")


def test_a_height_of_the_camera_that_makes_giants_is_said(
    start_lifter: StartLifter, connect: Connect
) -> None:
    level = {"gravity.up": [0.0, -1.0, 0.0]}
    lifter = start_lifter(**CAMERA, **level, camera_height=2.2)
    client = connect()
    client.wait_for_health(lambda _, v: v["floor"].endswith("assumed size: nobody yet"))
    with stream(client, *in_layout(COCO17)):
        status = client.wait_for_health(lambda s, v: "camera_height is 2.2" in v["findings"])
        assert status.level == b"\x01" and "people on that floor would have a trunk of" in (
            status.message
        )
        assert values(status)["floor"] == (
            "2.2 m below the camera; times the assumed size: object1 1.00"
        )
        lifter.wait_for_log("camera_height is 2.2 and is not used")


def test_a_right_height_of_the_camera_is_shown(start_lifter: StartLifter, connect: Connect) -> None:
    level = {"gravity.up": [0.0, -1.0, 0.0]}
    start_lifter(**CAMERA, **level, camera_height=0.95)
    client = connect()
    with stream(client, *in_layout(COCO17)):
        shown = "times the assumed size: object1 1."
        status = client.wait_for_health(
            lambda _, v: shown in v["floor"] and int(v["messages lifted"]) > 400
        )
        assert values(status)["findings"] == "none"
        bones = values(status)["bones of object1"].split(": ")[1].split(", ")
        trunk = dict(bone.rsplit(" ", 1) for bone in bones)["neck-mid_hip"]
        scale = values(status)["floor"].split("object1 ")[1]
        assert float(trunk) == pytest.approx(0.5 * float(scale), rel=0.05)
    client.wait_for_health(lambda _, v: "bones of object1" not in v)  # nobody is there
