# SPDX-License-Identifier: Apache-2.0
"""Names of nodes, frames and parameters, of a lifter that is one of several."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float32MultiArray

from deep_nrsfm_ros.messages.decoding import MULTI_ARRAY
from deep_nrsfm_ros.node.parameter_bridge import undeclared
from deep_nrsfm_ros.node.surroundings import LAUNCH_PID
from test.node.conftest import (
    DEADLINE,
    Client,
    Connect,
    LifterProcess,
    StartLifter,
    lifters,
    own_domain,
    write_models,
)
from test.node.test_lifter import cloud, multi_array, pixels

NAMESPACED = ("-m", "deep_nrsfm_ros.node.lifter", "--ros-args", "-r", "__ns:=/robot1", "--")
"""Program of a lifter in the namespace /robot1."""


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LifterProcess, Client]]:
    """Start a lifter in a namespace, with a frame for arrays, and a client of it."""
    folder = tmp_path_factory.mktemp("running")
    with own_domain() as number, lifters(write_models(folder / "models"), folder) as start:
        lifter = start(
            NAMESPACED, input_type=MULTI_ARRAY, frame_id="optical", keypoints_layout="coco17"
        )
        client = Client(number)
        client.listen("/robot1/lifter/points", PointCloud2)
        yield lifter, client
        client.close()


def test_diagnostics_have_the_full_name_of_the_node(
    running: tuple[LifterProcess, Client],
) -> None:
    _, client = running
    heard: list[DiagnosticArray] = client.heard["/diagnostics"]
    client.wait(lambda: heard, "diagnostics")
    names = {(status.name, status.hardware_id) for status in heard[-1].status}
    expected = {"/robot1/lifter: lifting", "/robot1/lifter: training"}
    assert names == {(name, "/robot1/lifter") for name in expected}


def test_keypoints_without_a_header_get_the_frame_of_the_parameter(
    running: tuple[LifterProcess, Client],
) -> None:
    _, client = running
    publisher = client.publisher(Float32MultiArray, topic="/robot1/keypoints")
    heard = client.heard["/robot1/lifter/points"]

    def answered() -> list[Any]:
        publisher.publish(multi_array(pixels(1)))
        return heard

    assert client.wait(answered, "points")[0].header.frame_id == "optical"
    client.destroy_publishers()


def test_a_parameter_that_does_not_exist_is_warned_of_with_the_nearest_name(
    running: tuple[LifterProcess, Client],
) -> None:
    lifter, _ = running
    lifter.wait_for_log(
        "there is no parameter 'keypoints_layout'; its value is not used; do you mean "
        "'keypoint_layout'?"
    )
    assert lifter.log.count("there is no parameter") == 1


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("up", "; do you mean 'gravity.up'?"),
        ("enabled", "; do you mean 'smoothing.enabled' or 'history.enabled'?"),
        ("history.enable", "; do you mean 'history.enabled'?"),
        ("colour", ""),
    ],
)
def test_the_name_that_is_meant_is_found(name: str, meant: str) -> None:
    declared = ["gravity.up", "smoothing.enabled", "history.enabled", "model"]
    listed = SimpleNamespace(names=declared)
    node: Any = SimpleNamespace(
        _parameter_overrides={name: 0, "model": 0}, list_parameters=lambda *_: listed
    )
    text = f"there is no parameter {name!r}; its value is not used"
    assert undeclared(node) == [text + meant]


def test_a_name_that_is_taken_is_warned_of(
    running: tuple[LifterProcess, Client], tmp_path: Path
) -> None:
    with lifters(write_models(tmp_path / "models"), tmp_path) as start:
        start(NAMESPACED, input_type=MULTI_ARRAY).wait_for_log(
            "another node is named /robot1/lifter"
        )


def test_what_an_answer_depends_on_is_said(running: tuple[LifterProcess, Client]) -> None:
    lifter, client = running
    lifter.wait_for_log("-p history.enabled:=false lifts each message by itself")
    client.wait_for_health(lambda _, v: v.get("history", "").startswith("on: "))


def test_a_lifter_ends_with_the_launch_that_started_it(
    start_lifter: StartLifter, monkeypatch: pytest.MonkeyPatch
) -> None:
    with subprocess.Popen(["sleep", "600"]) as launch:
        monkeypatch.setenv(LAUNCH_PID, str(launch.pid))
        lifter = start_lifter()
        launch.kill()
    assert lifter.process.wait(DEADLINE) == 0, lifter.log
    assert "the launch that started this node has ended" in lifter.log


def test_points_without_a_frame_and_a_frame_that_is_not_used_are_warned_of(
    start_lifter: StartLifter, connect: Connect
) -> None:
    """A header with a frame has precedence over the parameter."""
    lifter = start_lifter(frame_id="optical")
    client = connect()
    publisher = client.publisher(PointCloud2)
    message = cloud(pixels(1))
    assert client.exchange(publisher, message).header.frame_id == message.header.frame_id
    lifter.wait_for_log("frame_id is 'optical' and is not used")
