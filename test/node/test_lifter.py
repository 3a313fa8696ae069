# SPDX-License-Identifier: Apache-2.0
"""The lifter as a user meets it: a process of its own, over real DDS."""

from __future__ import annotations

import signal
import time
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import Point32, PolygonStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension

from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN17
from deep_nrsfm_ros.messages.decoding import (
    MULTI_ARRAY,
    POINT_CLOUD,
    POINT_FIELDS,
    POINT_STEP,
    POLYGON,
    pack_points,
)
from test.node.conftest import (
    Client,
    Connect,
    LifterProcess,
    StartLifter,
    lifters,
    own_domain,
    write_models,
)

P = len(HUMAN17)


def pixels(n: int, p: int = P, seed: int = 0) -> np.ndarray:
    """Return keypoints (n, p, 2) somewhere in an image."""
    return np.random.default_rng(seed).uniform(50, 600, (n, p, 2)).astype(np.float32)


def header() -> Header:
    message = Header(frame_id="camera_optical")
    message.stamp.sec, message.stamp.nanosec = 1234, 567
    return message


def cloud(points: np.ndarray, confidence: np.ndarray | None = None) -> PointCloud2:
    n, p, _ = points.shape
    return PointCloud2(
        header=header(),
        height=n,
        width=p,
        fields=[
            PointField(name=name, offset=offset, datatype=PointField.FLOAT32, count=1)
            for name, offset in POINT_FIELDS
        ],
        point_step=POINT_STEP,
        row_step=p * POINT_STEP,
        data=array("B", pack_points(points, np.ones((n, p)) if confidence is None else confidence)),
    )


def multi_array(points: np.ndarray) -> Float32MultiArray:
    message = Float32MultiArray(data=array("f", points.astype(np.float32).ravel()))
    message.layout.dim = [MultiArrayDimension(size=size) for size in points.shape]
    return message


def polygon(points: np.ndarray) -> PolygonStamped:
    message = PolygonStamped(header=header())
    message.polygon.points = [Point32(x=x, y=y, z=1.0) for x, y in points[0].tolist()]
    return message


def unpack(message: PointCloud2) -> np.ndarray:
    """Return (n, p, 4): x, y, z, confidence."""
    assert [(f.name, f.offset, f.datatype) for f in message.fields] == [
        (name, offset, PointField.FLOAT32) for name, offset in POINT_FIELDS
    ]
    assert message.row_step == message.width * message.point_step
    return np.frombuffer(message.data, np.float32).reshape(message.height, message.width, 4)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LifterProcess, Client]]:
    """Start a lifter with default parameters and its client, once for all tests of this file."""
    folder = tmp_path_factory.mktemp("running")
    with own_domain() as number, lifters(write_models(folder / "models"), folder) as start:
        lifter, client = start(), Client(number)
        yield lifter, client
        client.close()


@pytest.fixture
def client(running: tuple[LifterProcess, Client]) -> Iterator[Client]:
    """Return a client of the shared lifter. A test that sets parameters sets them back.

    The lifter has answered all messages of the tests before, and the client has heard nothing.
    """
    lifter, client = running
    assert lifter.process.poll() is None, lifter.log
    publisher, message = client.publisher(PointCloud2), cloud(pixels(1))
    answers, sent = client.heard["/lifter/points"], [0.0]

    def answered() -> bool:
        if time.monotonic() - sent[0] > 0.5:  # best effort may lose a message
            sent[0] = time.monotonic()
            message.header.stamp.sec += 1
            publisher.publish(message)
        return bool(answers) and answers[-1].header.stamp == message.header.stamp

    client.wait(answered, "the answer to the last message")
    client.destroy_publishers()
    for heard in client.heard.values():
        heard.clear()
    yield client
    client.destroy_publishers()


