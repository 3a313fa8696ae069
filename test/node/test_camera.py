# SPDX-License-Identifier: Apache-2.0
"""With CameraInfo, what the lifter answers is at its place."""

from __future__ import annotations

import importlib.util
from array import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField
from std_msgs.msg import Header

from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.options import FieldOfViewOptions
from deep_nrsfm_ros.messages import serialised
from deep_nrsfm_ros.messages.decoding import POINT_FIELDS, POINT_STEP, pack_points
from deep_nrsfm_ros.node.body_messages import FrameMessages
from deep_nrsfm_ros.node.camera import Camera, CameraOptions
from deep_nrsfm_ros.node.transforms import object_frames
from deep_nrsfm_ros.nrsfm.geometry import quaternion
from test.fixtures.tf_messages import STORE, serialise_frames
from test.node.test_publishing import read_markers

P = len(HUMAN17)
STREAM = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DISTORTION = (-0.2, 0.05, 0.001, -0.001, 0.0)


def info(focal: float = 600.0) -> CameraInfo:
    return CameraInfo(
        header=Header(frame_id="optical"),
        distortion_model="plumb_bob",
        d=DISTORTION,
        k=[focal, 0.0, 320.0, 0.0, focal, 240.0, 0.0, 0.0, 1.0],
    )


def keypoints(frame: str = "") -> tuple[PointCloud2, np.ndarray]:
    pixels = np.random.default_rng(0).uniform(200, 400, (1, P, 2)).astype(np.float32)
    fields = [PointField(name=n, offset=o, datatype=7, count=1) for n, o in POINT_FIELDS]
    message = PointCloud2(
        header=Header(frame_id=frame),
        height=1,
        width=P,
        fields=fields,
        point_step=POINT_STEP,
        row_step=P * POINT_STEP,
        data=array("B", pack_points(pixels, np.ones((1, P)))),
    )
    return message, pixels


def place(message: PointCloud2) -> np.ndarray:
    """Return the mean (3,) of the first object's points."""
    return np.frombuffer(message.data, np.float32).reshape(-1, 4)[:P, :3].mean(0)


@pytest.mark.parametrize("qos", [STREAM, LATCHED], ids=["stream", "latched"])
def test_objects_are_at_their_place_once_camera_info_is_heard(
    start_lifter: Callable[..., Any], connect: Callable[..., Any], qos: QoSProfile
) -> None:
    start_lifter(camera_info="camera_info", reference_length=0.5)
    client = connect()
    publisher = client.publisher(PointCloud2)
    message, pixels = keypoints()
    sender = client.node.create_timer(0.1, lambda: publisher.publish(message))
    client.wait_for_health(
        lambda _, v: "/camera_info has not been received: nobody publishes it" in v["camera"]
    )
    other = client.node.create_publisher(CameraInfo, "/color/camera_info", STREAM)
    client.wait_for_health(lambda _, v: "on /color/camera_info: set camera_info" in v["camera"])
    client.node.destroy_publisher(other)
    assert not client.heard["/lifter/points"]
    client.node.destroy_timer(sender)

    camera = client.node.create_publisher(CameraInfo, "camera_info", qos)
    camera.publish(info())
    resend = client.node.create_timer(0.2, lambda: camera.publish(info()))
    if qos is LATCHED:
        client.node.destroy_timer(resend)  # once is enough
    client.wait_for_health(lambda _, v: v["camera"] == "plumb_bob, focal length 600.0 pixels")
    answer = client.exchange(publisher, message)
    assert answer.header.frame_id == "optical"
    ray = Intrinsics((600.0, 600.0), (320.0, 240.0), DISTORTION).rays(pixels).mean(1)[0]
    x, y, z = place(answer)
    assert z > 0.5 and (x / z, y / z) == pytest.approx(ray, abs=0.05)
    assert client.exchange(publisher, keypoints("other")[0]).header.frame_id == "other"


