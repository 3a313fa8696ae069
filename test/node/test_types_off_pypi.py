# SPDX-License-Identifier: Apache-2.0
"""Topics of tf2_msgs, hri_msgs and yolo_msgs over DDS: the types by name, the bytes by rosbags."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import CameraInfo, PointCloud2

from deep_nrsfm_ros.node import detections_3d, subscriptions
from deep_nrsfm_ros.node.body_messages import FrameMessages
from test.fixtures.detector_messages import Detectors
from test.fixtures.tf_messages import serialise_frames
from test.fixtures.type_supports import install_type
from test.messages.test_detections_3d import KIND, people
from test.node.conftest import DEADLINE, LATCHED
from test.node.test_camera import info, keypoints
from test.node.test_publishing import lifter_in_process

IDS = "hri_msgs/msg/IdsList"
STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(get_types_from_msg("std_msgs/Header header\nstring[] ids", IDS))


def settings(*words: str) -> list[str]:
    return [part for word in ("camera_info:=camera_info", *words) for part in ("-p", word)]


def hear(client: Node, message: Any, kind: Any, topics: dict[str, Any]) -> dict[str, list[bytes]]:
    """Send a message and the camera until each topic has said two things; return them."""
    heard: dict[str, list[bytes]] = {topic: [] for topic in topics}
    for topic, type_ in topics.items():
        qos = LATCHED if topic.endswith("tracked") else 10
        client.create_subscription(type_, topic, heard[topic].append, qos, raw=True)
    camera = client.create_publisher(CameraInfo, "camera_info", 10)
    publisher = client.create_publisher(kind, "keypoints", 10)
    end, sent = time.monotonic() + DEADLINE, 0.0
    assert client.executor
    while min(map(len, heard.values())) < 2:
        assert time.monotonic() < end, f"only {heard}"
        if time.monotonic() > sent + 0.3:
            camera.publish(info())
            publisher.publish(message)
            sent = time.monotonic()
        client.executor.spin_once(timeout_sec=0.1)
    return heard


def test_frames_and_bodies_are_on_the_topics_of_tf2_and_ros4hri(
    domain: int, models: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def serialised_ids(header: Any, ids: list[str]) -> bytes:
        kinds, stamp = STORE.types, header.stamp
        stamped = kinds["std_msgs/msg/Header"](
            kinds["builtin_interfaces/msg/Time"](stamp.sec, stamp.nanosec), header.frame_id
        )
        return bytes(STORE.serialize_cdr(kinds[IDS](stamped, ids), IDS))

    monkeypatch.setattr(FrameMessages.__init__, "__defaults__", (serialise_frames,))
    topics = {
        "/tf": install_type(monkeypatch, "tf2_msgs/TFMessage", SimpleNamespace),
        "/humans/bodies/tracked": install_type(monkeypatch, "hri_msgs/IdsList", serialised_ids),
    }
    words = settings("body.humans:=true", "body.frames:=true", "tf_prefix:=person_")
    with lifter_in_process(domain, models, *words) as client:
        heard = hear(client, keypoints()[0], PointCloud2, topics)
        types = dict(client.get_topic_names_and_types())
    assert types["/tf"] == ["tf2_msgs/msg/TFMessage"] and types[[*topics][1]] == [IDS]
    tracked: Any = STORE.deserialize_cdr(heard["/humans/bodies/tracked"][-1], IDS)
    assert (tracked.ids, tracked.header.frame_id) == (["object1"], "optical")
    read = partial(STORE.deserialize_cdr, typename="tf2_msgs/msg/TFMessage")
    messages: list[Any] = [*map(read, heard["/tf"])]
    parents = {t.child_frame_id: t.header.frame_id for m in messages for t in m.transforms}
    assert parents["person_object1/left_elbow"] == "person_object1/left_shoulder"
    assert parents["person_object1"] == parents["body_object1"] == "optical"


def test_detections_of_yolo_ros_come_back_with_3d_keypoints(
    domain: int,
    models: Path,
    recorded: Detectors,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    store, publish = recorded.store, Publisher.publish

    def send(self: Publisher, message: Any) -> None:
        own = getattr(message, "__msgtype__", "")
        publish(self, bytes(store.serialize_cdr(message, own)) if own else message)

    def decoder(name: str) -> Callable[[bytes], Any]:
        return partial(store.deserialize_cdr, typename=name.replace("/", "/msg/"))

    monkeypatch.setattr(Publisher, "publish", send)
    for module in (detections_3d, subscriptions):
        monkeypatch.setattr(module, "decoder", decoder)
    install_type(
        monkeypatch, "yolo_msgs/KeyPoint3D", partial(recorded.make, "yolo_msgs/KeyPoint3D")
    )
    kind = install_type(monkeypatch, "yolo_msgs/DetectionArray", SimpleNamespace)
    topics = {"/lifter/detections_3d": kind}
    sent = recorded.detections(people())
    with lifter_in_process(domain, models, *settings()) as client:
        heard = hear(client, sent, kind, topics)
    message: Any = store.deserialize_cdr(heard["/lifter/detections_3d"][-1], KIND)
    assert [detection.id for detection in message.detections] == ["7", "8", "9"]
    for detection in message.detections:
        points = detection.keypoints3d.data
        assert len(points) >= 12 and detection.keypoints3d.frame_id
        assert all(np.isfinite(point.point.z) for point in points)
