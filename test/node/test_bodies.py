# SPDX-License-Identifier: Apache-2.0
"""Joints on the wire: messages from poses, and topics of a lifter over DDS."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, TransformStamped, TwistStamped
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import CameraInfo, JointState, MultiDOFJointState, PointCloud2
from std_msgs.msg import String

from deep_nrsfm_ros.body.kinematic_tree import KinematicTree, Pose
from deep_nrsfm_ros.body.motion import BRIDGED, LOST, TRACKED, Motion
from deep_nrsfm_ros.body.urdf import UrdfDrawing, urdf
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node import body_messages
from deep_nrsfm_ros.node.bodies import BodyPublishers, topic_name
from deep_nrsfm_ros.node.publishing import Outbox
from deep_nrsfm_ros.node.serialised_template import (
    STAMP,
    SerialisedTemplate,
    TextTemplate,
    mark,
    text_mark,
)
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_quaternion
from test.fixtures.forked_python import NODE, ForkedPython
from test.fixtures.standing_person import (
    keypoints_of,
    random_angles,
    random_rotations,
    standing_person,
)
from test.fixtures.tf_messages import STORE, serialise_frames
from test.node.conftest import LATCHED, Client, lifters, own_domain, write_models
from test.node.test_camera import info, keypoints

TREE = KinematicTree(HUMAN17)
OFFSETS = TREE.offsets(TREE(standing_person()[None]))[0]
CONFIDENCE = np.array([0.9, 0.2])
EXAMPLES = Path(__file__).parents[2] / "examples"
Q = ("x", "y", "z", "w")


def poses(n: int, seed: int = 0) -> Pose:
    rng = np.random.default_rng(seed)
    angles = random_angles(TREE, n, rng)
    return TREE.forward(rng.normal(size=(n, 3)), random_rotations(n, rng), angles, OFFSETS)


def rotation(q: Any) -> np.ndarray:
    return rotation_from_quaternion(np.array([getattr(q, k) for k in Q]))


def test_joints_are_named_and_placed_object_by_object() -> None:
    names = body_messages.joint_names(("anna", "bert"), TREE.names)
    for seed in range(2):  # the second message is made of the first one's template
        pose = poses(2, seed)
        velocities = np.random.default_rng(seed).normal(size=(2, len(TREE), 3))
        velocities[1, 3] = np.nan
        raw = body_messages.joints(Header(seed, 7, "camera"), names, pose, velocities)
        message = deserialize_message(raw, MultiDOFJointState)
        assert message.header.frame_id == "camera" and message.header.stamp.sec == seed
        assert message.joint_names[0] == "anna/body" and len(message.joint_names) == 2 * len(TREE)
        for i, name in enumerate(names):
            person, joint = divmod(i, len(TREE))
            t, v = message.transforms[i].translation, message.twist[i].linear
            np.testing.assert_allclose([t.x, t.y, t.z], pose.origins[person, joint])
            np.testing.assert_allclose(
                rotation(message.transforms[i].rotation), pose.rotations[person, joint], atol=1e-9
            )
            np.testing.assert_allclose([v.x, v.y, v.z], velocities[person, joint])
            assert name.endswith(TREE.names[joint])


def test_angles_are_those_of_the_pose() -> None:
    names = body_messages.joint_names(("anna",), TREE.angle_names)
    raw = body_messages.angles(Header(1, 2, "camera"), names, poses(1).angles)
    message = deserialize_message(raw, JointState)
    assert list(message.name) == list(names) and not message.velocity
    np.testing.assert_array_equal(message.position, poses(1).angles[0])


def test_position_and_velocity_are_those_of_the_root() -> None:
    for k in range(2):
        point = np.array([k + 1.0, -2.0, 3.5])
        raw = body_messages.position(Header(k, 2, "camera"), point)
        sent = deserialize_message(raw, PointStamped)
        assert (sent.point.x, sent.point.y, sent.point.z) == tuple(point)
        raw = body_messages.velocity(Header(k, 2, "camera"), point)
        twist = deserialize_message(raw, TwistStamped)
        v = twist.twist.linear
        assert (v.x, v.y, v.z) == tuple(point) and twist.twist.angular.z == 0
        assert sent.header == twist.header and sent.header.stamp.sec == k


def frames_on_tf(pose: Pose, names: tuple[str, ...]) -> dict[str, Any]:
    make = body_messages.FrameMessages(SimpleNamespace, serialise_frames)
    raw = make(Header(5, 6, "camera"), pose, TREE.parents, names)
    message: Any = STORE.deserialize_cdr(raw, "tf2_msgs/msg/TFMessage")
    sent = message.transforms
    assert {(t.header.stamp.sec, t.header.stamp.nanosec) for t in sent} == {(5, 6)}
    return {t.child_frame_id: t for t in sent}


def matrix(t: TransformStamped) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = rotation(t.transform.rotation)
    T[:3, 3] = [getattr(t.transform.translation, k) for k in "xyz"]
    return T


def test_frames_on_tf_are_those_of_the_joints() -> None:
    pose = poses(2)
    names = body_messages.joint_names(("p1", "p2"), TREE.names)
    sent = frames_on_tf(pose, names)
    assert sent["p1/body"].header.frame_id == sent["p2/body"].header.frame_id == "camera"
    assert sent["p2/left_elbow"].header.frame_id == "p2/left_shoulder"
    for i, name in enumerate(names):
        T, at = np.eye(4), name
        while at != "camera":
            T, at = matrix(sent[at]) @ T, sent[at].header.frame_id
        person, joint = divmod(i, len(TREE))
        np.testing.assert_allclose(T[:3, :3], pose.rotations[person, joint], atol=1e-9)
        np.testing.assert_allclose(T[:3, 3], pose.origins[person, joint], atol=1e-9)


def test_forward_kinematics_of_the_urdf_agrees_with_the_frames_on_tf() -> None:
    kinpy = pytest.importorskip("kinpy")
    noise = 0.03 * np.random.default_rng(0).standard_normal((17, 3))
    pose = TREE(keypoints_of(TREE, poses(1)) + noise)
    text = urdf(TREE, TREE.offsets(pose)[0])
    sent = frames_on_tf(pose, body_messages.joint_names(("p",), TREE.names))
    angles = dict(zip(TREE.angle_names, pose.angles[0].tolist(), strict=True))
    found = kinpy.build_chain_from_urdf(text).forward_kinematics(angles)
    for name, parent in zip(TREE.names[1:], TREE.parents[1:], strict=True):
        T = np.linalg.inv(found[TREE.names[parent]].matrix()) @ found[name].matrix()
        # A limb that is bent by 20 degrees is nearly in the plane of its hinge, not quite.
        np.testing.assert_allclose(T[:3, 3], matrix(sent[f"p/{name}"])[:3, 3], atol=0.015)
        np.testing.assert_allclose(T[:3, :3], matrix(sent[f"p/{name}"])[:3, :3], atol=1e-4)


def test_tracks_have_a_level_and_the_lost_ones() -> None:
    motion = Motion(np.zeros((2, 1, 3)), (TRACKED, BRIDGED), np.array([3.0, 1.0]), ("carl",))
    raw = body_messages.tracks(Header(4, 5, "camera"), ("anna", "bert"), motion, CONFIDENCE)
    message = deserialize_message(raw, DiagnosticArray)
    assert message.header.frame_id == "camera" and message.header.stamp.sec == 4
    found = [(s.name, s.message, s.level) for s in message.status]
    levels = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.STALE)
    assert found == [*zip(("anna", "bert", "carl"), (TRACKED, BRIDGED, LOST), levels, strict=True)]
    said = [{v.key: v.value for v in s.values} for s in message.status]
    assert said[0] == {"age": "3.000", "confidence": "0.900"} and not said[2]
    later = Motion(np.zeros((1, 1, 3)), (TRACKED,), np.array([12.5]), ())  # a longer text
    raw = body_messages.tracks(Header(), ("anna",), later, CONFIDENCE[:1])
    assert deserialize_message(raw, DiagnosticArray).status[0].values[0].value == "12.500"


def test_a_template_without_a_number_is_refused() -> None:
    with pytest.raises(ValueError, match="1 marked numbers; expected 2"):
        SerialisedTemplate(JointState(position=[mark(0), 3.0]), 2)
    twice = JointState(name=[text_mark(0, 5)] * 2)
    with pytest.raises(ValueError, match="text 0 of a template is missing, or is there twice"):
        TextTemplate(twice, (5,))


def test_identities_become_parts_of_topics() -> None:
    assert [*map(topic_name, ("object1", "7", "a-b", ""))] == ["object1", "id_7", "a_b", "id_"]


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Start a lifter that publishes each object's topics, with a camera; the tests share it."""
    folder = tmp_path_factory.mktemp("bodies")
    with own_domain() as number, lifters(write_models(folder / "models"), folder) as start:
        parameters = {"body.per_object": True, "body.humans": True, "camera_info": "camera_info"}
        start(**parameters)
        client = Client(number)
        camera = client.node.create_publisher(CameraInfo, "camera_info", LATCHED)
        camera.publish(info())
        client.wait_for_health(lambda _, v: v["camera"].startswith("plumb_bob"))
        yield client
        client.close()


