# SPDX-License-Identifier: Apache-2.0
"""Any detector in: types, topics and identities, over real DDS."""

from __future__ import annotations

from array import array
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Point32, PolygonStamped, Pose, PoseArray
from sensor_msgs.msg import JointState, MultiDOFJointState, PointCloud2, PointField
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker, MarkerArray

from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.messages.decoding import POINT_FIELDS, POINT_STEP, POLYGON, pack_points
from test.node.conftest import Connect, StartLifter

P = len(HUMAN17)
OBJECTS = "/lifter/objects"
NUMBERS = count(1)
FIGURES = """
type: visualization_msgs/MarkerArray
objects: markers
identity: ns
keypoints: points
"""
POSES = """
type: geometry_msgs/PoseArray
keypoints: poses
x: position.x
y: position.y
units: normalised
"""


def pixels(*places: float) -> np.ndarray:
    """Return the same person (n, p, 2) at some places in the image."""
    body = np.random.default_rng(0).uniform(0, 200, (P, 2))
    return np.array([body + [place, 100] for place in places], np.float32)


def cloud(points: np.ndarray) -> PointCloud2:
    n, p, _ = points.shape
    message = PointCloud2(height=n, width=p, point_step=POINT_STEP, row_step=p * POINT_STEP)
    message.fields = [PointField(name=n, offset=o, datatype=7, count=1) for n, o in POINT_FIELDS]
    message.data = array("B", pack_points(points, np.ones((n, p))))
    return message


def polygon(points: np.ndarray) -> PolygonStamped:
    message = PolygonStamped(header=Header(frame_id="camera"))
    message.polygon.points = [Point32(x=x, y=y) for x, y in points[0].tolist()]
    return message


def figures(points: np.ndarray, *names: str) -> MarkerArray:
    return MarkerArray(
        markers=[
            Marker(ns=name, points=[Point(x=x, y=y) for x, y in person])
            for name, person in zip(names, points.tolist(), strict=True)
        ]
    )


def unpack(message: PointCloud2) -> np.ndarray:
    return np.frombuffer(message.data, "<f4").reshape(message.height, message.width, 4)


def exchange(client: Any, publisher: Any, message: Any) -> tuple[np.ndarray, MultiDOFJointState]:
    """Return the points of a message, and the objects that come with them."""
    if OBJECTS not in client.heard:
        client.listen(OBJECTS, MultiDOFJointState)
        client.wait(lambda: client.node.count_publishers(OBJECTS), "objects' publisher")

    stamped = hasattr(message, "header")
    if stamped:
        message.header.stamp.sec = next(NUMBERS)

    def both() -> Any:
        client.exchange(publisher, message)
        # The objects come after their points, and both may be those of an earlier message.
        points = {str(p.header.stamp): p for p in client.heard["/lifter/points"]}
        for objects in reversed(client.heard[OBJECTS]):
            stamp = objects.header.stamp
            if str(stamp) in points and (not stamped or stamp == message.header.stamp):
                return unpack(points[str(stamp)]), objects
        return None

    return client.wait(both, "objects")


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def mapping(folder: Path, text: str) -> str:
    path = folder / "detector.yaml"
    path.write_text(text)
    return str(path)


def test_the_type_is_that_of_the_publisher(start_lifter: StartLifter, connect: Connect) -> None:
    lifter = start_lifter(listens=False, input_type="auto")
    lifter.wait_for_log("waiting for a publisher on /keypoints")
    client = connect()
    client.wait_for_health(lambda _, v: v["subscribed"] == "none yet")
    publisher = client.publisher(PointCloud2)
    lifter.wait_for_log("subscribed to /keypoints (sensor_msgs/PointCloud2)")
    assert unpack(client.exchange(publisher, cloud(pixels(0, 300)))).shape == (2, P, 4)
    client.wait_for_health(lambda _, v: v["subscribed"] == "/keypoints (sensor_msgs/PointCloud2)")
    client.node.destroy_publisher(publisher)
    # Another detector takes its place.
    publisher = client.publisher(PolygonStamped)
    assert unpack(client.exchange(publisher, polygon(pixels(0)))).shape == (1, P, 4)


