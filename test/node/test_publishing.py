# SPDX-License-Identifier: Apache-2.0
"""Messages from arrays."""

from __future__ import annotations

import time
from array import array
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import Quaternion, QuaternionStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import MultiDOFJointState, PointCloud2, PointField
from visualization_msgs.msg import Marker, MarkerArray

from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.decoding import POINT_CLOUD, read_observation
from deep_nrsfm_ros.messages.decoding import POINT_FIELDS as FIELDS
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.messages.stamps import Moment
from deep_nrsfm_ros.node import lifter, publishing
from deep_nrsfm_ros.nrsfm.geometry import quaternion, rotation_from_quaternion
from test.node.conftest import DEADLINE


def lifted(n: int, p: int = 5, seed: int = 0) -> Lifted:
    rng = np.random.default_rng(seed)
    return Lifted(
        rng.standard_normal((n, p, 3)).astype(np.float32),
        np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)),
        np.full(n, 50, np.float32),
        rng.uniform(0, 500, (n, 2)).astype(np.float32),
        np.full(n, 0.1, np.float32),
        rng.uniform(0.2, 1, (n, p)).astype(np.float32),
        np.zeros((n, p), np.bool_),
    )


def read_markers(*arguments: Any, **options: Any) -> list[Marker]:
    """Return the markers that `publishing.markers` makes of the arguments."""
    raw = publishing.markers(*arguments, **options)
    return list(deserialize_message(raw, MarkerArray).markers)


def test_clouds_of_any_size_follow_each_other() -> None:
    for n, p in [(1, 5), (3, 5), (3, 4), (1, 5)]:
        wanted = lifted(n, p, seed=n + p)
        raw = publishing.point_cloud(Header(frame_id="camera"), wanted)
        message = deserialize_message(raw, PointCloud2)
        assert message.header.frame_id == "camera" and message.is_dense
        values = np.frombuffer(message.data, "<f4").reshape(n, p, 4)
        np.testing.assert_array_equal(values[..., :3], wanted.shapes)
        np.testing.assert_array_equal(values[..., 3], wanted.confidence)
        points, confidence, *_ = read_observation(message, POINT_CLOUD, p)
        np.testing.assert_array_equal(points, wanted.shapes[..., :2])
        np.testing.assert_array_equal(confidence, wanted.confidence)


def test_a_cloud_with_nan_is_not_dense() -> None:
    part = lifted(2)
    part.residual[1] = np.nan
    raw = publishing.point_cloud(Header(), part)
    assert not deserialize_message(raw, PointCloud2).is_dense


STORE = get_typestore(Stores.ROS2_JAZZY)


def assert_same_bytes(raw: bytes, message: Any) -> None:
    """Compare with what ROS sends, which leaves to chance what is between numbers."""
    sent, kind = serialize_message(message), type(message).__name__
    kind = f"{type(message).__module__.split('.')[0]}/msg/{kind}"
    tidied = [STORE.serialize_cdr(STORE.deserialize_cdr(r, kind), kind) for r in (raw, sent)]
    assert bytes(tidied[0]) == bytes(tidied[1]) and len(raw) == len(sent)


texts = st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=9)
headers = st.builds(Header, st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1), texts)


@settings(deadline=None)
@given(sent=st.lists(st.tuples(headers, st.integers(1, 3), st.integers(1, 5)), max_size=4))
def test_what_is_serialised_is_what_ros_would_send(sent: list[tuple[Header, int, int]]) -> None:
    for header, n, p in sent:  # one after the other: what came before must leave no trace
        wanted = lifted(n, p, seed=n + 7 * p)
        wanted.residual[0] = (np.nan, 0.1)[p % 2]
        values = np.concatenate([wanted.shapes, wanted.confidence[..., None]], -1)
        message = PointCloud2(header=publishing.to_header(header), height=n, width=p)
        message.fields = [PointField(name=f, offset=o, datatype=7, count=1) for f, o in FIELDS]
        message.point_step, message.row_step = 16, 16 * p
        message.data = array("B", values.astype("<f4").tobytes())
        message.is_dense = p % 2 == 1
        assert_same_bytes(publishing.point_cloud(header, wanted), message)
        turned = QuaternionStamped(header=message.header)
        R = rotation_from_quaternion(np.array([n, p, -1, 2.0])).astype(np.float32)
        x, y, z, w = quaternion(R).tolist()
        turned.quaternion = Quaternion(x=x, y=y, z=z, w=w)
        assert_same_bytes(publishing.camera_rotation(header, R), turned)


def test_objects_are_named_and_turned_row_by_row() -> None:
    both = lifted(2)
    both.rotations[0] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    both.rotations[1] = np.nan
    raw = publishing.objects(Header(frame_id="camera"), both, ("anna", ""))
    message = deserialize_message(raw, MultiDOFJointState)
    assert message.header.frame_id == "camera" and message.joint_names == ["anna", ""]
    first, second = (transform.rotation for transform in message.transforms)
    raw = publishing.camera_rotation(Header(), both.rotations[0])
    assert first == deserialize_message(raw, QuaternionStamped).quaternion
    assert np.isnan([second.x, second.y, second.z, second.w]).all()
    assert message.transforms[0].translation.x == 0