@pytest.mark.parametrize(
    ("input_type", "message", "n"),
    [
        (POINT_CLOUD, cloud(pixels(2)), 2),
        (MULTI_ARRAY, multi_array(pixels(2)), 2),
        (POLYGON, polygon(pixels(1)), 1),
    ],
    ids=["cloud", "multi_array", "polygon"],
)
def test_keypoints_of_every_type_are_lifted(
    start_lifter: StartLifter, connect: Connect, input_type: str, message: Any, n: int
) -> None:
    lifter = start_lifter(input_type=input_type)
    client = connect()
    points = client.exchange(client.publisher(type(message)), message)
    xyzc = unpack(points)
    assert xyzc.shape == (n, P, 4)
    assert np.isfinite(xyzc).all() and points.is_dense
    np.testing.assert_allclose(xyzc[..., :3].mean(1), 0, atol=1e-4)
    # With full back-projection x and y are the keypoints themselves, up to scale and place.
    for shape, seen in zip(xyzc[..., :2], pixels(n), strict=True):
        seen = seen - seen.mean(0)
        scale = (shape * seen).sum() / (seen * seen).sum()
        np.testing.assert_allclose(shape, scale * seen, atol=1e-3 * np.abs(shape).max())
    rotation = client.wait(lambda: client.heard["/lifter/camera_rotation"], "rotation")[0]
    q = rotation.quaternion
    assert np.linalg.norm([q.x, q.y, q.z, q.w]) == pytest.approx(1)
    if input_type == MULTI_ARRAY:  # it has no header
        assert points.header.frame_id == "" and points.header.stamp.sec > 1234
    else:
        assert points.header == rotation.header == header()
    libraries = Path(f"/proc/{lifter.process.pid}/maps").read_text()
    assert "numpy" in libraries and "torch" not in libraries


def bad_clouds() -> dict[str, PointCloud2]:
    wrong_field, short, strange_type = (cloud(pixels(1)) for _ in range(3))
    wrong_field.fields[0].name = "u"
    short.data = short.data[:-1]
    strange_type.fields[1].datatype = PointField.INT16
    return {
        "too long": cloud(pixels(1, P + 1)),
        "too short": cloud(pixels(1, P - 1)),
        "nothing": PointCloud2(),
        "field missing": wrong_field,
        "data missing": short,
        "wrong datatype": strange_type,
        "all NaN": cloud(np.full((1, P, 2), np.nan, np.float32)),
        "all at zero": cloud(np.zeros((1, P, 2), np.float32)),
        "unsure": cloud(pixels(1), np.full((1, P), 0.01)),
        "too few": cloud(pixels(1), np.arange(P)[None] < 3),
    }


def test_bad_input_is_counted_and_the_next_message_lifted(
    start_lifter: StartLifter, connect: Connect
) -> None:
    reliable = {"reliability": "reliable", "history": "keep_all"}
    lifter = start_lifter(qos_overrides={"/keypoints": {"subscription": reliable}})
    client = connect()
    publisher = client.publisher(PointCloud2)
    bad = bad_clouds()
    expected = unpack(client.exchange(publisher, cloud(pixels(1)))).copy()
    for message in bad.values():
        publisher.publish(message)
        client.heard["/lifter/points"].clear()
        after = client.exchange(publisher, cloud(pixels(1)))
        np.testing.assert_array_equal(unpack(after), expected)
    status = client.wait_for_health(lambda _, v: v["messages rejected"] == str(len(bad)))
    last = {pair.key: pair.value for pair in status.values}["last problem"]
    assert "3 detected keypoints" in last
    assert "rejected" in lifter.log


def test_a_detector_that_sees_nobody_is_no_trouble(
    start_lifter: StartLifter, connect: Connect
) -> None:
    start_lifter()
    client = connect()
    publisher = client.publisher(PointCloud2)
    sender = client.node.create_timer(0.1, lambda: publisher.publish(cloud(pixels(0))))
    status = client.wait_for_health(lambda _, v: int(v["messages without objects"]) > 0)
    assert status.level == b"\x00" and "sees no object" in status.message
    client.node.destroy_timer(sender)
    assert not client.heard["/lifter/points"]
    assert unpack(client.exchange(publisher, cloud(pixels(1)))).shape == (1, P, 4)


def test_nothing_but_bad_input_is_an_error_and_silence_a_warning(client: Client) -> None:
    publisher = client.publisher(PointCloud2)
    sender = client.node.create_timer(0.1, lambda: publisher.publish(cloud(pixels(1, 5))))
    status = client.wait_for_health(lambda status, _: status.level == b"\x02")
    assert "5 keypoints" in status.message and "17" in status.message
    client.node.destroy_timer(sender)
    status = client.wait_for_health(lambda status, _: status.level == b"\x01")
    assert "no keypoints for" in status.message
    client.exchange(publisher, cloud(pixels(1)))
    sender = client.node.create_timer(0.1, lambda: publisher.publish(cloud(pixels(1))))
    client.wait_for_health(lambda status, v: v["model"] == "person" and float(v["rate [Hz]"]) > 0)
    client.node.destroy_timer(sender)