def test_a_publisher_of_no_known_type_is_reported(
    start_lifter: StartLifter, connect: Connect
) -> None:
    lifter = start_lifter(listens=False, input_type="auto")
    lifter.wait_for_log("waiting for a publisher")
    client = connect()
    text = client.node.create_publisher(String, "keypoints", 1)
    status = client.wait_for_health(lambda status, _: status.level == b"\x02")
    assert "std_msgs/String" in status.message and "field mapping" in status.message
    client.node.destroy_publisher(text)
    publisher = client.publisher(PointCloud2)
    assert unpack(client.exchange(publisher, cloud(pixels(0)))).shape == (1, P, 4)


def test_several_people_of_any_message_with_the_detectors_names(
    start_lifter: StartLifter, connect: Connect, tmp_path: Path
) -> None:
    start_lifter(input_type=mapping(tmp_path, FIGURES))
    client = connect()
    publisher = client.publisher(MarkerArray)
    seen = pixels(0, 300, 600)
    message = figures(seen, "anna", "", "bert")
    message.markers[0].points = []  # left out
    xyzc, objects = exchange(client, publisher, message)
    assert xyzc.shape == (2, P, 4) and np.isfinite(xyzc).all()
    assert objects.joint_names == ["object1", "bert"] and len(objects.transforms) == 2
    reference = unpack(client.exchange(publisher, figures(seen[1:], "", "bert")))
    np.testing.assert_array_equal(xyzc, reference)


def test_parallel_lists_in_any_order_are_read_live_as_from_bags(
    start_lifter: StartLifter, connect: Connect, tmp_path: Path
) -> None:
    joints = "\n".join(
        ["type: sensor_msgs/JointState", "x: position", "y: velocity", "confidence: effort"]
        + ["max_confidence: 100", "keypoint_id: name", f"names: [{', '.join(HUMAN17.keypoints)}]"]
    )
    start_lifter(input_type=mapping(tmp_path, joints))
    client = connect()
    seen = pixels(0)[0].astype(float)
    order = np.random.default_rng(0).permutation(P)
    message = JointState(
        name=[HUMAN17.keypoints[i] for i in order],
        position=seen[order, 0].tolist(),
        velocity=seen[order, 1].tolist(),
        effort=[100.0] * P,
    )
    read = unpack(client.exchange(client.publisher(JointState), message)).copy()
    assert read.shape == (1, P, 4) and np.isfinite(read).all()
    spread = read[0, :, :2] - read[0, :, :2].mean(0)
    shown = seen - seen.mean(0)
    assert np.corrcoef(spread.ravel(), shown.ravel())[0, 1] > 0.9


def test_normalised_keypoints_wait_for_the_size_of_the_image(
    start_lifter: StartLifter, connect: Connect, tmp_path: Path
) -> None:
    start_lifter(input_type=mapping(tmp_path, POSES))
    client = connect()
    publisher = client.publisher(PoseArray)
    message = PoseArray()
    message.poses = [
        Pose(position=Point(x=x / 640, y=y / 480)) for x, y in pixels(0)[0].astype(float).tolist()
    ]
    sender = client.node.create_timer(0.1, lambda: publisher.publish(message))
    status = client.wait_for_health(lambda status, _: status.level == b"\x02")
    assert "set image_width and image_height" in status.message
    client.node.destroy_timer(sender)
    assert client.set_parameters(image_width=640, image_height=480) == ""
    wide, _ = exchange(client, publisher, message)
    assert client.set_parameters(image_width=480) == ""
    square, _ = exchange(client, publisher, message)
    spread = [np.ptp(xyzc[0, :, :2], axis=0) for xyzc in (wide, square)]
    ratio = (spread[0] / spread[0][1]) / (spread[1] / spread[1][1])
    np.testing.assert_allclose(ratio, [640 / 480, 1], rtol=0.05)