@pytest.mark.parametrize("reliability", [*ReliabilityPolicy][1:3])
@pytest.mark.parametrize("first", ["lifter", "driver"])
def test_a_driver_has_no_reason_to_warn(
    start_lifter: Callable[..., Any],
    connect: Callable[..., Any],
    reliability: ReliabilityPolicy,
    first: str,
) -> None:
    if first == "lifter":
        start_lifter(camera_info="camera_info")
    client = connect()
    events: list[Any] = []
    camera = client.node.create_publisher(
        CameraInfo,
        "camera_info",
        QoSProfile(depth=5, reliability=reliability),
        event_callbacks=PublisherEventCallbacks(incompatible_qos=events.append),
    )
    client.node.create_timer(0.1, lambda: camera.publish(info()))
    if first == "driver":
        start_lifter(camera_info="camera_info", listens=False)
    client.wait_for_health(lambda _, v: v["camera"] == "plumb_bob, focal length 600.0 pixels")
    client.wait_for_health(lambda *_: True)
    assert camera.get_subscription_count() == 1 and not events


def test_a_latched_publisher_that_comes_and_goes_leaves_no_subscription(
    start_lifter: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    start_lifter(camera_info="camera_info")
    client = connect()
    for focal in (600.0, 700.0):
        camera = client.node.create_publisher(CameraInfo, "camera_info", LATCHED)
        camera.publish(info(focal))
        shown = f"plumb_bob, focal length {focal:.1f} pixels"
        client.wait_for_health(lambda _, v, shown=shown: v["camera"] == shown)
        assert camera.get_subscription_count() == 2
        client.node.destroy_publisher(camera)
        client.wait(lambda: client.node.count_subscribers("/camera_info") == 1, "one subscription")


def test_a_field_of_view_gives_objects_their_place_without_camera_info(
    start_lifter: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    size = {"image_width": 640, "image_height": 480}
    start_lifter(field_of_view=65.0, frame_id="optical", **size)
    client = connect()
    publisher = client.publisher(PointCloud2)
    message, pixels = keypoints()
    focal = 320 / np.tan(np.radians(65) / 2)
    status = f"field of view 65 degrees, focal length {focal:.1f} pixels"
    client.wait_for_health(lambda _, v: v["camera"] == status)
    answer = client.exchange(publisher, message)
    assert answer.header.frame_id == "optical"
    ray = Intrinsics((focal, focal), (320.0, 240.0)).rays(pixels).mean(1)[0]
    x, y, z = place(answer)
    assert z > 0.5 and (x / z, y / z) == pytest.approx(ray, abs=0.05)

    refused = client.set_parameters(image_width=0)
    assert "image_width is 0 and image_height is 480; set image_width" in refused
    refused = client.set_parameters(image_width=1280)  # would halve all places
    assert "would make the image 1280 x 480" in refused and "in one call" in refused
    assert client.set_parameters(image_width=640) == ""
    assert "read-only" in client.set_parameters(field_of_view=90.0)
    assert client.set_parameters(image_width=1280, image_height=960) == ""
    client.wait_for_health(lambda _, v: v["camera"].endswith(f"{2 * focal:.1f} pixels"))
    x, y, _ = place(client.exchange(publisher, message))
    assert x < -0.1 and y < -0.1  # left of the middle and above it


def test_a_camera_that_is_not_calibrated_is_reported(
    start_lifter: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    lifter = start_lifter(camera_info="camera_info")
    client = connect()
    publisher = client.publisher(PointCloud2)
    camera = client.publisher(CameraInfo, topic="camera_info")
    message, _ = keypoints()

    def send() -> None:
        camera.publish(info(focal=0.0))
        publisher.publish(message)

    sender = client.node.create_timer(0.1, send)
    client.wait_for_health(lambda _, v: "the camera is not calibrated" in v["last problem"])
    client.node.destroy_timer(sender)
    assert lifter.process.poll() is None


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"tf_prefix": "person_"}, "tf_prefix is 'person_' without camera_info"),
        ({"rectified": True}, "rectified is true without camera_info"),
        ({"field_of_view": 65.0}, "field_of_view is 65 and needs the size of the image: set image"),
        (
            {"field_of_view": 65.0, "image_height": 480},
            "image_width is 0 and image_height is 480; set image_width",
        ),
        (
            {"field_of_view": 1.13, "image_width": 640, "image_height": 480},
            "1.13 radians are 65 degrees",
        ),
        (
            {"field_of_view": 65.0, "camera_info": "camera_info"},
            "camera_info is 'camera_info', whose CameraInfo says it too: leave field_of_view out",
        ),
        pytest.param(
            {"tf_prefix": "person_", "camera_info": "camera_info"},
            "tf2_msgs is missing; install it (apt install ros-jazzy-tf2-msgs)",
            marks=pytest.mark.skipif(
                importlib.util.find_spec("tf2_msgs") is not None, reason="tf2_msgs is there"
            ),
        ),
    ],
)
def test_options_that_need_others_or_contradict_them_are_refused(
    start_lifter: Callable[..., Any], parameters: dict[str, Any], reason: str
) -> None:
    lifter = start_lifter(listens=False, **parameters)
    assert lifter.process.wait(60) == 1
    assert reason in lifter.log and "Traceback" not in lifter.log