def hear(client: Client, topics: dict[str, tuple[Any, Any]]) -> dict[str, list[Any]]:
    """Return what is heard on topics while keypoints are published, once each has a message."""
    for topic, (kind, qos) in topics.items():
        client.listen(topic, kind, qos)
    message, _ = keypoints()
    publisher = client.publisher(PointCloud2)
    second = [100]

    def send() -> None:
        second[0] += 1
        message.header.stamp.sec = second[0] // 10
        message.header.stamp.nanosec = second[0] % 10 * 100_000_000
        publisher.publish(message)

    timer = client.node.create_timer(0.05, send)
    client.wait(lambda: all(client.heard[topic] for topic in topics), f"{[*topics]}")
    client.node.destroy_timer(timer)
    client.destroy_publishers()
    return client.heard


def test_the_lifter_says_names_frames_angles_and_states(client: Client) -> None:
    topics = {
        "/lifter/skeleton": (String, LATCHED),
        "/lifter/joints": (MultiDOFJointState, 10),
        "/lifter/joint_states": (JointState, 10),
        "/lifter/tracks": (DiagnosticArray, 10),
    }
    heard = hear(client, topics)
    names = json.loads(heard["/lifter/skeleton"][0].data)
    assert names["keypoints"] == list(HUMAN17.keypoints) and names["layout"] == "human17"
    assert {"name": "left_elbow", "parent": "left_shoulder"}.items() <= names["joints"][6].items()
    joints, angles = heard["/lifter/joints"][-1], heard["/lifter/joint_states"][-1]
    assert joints.joint_names[0] == "object1/body" and joints.header.frame_id == "optical"
    assert "object1/l_elbow" in angles.name and np.isfinite(angles.position).all()
    (track,) = heard["/lifter/tracks"][-1].status
    assert track.name == "object1"
    x, y, z = (getattr(joints.transforms[0].translation, k) for k in "xyz")
    assert z > 0.5 and abs(x) < z and abs(y) < z