def test_the_rotation_turns_the_object_into_the_camera() -> None:
    # A quarter turn about z: the object's x axis comes to lie on the camera's y axis.
    R = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    raw = publishing.camera_rotation(Header(), R)
    q = deserialize_message(raw, QuaternionStamped).quaternion
    assert (q.x, q.y, q.z, q.w) == pytest.approx((0, 0, 0.5**0.5, 0.5**0.5))


def test_markers_draw_edges_and_put_objects_side_by_side() -> None:
    part = lifted(3)
    part.residual[1] = np.nan
    markers = read_markers(Header(frame_id="camera"), part, [(0, 1), (1, 4)])
    assert len(markers) == 4  # bones and joints of two objects; the third is NaN
    for i, marker in zip((0, 0, 2, 2), markers, strict=True):
        place = (part.translation[i] - part.translation[0]) / 50
        position = marker.pose.position
        assert (position.x, position.y, position.z) == pytest.approx((*place, 0), rel=1e-5)
    ends = [(q.x, q.y, q.z) for q in markers[0].points]
    np.testing.assert_allclose(ends, part.shapes[0][[0, 1, 1, 4]], rtol=1e-6)


@pytest.mark.parametrize(("rate", "lifetime"), [(1, 3.0), (5, 0.6), (30, 0.3), (240, 0.3)])
def test_markers_live_until_the_next_ones(rate: int, lifetime: float) -> None:
    made = read_markers(Header(), lifted(1), [(0, 1)], Moment(0.0, 1 / rate))
    for marker in made:
        seconds = marker.lifetime.sec + 1e-9 * marker.lifetime.nanosec
        assert seconds == pytest.approx(lifetime, abs=1e-6)


def test_markers_of_a_loop_before_are_deleted() -> None:
    moment = Moment(0.0, 0.1, restarted=True)
    first, *others = read_markers(Header(), lifted(1), [(0, 1)], moment)
    assert first.action == Marker.DELETEALL and len(others) == 2
    assert all(marker.action == Marker.ADD for marker in others)


@contextmanager
def lifter_in_process(domain: int, models: Path, *settings: str) -> Iterator[Node]:
    """Yield a node that talks to a `LifterNode` of this process; spinning it spins both."""
    rclpy.init(
        args=["--ros-args", "-p", "model:=person", "-p", f"models_dir:={models}", *settings],
        domain_id=domain,
    )
    try:
        executor = SingleThreadedExecutor()
        node, client = lifter.LifterNode(), Node("client", use_global_arguments=False)
        executor.add_node(node)
        executor.add_node(client)
        yield client
        executor.shutdown()
        node.close()
    finally:
        rclpy.try_shutdown()


def stamp(message: Any) -> int:
    """Return the seconds of the stamp of a message, or of its first marker."""
    first = message.markers[0] if isinstance(message, MarkerArray) else message
    return int(first.header.stamp.sec)


def play(client: Node, topic: str, kind: type, seconds: Iterable[int]) -> list[Any]:
    """Publish a message of one object for each stamp; return what arrives on a topic of the lifter.

    The next message is published when the last one is answered.

    Args:
        client: as `lifter_in_process` yields it.
        topic: of the lifter.
        kind: type of the messages on it.
        seconds: stamps, each of which occurs once.
    """
    heard: list[Any] = []
    client.create_subscription(kind, topic, heard.append, 10)
    publisher = client.create_publisher(PointCloud2, "keypoints", 10)
    assert client.executor
    for second in seconds:
        raw, sent = publishing.point_cloud(Header(second), lifted(1, len(HUMAN17))), 0.0
        end = time.monotonic() + DEADLINE
        while all(stamp(message) != second for message in heard):
            assert time.monotonic() < end, f"no answer to the message of second {second}"
            # The lifter's subscription may lose a message: it is sent again after a while.
            if publisher.get_subscription_count() and time.monotonic() > sent + 0.5:
                publisher.publish(raw)
                sent = time.monotonic()
            client.executor.spin_once(timeout_sec=0.1)
    return heard


@pytest.mark.parametrize("listening", [False, True])
def test_markers_are_made_while_somebody_listens(
    domain: int, models: Path, monkeypatch: pytest.MonkeyPatch, *, listening: bool
) -> None:
    made: list[object] = []
    make = publishing.markers

    def record(*arguments: Any, **options: Any) -> bytes:
        made.append(arguments)
        return make(*arguments, **options)

    monkeypatch.setattr(publishing, "markers", record)
    with lifter_in_process(domain, models) as client:
        if listening:
            assert play(client, "lifter/markers", MarkerArray, (1,))
        else:
            assert play(client, "lifter/points", PointCloud2, (1, 2))
    assert bool(made) == listening


def test_stamps_that_go_back_begin_identities_anew(domain: int, models: Path) -> None:
    with lifter_in_process(domain, models, "-p", "smoothing.enabled:=true") as client:
        heard = play(client, "lifter/objects", MultiDOFJointState, (10, 11, 12, 3, 4))
    identities = {stamp(message): message.joint_names for message in heard}
    names = [identities[second] for second in (10, 11, 12, 3, 4)]
    assert names == [["object1"]] * 3 + [["object2"]] * 2