def test_what_needs_a_place_is_content_with_a_field_of_view() -> None:
    node: Any = None
    options = CameraOptions(tf_prefix="person_", camera_height=1.4)
    camera = Camera(node, options, FieldOfViewOptions(90.0), (640, 480))
    assert camera.enabled and camera.size == (640, 480)
    found = camera.require_intrinsics()
    assert found and found.focal == pytest.approx((320, 320))
    with pytest.raises(ValueError, match="tf_prefix is 'person_' without camera_info or field_of"):
        Camera(node, options)


def placed() -> Lifted:
    """Return two objects at their place, and one between them that was not lifted."""
    rng = np.random.default_rng(0)
    shapes = rng.standard_normal((3, 5, 3)).astype(np.float32) + np.array([1, 2, 30], np.float32)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    residual = np.array([0.1, np.nan, 0.1], np.float32)
    shapes[1] = np.nan
    return Lifted(
        shapes,
        np.tile(turn, (3, 1, 1)),
        np.full(3, 20, np.float32),
        np.array([[320, 240], [np.nan, np.nan], [322, 241]], np.float32),
        residual,
        np.ones((3, 5), np.float32),
        np.zeros((3, 5), np.bool_),
    )


def test_frames_lead_from_the_objects_to_the_camera() -> None:
    lifted = placed()
    messages = FrameMessages(SimpleNamespace, serialise_frames)
    header = serialised.Header(frame_id="optical")
    raw = object_frames(messages, header, lifted, ["a", "b", "c"])
    message: Any = STORE.deserialize_cdr(raw, "tf2_msgs/msg/TFMessage")
    found = message.transforms
    assert [frame.child_frame_id for frame in found] == ["a", "c"]
    for frame, i in zip(found, (0, 2), strict=True):
        assert frame.header.frame_id == "optical"
        move, turn = frame.transform.translation, frame.transform.rotation
        assert (move.x, move.y, move.z) == pytest.approx(lifted.shapes[i].mean(0), rel=1e-5)
        expected = quaternion(lifted.rotations[i])
        assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx(expected, abs=1e-6)


def test_markers_stand_where_the_points_are() -> None:
    lifted = placed()
    markers = read_markers(serialised.Header(), lifted, [(0, 1)], positioned=True)
    for marker in markers:
        position = marker.pose.position
        assert (position.x, position.y, position.z) == (0, 0, 0)
    joints = [(q.x, q.y, q.z) for q in markers[1].points]
    np.testing.assert_allclose(joints, lifted.shapes[0], rtol=1e-6)
    assert markers[1].scale.x < 0.2  # of the size of the object, not of its distance