def test_who_is_gone_is_lost_where_the_detector_falls_silent(client: Client) -> None:
    heard = hear(client, {"/lifter/tracks": (DiagnosticArray, 10)})["/lifter/tracks"]
    assert [s.message for s in heard[-1].status][0] in ("new", "tracked")
    before = heard[-1].header.stamp

    def lost() -> dict[int, Any]:
        """Return the messages with the lost object by stamp: other tests subscribe as well."""
        said = [("object1", LOST)]
        found = (m for m in heard if [(s.name, s.message) for s in m.status] == said)
        return {m.header.stamp.sec * 10**9 + m.header.stamp.nanosec: m for m in found}

    client.wait(lambda: len(lost()) > 1, "two messages of the lost object")
    first = lost()[min(lost())]
    assert first.header.frame_id == "optical" and 1 <= first.header.stamp.sec - before.sec <= 3
    assert first.status[0].level == DiagnosticStatus.STALE
    told = time.monotonic()
    client.wait(lambda: time.monotonic() > told + 3, "the end of the second")
    assert len(lost()) <= 4  # told for a second


def test_each_object_has_its_topics(client: Client) -> None:
    own, human = "/lifter/object1", "/humans/bodies/object1"
    topics: dict[str, tuple[Any, Any]] = {
        f"{prefix}/{topic}": (kind, qos)
        for prefix in (own, human)
        for topic, kind, qos in (
            ("joint_states", JointState, 10),
            ("urdf", String, LATCHED),
            ("position", PointStamped, 10),
            ("velocity", TwistStamped, 10),
        )
    }
    heard = hear(client, topics)
    for prefix, suffix in ((own, ""), (human, "_object1")):
        drawing = UrdfDrawing(heard[f"{prefix}/urdf"][-1].data)
        assert drawing.root == f"body{suffix}"
        assert set(heard[f"{prefix}/joint_states"][-1].name) == set(drawing.angle_names)
        assert f"l_elbow{suffix}" in drawing.angle_names
    assert heard[f"{human}/position"][-1].point.z > 0.5


