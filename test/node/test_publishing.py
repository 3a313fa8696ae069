"""Messages from arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rclpy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from std_msgs.msg import Header

from deep_nrsfm_ros.node import lifter, publishing
from deep_nrsfm_ros.node.gaps import Gaps
from deep_nrsfm_ros.node.listening import Source
from deep_nrsfm_ros.nrsfm.keypoints import HUMAN17
from deep_nrsfm_ros.nrsfm.lifting import Lifted
from deep_nrsfm_ros.observations.messages import POINT_CLOUD, read
from deep_nrsfm_ros.observations.tracker import Tracker


def lifted(n: int, p: int = 5, seed: int = 0) -> Lifted:
    rng = np.random.default_rng(seed)
    return Lifted(
        rng.standard_normal((n, p, 3)).astype(np.float32),
        np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)),
        np.full(n, 50, np.float32),
        rng.uniform(0, 500, (n, 2)).astype(np.float32),
        np.full(n, 0.1, np.float32),
        rng.uniform(0.2, 1, (n, p)).astype(np.float32),
    )


def test_one_cloud_serves_messages_of_any_size():
    cloud = publishing.PointCloud()
    for n, p in [(1, 5), (3, 5), (3, 4), (1, 5)]:
        wanted = lifted(n, p, seed=n + p)
        message = deserialize_message(
            serialize_message(cloud.fill(Header(frame_id="camera"), wanted)), PointCloud2
        )
        assert message.header.frame_id == "camera" and message.is_dense
        values = np.frombuffer(message.data, "<f4").reshape(n, p, 4)
        np.testing.assert_array_equal(values[..., :3], wanted.shapes)
        np.testing.assert_array_equal(values[..., 3], wanted.confidence)
        points, confidence, _ = read(message, POINT_CLOUD, p)
        np.testing.assert_array_equal(points, wanted.shapes[..., :2])
        np.testing.assert_array_equal(confidence, wanted.confidence)


def test_a_cloud_with_nan_is_not_dense():
    part = lifted(2)
    part.residual[1] = np.nan
    assert not publishing.PointCloud().fill(Header(), part).is_dense


def test_objects_are_named_and_turned_row_by_row():
    both = lifted(2)
    both.rotations[0] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    both.rotations[1] = np.nan
    sent = publishing.objects(Header(frame_id="camera"), both, ("anna", ""))
    message = deserialize_message(serialize_message(sent), MultiDOFJointState)
    assert message.header.frame_id == "camera" and message.joint_names == ["anna", ""]
    first, second = (transform.rotation for transform in message.transforms)
    assert first == publishing.camera_rotation(Header(), both.rotations[0]).quaternion
    assert np.isnan([second.x, second.y, second.z, second.w]).all()
    assert message.transforms[0].translation.x == 0


def test_the_rotation_turns_the_object_into_the_camera():
    # A quarter turn about z: the object's x axis comes to lie on the camera's y axis.
    R = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    q = publishing.camera_rotation(Header(), R).quaternion
    assert (q.x, q.y, q.z, q.w) == pytest.approx((0, 0, 0.5**0.5, 0.5**0.5))


def test_markers_draw_edges_and_put_objects_side_by_side():
    part = lifted(3)
    part.residual[1] = np.nan
    markers = publishing.markers(Header(frame_id="camera"), part, [(0, 1), (1, 4)]).markers
    assert len(markers) == 4  # bones and joints of two objects; the third is NaN
    for i, marker in zip((0, 0, 2, 2), markers, strict=True):
        place = (part.translation[i] - part.translation[0]) / 50
        position = marker.pose.position
        assert (position.x, position.y, position.z) == pytest.approx((*place, 0), rel=1e-5)
    ends = [(q.x, q.y, q.z) for q in markers[0].points]
    np.testing.assert_allclose(ends, part.shapes[0][[0, 1, 1, 4]], rtol=1e-6)


def test_markers_are_not_made_when_nobody_listens(
    domain: int, models: Path, monkeypatch: pytest.MonkeyPatch
):
    made: list[object] = []
    monkeypatch.setattr(publishing, "markers", lambda *arguments: made.append(arguments))
    settings = ["-p", "model:=person", "-p", f"models_dir:={models}"]
    rclpy.init(args=["--ros-args", *settings], domain_id=domain)
    try:
        node = lifter.LifterNode()
        heard: list[PointCloud2] = []
        monkeypatch.setattr(node._points, "publish", heard.append)
        node._lift(
            Source("/keypoints", POINT_CLOUD, Tracker(), Gaps()),
            publishing.PointCloud().fill(Header(), lifted(1, len(HUMAN17))),
        )
        assert heard and not made
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
