# SPDX-License-Identifier: Apache-2.0
"""The lifter through what goes wrong around it: signals, kills, files, clocks, other nodes."""

from __future__ import annotations

import os
import random
import signal
import time
from array import array
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float32MultiArray

from deep_nrsfm_ros.messages.decoding import POINT_FIELDS, POINT_STEP, pack_points
from test.fixtures.forked_python import children_of
from test.node.conftest import Connect, StartLifter

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = (str(ROOT / "scripts" / "lifter"),)
STAND_IN = (str(Path(__file__).with_name("lifter_with_stand_in_training.py")),)
P = 17
MANY = int(os.environ.get("FAULTS", "4"))
RELIABLE = {"/keypoints": {"subscription": {"reliability": "reliable", "history": "keep_all"}}}
MULTI_ARRAY = {"input_type": "std_msgs/Float32MultiArray"}


def cloud(second: int = 0) -> PointCloud2:
    """Return keypoints, always the same, with a stamp."""
    points = np.random.default_rng(0).uniform(50, 600, (1, P, 2)).astype(np.float32)
    message = PointCloud2(height=1, width=P, point_step=POINT_STEP, row_step=P * POINT_STEP)
    message.header.stamp.sec = second
    message.fields = [
        PointField(name=name, offset=offset, datatype=PointField.FLOAT32, count=1)
        for name, offset in POINT_FIELDS
    ]
    message.data = array("B", pack_points(points, np.ones((1, P))))
    return message