def test_names_without_a_detectors_follow_the_place(
    start_lifter: StartLifter, connect: Connect
) -> None:
    start_lifter()
    client = connect()
    publisher = client.publisher(PointCloud2)
    _, objects = exchange(client, publisher, cloud(pixels(0, 600)))
    first, second = objects.joint_names
    assert first != second
    _, objects = exchange(client, publisher, cloud(pixels(610, 10)))
    assert objects.joint_names == [second, first]


def test_bodies_on_topics_that_come_and_go(start_lifter: StartLifter, connect: Connect) -> None:
    lifter = start_lifter(listens=False, input_type=POLYGON, topics=["/humans/bodies/*/skeleton2d"])
    lifter.wait_for_log("waiting for a publisher on /humans/bodies/*/skeleton2d")
    client = connect()
    publishers = {
        name: client.publisher(PolygonStamped, topic=f"/humans/bodies/{name}/skeleton2d")
        for name in ("ab12", "cd34")
    }
    for name, publisher in publishers.items():
        _, objects = exchange(client, publisher, polygon(pixels(0)))
        assert objects.joint_names == [name]
    client.node.destroy_publisher(publishers["ab12"])
    lifter.wait_for_log("unsubscribed from /humans/bodies/ab12/skeleton2d")
    exchange(client, publishers["cd34"], polygon(pixels(0)))


def test_several_topics_are_told_apart(start_lifter: StartLifter, connect: Connect) -> None:
    start_lifter(topics=["left/keypoints", "right/keypoints"])
    client = connect()
    for side in ("left", "right"):
        publisher = client.publisher(PointCloud2, topic=f"{side}/keypoints")
        _, objects = exchange(client, publisher, cloud(pixels(0)))
        assert objects.joint_names == [f"{side}/keypoints"]


def test_a_wildcard_passes_by_what_is_not_meant(
    start_lifter: StartLifter, connect: Connect
) -> None:
    # The lifter's own points are of the same type.
    start_lifter(listens=False, topics=["/*/points"]).wait_for_log("waiting for")
    client = connect()
    client.node.create_publisher(String, "text/points", 1)
    publisher = client.publisher(PointCloud2, topic="cam/points")
    _, objects = exchange(client, publisher, cloud(pixels(0)))
    assert objects.joint_names == ["cam"]
    sender = client.node.create_timer(0.1, lambda: publisher.publish(cloud(pixels(0))))
    status = client.wait_for_health(lambda status, v: float(v["rate [Hz]"]) > 0)
    assert values(status)["subscribed"] == "/cam/points (sensor_msgs/PointCloud2)"
    assert "carries" not in status.message
    client.node.destroy_timer(sender)


def test_names_that_are_no_topics_are_refused(start_lifter: StartLifter) -> None:
    lifter = start_lifter(listens=False, topics=["no topic"])
    assert lifter.process.wait(60) == 1
    assert "cannot start: topics names 'no topic', which is no name" in lifter.log


def test_a_lifter_that_cannot_listen_says_why(start_lifter: StartLifter, tmp_path: Path) -> None:
    for number, (input_type, reason) in enumerate(
        {
            "yolo_msgs/DetectionArray": "need the package yolo_msgs",
            "std_msgs/String": "name one of sensor_msgs/PointCloud2",
            mapping(tmp_path, "type: a/B"): "lacks the field 'keypoints'",
        }.items()
    ):
        lifter = start_lifter(listens=False, input_type=input_type)
        assert lifter.process.wait(60) == 1, number
        assert "cannot start" in lifter.log and reason in lifter.log
        assert "Traceback" not in lifter.log


def test_a_list_of_mixed_numbers_is_explained(start_lifter: StartLifter) -> None:
    """ROS refuses it before the node begins."""
    program = (*("-m", "deep_nrsfm_ros.node.lifter"), "--ros-args")
    parameters = ("-p", "gravity.up:=[0, -0.94, -0.34]", "--")
    lifter = start_lifter((*program, *parameters), listens=False)
    assert lifter.process.wait(60) == 1
    assert "cannot start" in lifter.log and "[0.0, -0.94, -0.34], not [0" in lifter.log
    assert "Traceback" not in lifter.log