def test_an_object_with_too_few_keypoints_is_nan_beside_the_others(client: Client) -> None:
    confidence = np.ones((2, P))
    confidence[0, 3:] = 0
    publisher = client.publisher(PointCloud2)
    points = client.exchange(publisher, cloud(pixels(2), confidence))
    xyzc = unpack(points)
    assert np.isnan(xyzc[0, :, :3]).all() and (xyzc[0, :, 3] == 0).all()
    assert np.isfinite(xyzc[1]).all() and not points.is_dense


def test_markers_come_when_someone_listens(client: Client) -> None:
    publisher = client.publisher(PointCloud2)
    client.exchange(publisher, cloud(pixels(2)))
    client.listen_to_markers()
    client.wait(lambda: client.node.count_publishers("/lifter/markers"), "markers' publisher")
    heard = client.heard["/lifter/markers"]

    def sent_and_heard() -> Any:
        client.exchange(publisher, cloud(pixels(2)))
        return heard

    markers = client.wait(sent_and_heard, "markers")[0].markers
    assert [m.id for m in markers] == [0, 0, 1, 1]
    assert {m.ns for m in markers} == {"bones", "joints"}
    assert all(m.header == header() for m in markers)
    # More than the least where the messages of earlier tests gave this lifter a longer period.
    assert all(m.lifetime.sec + 1e-9 * m.lifetime.nanosec >= 0.3 for m in markers)
    assert [len(m.points) for m in markers] == [2 * len(HUMAN17.edges), P] * 2
    assert all(m.scale.x > 0 for m in markers)


def test_points_without_a_frame_are_warned_of(
    running: tuple[LifterProcess, Client], client: Client
) -> None:
    lifter, _ = running
    message = cloud(pixels(1))
    message.header.frame_id = ""
    publisher = client.publisher(PointCloud2)
    sender = client.node.create_timer(0.1, lambda: publisher.publish(message))
    client.wait_for_health(lambda status, _: "have no frame_id" in status.message)
    client.node.destroy_timer(sender)
    lifter.wait_for_log("set frame_id to the camera's optical frame")


def test_smoothing_follows_slower_and_fills_a_gap(
    start_lifter: StartLifter, connect: Connect
) -> None:
    start_lifter(**{"smoothing.enabled": True, "smoothing.max_gap": 5.0})
    client = connect()
    publisher = client.publisher(PointCloud2)
    here, there = (cloud(pixels(1, seed=seed)) for seed in (0, 1))

    def answer(message: PointCloud2, seconds: int) -> np.ndarray:
        """Return the first answer to the message; a repetition would pass as it is lifted."""
        message.header.stamp.sec = seconds
        client.exchange(publisher, message)
        answers = client.heard["/lifter/points"]

        def found() -> list[PointCloud2]:
            return [m for m in answers if m.header.stamp.sec == seconds]

        return unpack(client.wait(found, "that answer")[0]).copy()

    first = answer(here, 100)
    held = answer(cloud(pixels(0)), 101)
    np.testing.assert_array_equal(held[..., :3], first[..., :3])
    np.testing.assert_allclose(held[..., 3], 0.8 * first[..., 3], rtol=1e-4)
    assert client.set_parameters(smoothing__min_cutoff=0.001, smoothing__beta=0) == ""
    assert "at least 0" in client.set_parameters(smoothing__max_gap=-1)
    alone = answer(here, 200)
    np.testing.assert_allclose(alone, first, rtol=1e-4)  # what was known is forgotten
    smoothed = answer(there, 201)
    assert np.abs(smoothed - alone)[..., :3].max() < 0.05 * np.abs(alone[..., :3]).max()


def test_a_parameter_without_effect_is_set_with_a_warning(
    running: tuple[LifterProcess, Client], client: Client
) -> None:
    lifter, _ = running
    assert client.set_parameters(image_width=640) == ""
    lifter.wait_for_log("image_width is 640 and has no effect without image_height: set both")
    assert client.set_parameters(image_height=480) == ""
    assert client.set_parameters(image_width=0, image_height=0) == ""
    assert client.set_parameters(smoothing__beta=2.0) == ""
    lifter.wait_for_log("smoothing.beta is 2 and has no effect, since smoothing.enabled is false")
    assert client.set_parameters(smoothing__beta=4.0, gravity__up=[0.0, -1.0, 0.0]) == ""
    # It is another parameter that makes this one useless.
    assert client.set_parameters(correction="none") == ""
    lifter.wait_for_log("gravity.up is [0.0, -1.0, 0.0] and has no effect, since correction is")
    assert client.set_parameters(reference_length=2.0) == ""
    assert client.set_parameters(gravity__up=[0.0, 0.0, 0.0], correction="bones") == ""
    assert client.set_parameters(reference_length=0.0) == ""
    assert lifter.log.count("has no effect") == 3