def test_the_example_shows_an_elbow(client: Client, tmp_path: Path) -> None:
    source = (EXAMPLES / "elbow_angle.py").read_text().splitlines()
    assert len([line for line in source if line.strip()]) <= 20
    shown = tmp_path / "shown"
    with shown.open("w") as output:
        process = ForkedPython([EXAMPLES / "elbow_angle.py"], NODE, stdout=output)
        try:
            message, _ = keypoints()
            publisher = client.publisher(PointCloud2)
            timer = client.node.create_timer(0.05, lambda: publisher.publish(message))
            client.wait(lambda: " degrees" in shown.read_text(), "an elbow")
            client.node.destroy_timer(timer)
        finally:
            process.kill()
            process.wait()
    waiting, first, *_ = shown.read_text().splitlines()
    assert waiting == "waiting for joints of the lifter on /lifter/joint_states"
    assert re.match(r"object\d+/l_elbow: +-?\d", first)


def test_the_list_of_bodies_is_that_of_hri_msgs() -> None:
    """By its definition, through rosbags: hri_msgs is not on PyPI."""
    name = "hri_msgs/msg/IdsList"
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("std_msgs/Header header\nstring[] ids", name))
    sent: list[Any] = []
    bodies: Any = object.__new__(BodyPublishers)
    bodies._bodies = {"anna": [], "7": []}
    bodies._ids, bodies._ids_message = SimpleNamespace(publish=sent.append), store.types[name]
    bodies._outbox = Outbox()
    bodies._make_ids(Header(3, 4, "camera"))
    bodies._outbox.send()
    stamp = store.types["builtin_interfaces/msg/Time"](3, 4)
    header = store.types["std_msgs/msg/Header"](stamp, "camera")
    (message,) = sent
    assert (message.header.stamp.sec, message.header.frame_id) == (3, "camera")
    message.header = header  # rclpy's own would be one already
    raw = store.serialize_cdr(message, name)
    read: Any = store.deserialize_cdr(raw, name)
    assert read.ids == ["anna", "id_7"]


def leaves(split: Any) -> set[str]:
    """Return the panels of a layout of Foxglove."""
    return {split} if isinstance(split, str) else leaves(split["first"]) | leaves(split["second"])


def test_the_layout_of_foxglove_shows_what_the_lifter_says() -> None:
    text = (EXAMPLES.parent / "config" / "foxglove.json").read_text()
    layout = json.loads(text)
    names = ("points", "markers", "joints", "joint_states", "tracks", "skeleton")
    assert set(re.findall(r"/lifter/(\w+)", text)) == set(names)
    panels = {"Image", "3D", "Plot", "StateTransitions", "RawMessages"}
    panels |= {"DiagnosticSummary", "DiagnosticStatusPanel"}
    assert {name.partition("!")[0] for name in layout["configById"]} == panels
    assert leaves(layout["layout"]) == set(layout["configById"])
    for path in layout["configById"]["Plot!angles"]["paths"]:
        column = TREE.angle_names.index(path["label"])
        assert path["value"] == f"/lifter/joint_states.position[{column}]"


Make = Callable[..., Any]


def test_frames_of_joints_need_a_prefix_and_tf2(start_lifter: Make) -> None:
    lifter = start_lifter(listens=False, **{"body.frames": True})
    assert lifter.process.wait(60) == 1
    assert "body.frames is true without tf_prefix" in lifter.log


def test_what_padding_holds_is_no_number() -> None:
    message = JointState(name=["abc"], position=[mark(0), mark(1)])
    message.header.stamp = STAMP

    def with_old_memory(given: JointState) -> bytes:
        """Serialise, with a slot of padding that looks like a number between the marks."""
        return serialize_message(given) + np.float64(1.5 * mark(0)).tobytes()

    SerialisedTemplate(message, 2, with_old_memory)
    with pytest.raises(ValueError, match="message has 2 marked numbers; expected 3"):
        SerialisedTemplate(message, 3)