def state_of(pid: int) -> str:
    """Return "" for a process that is gone, or its state, "Z" for a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return ""


def wait_until(condition: Any, what: str) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.005)


def catches_signals(pid: int) -> bool:
    """Tell whether the process is past the first lines of scripts/lifter."""
    caught = next(
        int(line.split()[1], 16)
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("SigCgt")
    )
    return bool(caught & 1 << (signal.SIGTERM - 1))


def test_a_signal_at_any_moment_of_the_start_ends_it_with_code_0(start_lifter: StartLifter) -> None:
    moments = random.Random(0)
    for i in range(MANY):
        lifter = start_lifter(SCRIPT, listens=False, fork=False)
        wait_until(lambda pid=lifter.process.pid: catches_signals(pid), "the first lines")
        # In CPU time, so that a busy machine moves no moment.
        moment = lifter.cpu_seconds + (moments.uniform(0, 1.5) if i else 0)
        wait_until(
            lambda one=lifter, at=moment: one.cpu_seconds >= at or "subscribed to" in one.log,
            "the moment",
        )
        code = lifter.stop((signal.SIGINT, signal.SIGTERM)[i % 2], "during the start")
        assert code == 0 and "Traceback" not in lifter.log, (code, lifter.log)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_as_a_training_starts_leaves_no_process(
    start_lifter: StartLifter, connect: Connect, models: Path, number: signal.Signals
) -> None:
    bag = str(models / "joints")
    lifter = start_lifter(STAND_IN, train={"bags": [bag], "name": "wait"})
    client = connect()
    assert client.call("/lifter/train").success
    children = children_of(lifter.process.pid)
    assert lifter.stop(number, "as a training starts") == 0 and children
    wait_until(lambda: not any(map(state_of, children)), "the end of the training")


def test_a_training_that_ended_leaves_no_zombie(
    start_lifter: StartLifter, connect: Connect, models: Path
) -> None:
    bag = str(models / "joints")
    lifter = start_lifter(STAND_IN, train={"bags": [bag], "name": "crash"})
    client = connect()
    for _ in range(2):
        client.heard["/lifter/training_status"].clear()
        assert client.call("/lifter/train").success
        client.wait_for_training("failed")
        assert children_of(lifter.process.pid) == []


def test_a_lifter_that_is_killed_and_started_again_is_heard_again(
    start_lifter: StartLifter, connect: Connect
) -> None:
    first = start_lifter()
    client = connect()
    publisher = client.publisher(PointCloud2)
    before = client.exchange(publisher, cloud())
    for _ in range(2):
        first.process.kill()
        first.process.wait()
        client.heard["/lifter/points"].clear()
        first = start_lifter()
        assert client.exchange(publisher, cloud()).data == before.data


def test_what_becomes_of_the_model_file_does_not_matter(
    start_lifter: StartLifter, connect: Connect, models: Path
) -> None:
    lifter = start_lifter(qos_overrides=RELIABLE)
    client = connect()
    publisher, file = client.publisher(PointCloud2), models / "person.safetensors"
    before, whole = client.exchange(publisher, cloud()).data, file.read_bytes()
    other = (models / "joints.safetensors").read_bytes()
    for content, refusal in [
        (whole[:1000], "damaged"),
        (b"", "is empty"),
        (None, "no model 'person'"),
        (other, ""),
        (whole, ""),
    ]:
        if content is None:
            file.unlink()
        else:
            file.write_bytes(content)
        assert client.exchange(publisher, cloud()).data == before
        if content != other:
            reason = client.set_parameters(model="person")
            assert refusal in reason and bool(refusal) == bool(reason)
    assert lifter.process.poll() is None


def test_parameter_changes_at_full_rate_cost_no_message(
    start_lifter: StartLifter, connect: Connect
) -> None:
    start_lifter(qos_overrides=RELIABLE)
    client = connect()
    publisher = client.publisher(PointCloud2)
    client.exchange(publisher, cloud(1))
    heard = client.heard["/lifter/points"]
    heard.clear()
    wishes: list[tuple[str, Any]] = [
        ("model", "joints"),
        ("noise", 0.5),
        ("model", "broken"),
        ("test_time_rotations", 1),
        ("model", "person"),
        ("keypoint_layout", "coco17"),
        ("min_confidence", 7.0),
        ("test_time_rotations", 3),
        ("noise", 0.02),
        ("keypoint_layout", "model"),
    ]
    refused = 0
    for second in range(10 * MANY):
        publisher.publish(cloud(second))
        refused += bool(client.set_parameters(**dict([wishes[second % 10]])))
    assert refused == 2 * MANY
    client.wait_for_health(
        lambda _, v: int(v["messages lifted"]) + int(v["messages rejected"]) >= 1 + 10 * MANY
    )
    publisher.publish(cloud(10**6))
    client.wait(lambda: heard[-1:] and heard[-1].header.stamp.sec == 10**6, "the last answer")
    assert {message.width for message in heard} == {P}


def test_publishers_come_and_go_and_stamps_may_be_any(
    start_lifter: StartLifter, connect: Connect
) -> None:
    start_lifter(qos_overrides=RELIABLE)
    client = connect()
    stamps = [5, 5, 3, 2**31 - 1, 0, -1, 4][: max(MANY, 4)]
    for second in stamps:
        publisher = client.publisher(PointCloud2)
        publisher.publish(cloud(second))
        client.wait(lambda: client.heard["/lifter/points"], "the answer")
        assert client.heard["/lifter/points"].pop().header.stamp.sec == second
        client.node.destroy_publisher(publisher)


def test_two_lifters_in_namespaces_keep_apart(start_lifter: StartLifter, connect: Connect) -> None:
    for side, length in (("left", 1.0), ("right", 3.0)):
        words = ("--ros-args", "-r", f"__ns:=/{side}", "--")
        start_lifter((*SCRIPT, *words), reference_length=length)
    client = connect()
    sizes = {}
    for side in ("left", "right"):
        client.listen(f"/{side}/lifter/points", PointCloud2)
    for side in ("left", "right"):
        publisher = client.publisher(PointCloud2, topic=f"/{side}/keypoints")
        heard = client.heard[f"/{side}/lifter/points"]

        def answered(publisher: Any = publisher, heard: list[Any] = heard) -> list[Any]:
            publisher.publish(cloud())
            return heard

        client.wait(answered, "an answer")
        xyz = np.frombuffer(heard[0].data, np.float32).reshape(P, 4)[:, :3]
        sizes[side] = float(np.linalg.norm(xyz))
    assert sizes["right"] == pytest.approx(3 * sizes["left"], rel=1e-4)


def test_simulated_time_may_stand_still_and_jump(
    start_lifter: StartLifter, connect: Connect
) -> None:
    start_lifter(use_sim_time=True, **MULTI_ARRAY)
    client = connect()
    clock = client.publisher(Clock, topic="/clock")
    publisher = client.publisher(Float32MultiArray)
    points = np.random.default_rng(0).uniform(50, 600, P * 2).astype(np.float32)
    message = Float32MultiArray(data=array("f", points))
    client.exchange(publisher, message)
    for second in (100, 7, 10**6, 0, 50):
        time_message = Clock()
        time_message.clock.sec = second

        def told(wanted: int = second, now: Clock = time_message) -> bool:
            clock.publish(now)
            publisher.publish(message)
            heard = client.heard["/lifter/points"]
            return bool(heard) and heard[-1].header.stamp.sec == wanted

        client.wait(told, f"an answer at {second} s")
    client.wait_for_health(lambda status, v: int(v["messages lifted"]) > 5)


def test_bytes_that_are_no_message_are_counted_and_harm_nothing(
    start_lifter: StartLifter, connect: Connect
) -> None:
    lifter = start_lifter(qos_overrides=RELIABLE)
    client, sent = connect(), []
    raw_publisher = client.publisher(PointCloud2)
    publisher = SimpleNamespace(publish=lambda m: (sent.append(m), raw_publisher.publish(m)))
    before, whole = client.exchange(publisher, cloud()).data, serialize_message(cloud())
    rng = random.Random(0)
    for _ in range(50 * MANY):
        spoilt = bytearray(whole)
        for _ in range(rng.choice((1, 3, 10))):
            spoilt[rng.randrange(4, 200)] = rng.choice((0, 1, 127, 255, rng.randrange(256)))
        publisher.publish(bytes(spoilt[: rng.choice((len(spoilt), rng.randrange(8, 300)))]))
    client.heard["/lifter/points"].clear()
    publisher.publish(cloud(77))
    client.wait(
        lambda: any(m.header.stamp.sec == 77 and m.data == before
                    for m in client.heard["/lifter/points"]),
        "the answer to what came after",
    )  # fmt: skip
    words = ("lifted", "without objects", "rejected")
    client.wait_for_health(
        lambda _, v: sum(int(v[f"messages {word}"]) for word in words) == len(sent)
    )
    assert "bytes that are no sensor_msgs/PointCloud2" in lifter.log
    assert lifter.process.poll() is None and "Traceback" not in lifter.log


def test_what_comes_too_fast_is_counted(start_lifter: StartLifter, connect: Connect) -> None:
    start_lifter()  # best effort, depth 1
    client, sent = connect(), []
    publisher = client.publisher(PointCloud2)
    counting = SimpleNamespace(publish=lambda m: (sent.append(m), publisher.publish(m)))

    def counts(status: Any) -> np.ndarray:
        said = {pair.key: pair.value for pair in status.values}
        return np.array(
            [int(said[f"messages {word}"]) for word in ("lifted", "rejected", "dropped")]
        )

    client.exchange(counting, cloud(0))
    client.wait_for_health(lambda *_: True)
    first = counts(client.wait_for_health(lambda *_: True))
    sent.clear()
    for second in range(500):
        counting.publish(cloud(second))
    client.wait_for_health(lambda *_: True)
    client.exchange(counting, cloud(10**6))  # its number tells what is missing before it
    status = client.wait_for_health(lambda s, _: sum(counts(s) - first) == len(sent))
    assert (counts(status) - first)[2] > 0