def test_parameters_change_what_the_next_message_gets(
    running: tuple[LifterProcess, Client], client: Client
) -> None:
    lifter, _ = running
    publisher = client.publisher(PointCloud2)
    human, cmu = cloud(pixels(1)), cloud(pixels(1, 31))
    first = unpack(client.exchange(publisher, human)).copy()

    assert client.set_parameters(reference_length=3) == ""
    np.testing.assert_allclose(
        unpack(client.exchange(publisher, human))[..., :3],
        6 * first[..., :3],  # of people it is 0.5 m by default
        rtol=1e-4,
    )
    for refused, reason in {
        "broken": "damaged",
        "nowhere": "joints, person",
        "/etc/passwd": "outside of bags_dir",
    }.items():
        assert reason in client.set_parameters(model=refused)
    assert "share" in client.set_parameters(model="joints", keypoint_layout="coco17")
    assert "name a preset" in client.set_parameters(keypoint_layout="martian")
    assert "read-only" in client.set_parameters(models_dir="/tmp")
    assert "read-only" in client.set_parameters(input_type=POLYGON)
    assert "at most 1" in client.set_parameters(min_confidence=2)
    refusal = client.set_parameters(min_visible=40)
    assert "min_visible is 40, but model" in refusal and "set it to at most 15" in refusal
    refusal = client.set_parameters(gravity__up=[0.0, float("nan"), 0.0])
    assert "gravity.up is [0.0, nan, 0.0]; it must be three finite numbers" in refusal
    assert unpack(client.exchange(publisher, human)).shape == (1, P, 4)

    assert client.set_parameters(model="joints") == ""
    assert unpack(client.exchange(publisher, cmu)).shape == (1, 31, 4)
    client.wait_for_health(lambda _, v: v["model"] == "joints")
    assert client.set_parameters(model="person", keypoint_layout="coco17") == ""
    coco = unpack(client.exchange(publisher, cloud(pixels(1))))
    # A detector without toes: the model guesses them, with less confidence.
    certain = coco[0, :, 3]
    toe = HUMAN17.index("left_big_toe")
    assert 0 < certain[toe] < certain[HUMAN17.index("left_hip")]
    assert len(COCO17) == P  # the same number in another order
    assert lifter.process.poll() is None
    assert client.set_parameters(keypoint_layout="model", reference_length=0.0) == ""


def test_a_model_is_changed_and_changed_back_by_one_parameter(client: Client) -> None:
    publisher = client.publisher(PointCloud2)
    human, cmu = cloud(pixels(1)), cloud(pixels(1, 31))
    first = unpack(client.exchange(publisher, human)).copy()
    for _ in range(2):
        assert client.set_parameters(model="joints") == ""
        assert unpack(client.exchange(publisher, cmu)).shape == (1, 31, 4)
        reason = client.set_parameters(model="nobody")
        assert "no model 'nobody'; there are" in reason and "person" in reason
        assert "damaged" in client.set_parameters(model="broken")
        client.wait_for_health(lambda _, v: v["model"] == "joints")
        assert unpack(client.exchange(publisher, cmu)).shape == (1, 31, 4)
        assert client.set_parameters(model="person") == ""
        np.testing.assert_array_equal(unpack(client.exchange(publisher, human)), first)


def test_a_refusal_of_model_or_layout_says_how_to_exchange_both(client: Client) -> None:
    # `ros2 param set` sets one parameter at a time: neither comes first.
    remedy = "set keypoint_layout to 'model' first, then model"
    assert client.set_parameters(keypoint_layout="coco17") == ""
    assert remedy in client.set_parameters(model="joints")
    assert remedy in client.set_parameters(keypoint_layout="hand21")
    assert remedy not in client.set_parameters(model="joints", keypoint_layout="coco17")
    assert client.set_parameters(keypoint_layout="model") == ""
    assert client.set_parameters(model="joints") == ""
    assert client.set_parameters(keypoint_layout="cmu31") == ""
    assert client.set_parameters(keypoint_layout="model") == ""
    assert client.set_parameters(model="person") == ""


def test_the_detectors_order_may_come_from_a_layout_file(
    start_lifter: StartLifter, connect: Connect, tmp_path: Path
) -> None:
    # The model's own keypoints backwards, and one that it does not know.
    path = tmp_path / "backwards.yaml"
    names = [*reversed(HUMAN17.keypoints), "hat"]
    path.write_text(yaml.safe_dump({"name": "backwards", "keypoints": names}))
    start_lifter(keypoint_layout=str(path))
    client = connect()
    publisher = client.publisher(PointCloud2)
    points = np.concatenate([pixels(1)[:, ::-1], pixels(1, 1)], 1)
    backwards = unpack(client.exchange(publisher, cloud(points))).copy()
    path.unlink()  # read at the start, and not again
    assert client.set_parameters(min_visible=5) == ""
    np.testing.assert_array_equal(unpack(client.exchange(publisher, cloud(points))), backwards)
    assert "cannot be read" in client.set_parameters(keypoint_layout=str(path))
    path.write_text("name: x\nkeypionts: [a, b, c, d]")
    assert "no field 'keypionts'" in client.set_parameters(keypoint_layout=str(path))
    assert client.set_parameters(keypoint_layout="model") == ""
    own_order = unpack(client.exchange(publisher, cloud(pixels(1))))
    np.testing.assert_allclose(own_order, backwards, atol=1e-4)


def test_parameters_describe_themselves(client: Client) -> None:
    model, share, layout, bags = client.describe_parameters(
        "model", "noise", "keypoint_layout", "train.bags"
    )
    assert all(d.description for d in (model, share, layout, bags))
    assert (share.floating_point_range[0].from_value, share.floating_point_range[0].to_value) == (
        0.0,
        1.0,
    )
    assert "layout file" in layout.description
    assert not model.read_only


def test_a_publisher_that_cannot_be_heard_is_reported_with_the_mend(
    start_lifter: StartLifter, connect: Connect
) -> None:
    lifter = start_lifter(
        qos_overrides={"/keypoints": {"subscription": {"reliability": "reliable"}}}
    )
    client = connect()
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    client.node.create_publisher(PointCloud2, "keypoints", best_effort)
    lifter.wait_for_log("qos_overrides./keypoints.subscription.reliability")


def test_a_publisher_of_another_type_is_reported(
    start_lifter: StartLifter, connect: Connect
) -> None:
    lifter = start_lifter()
    client = connect()
    connect().node.create_publisher(PolygonStamped, "keypoints", 1)
    status = client.wait_for_health(lambda status, _: status.level == b"\x02")
    assert POLYGON in status.message and POINT_CLOUD in status.message
    lifter.wait_for_log("another input_type")
    publisher = client.publisher(PointCloud2)
    sender = client.node.create_timer(0.1, lambda: publisher.publish(cloud(pixels(1))))
    client.wait_for_health(lambda status, _: "carries" not in status.message)
    client.node.destroy_timer(sender)


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"model": "nowhere"}, "there are broken, "),
        ({"model": "broken"}, "damaged"),
        ({"min_confidence": 7}, "min_confidence is 7"),
    ],
)
def test_a_lifter_that_cannot_start_says_why(
    start_lifter: StartLifter, parameters: dict[str, Any], reason: str
) -> None:
    lifter = start_lifter(listens=False, **parameters)
    assert lifter.process.wait(60) == 1
    assert reason in lifter.log and "Traceback" not in lifter.log


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_cleanly(
    start_lifter: StartLifter, connect: Connect, number: signal.Signals
) -> None:
    lifter = start_lifter()
    client = connect()
    client.exchange(client.publisher(PointCloud2), cloud(pixels(1)))
    lifter.process.send_signal(number)  # a launcher and the terminal both send one
    assert lifter.stop(number, "twice while lifting") == 0, lifter.log
    assert "Traceback" not in lifter.log


def test_it_does_not_start_with_more_visible_keypoints_than_the_model_has(
    start_lifter: StartLifter,
) -> None:
    lifter = start_lifter(listens=False, min_visible=40)
    assert lifter.process.wait(60) == 1
    assert "cannot start: min_visible is 40, but model" in lifter.log
    assert "Traceback" not in lifter.log
