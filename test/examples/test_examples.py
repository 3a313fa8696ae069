# SPDX-License-Identifier: Apache-2.0
"""The examples run as they are: files, the notebook, and a publisher and a subscriber live."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.commands.demo.domain import take_domain
from deep_nrsfm_ros.data.clip import read_clip
from deep_nrsfm_ros.data.pose2sim import JOINTS

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}


def test_arrays_are_lifted(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "lift_array.py")]
    said = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True)
    assert said.returncode == 0 and "100 frames of 25 keypoints" in said.stdout, said.stderr
    assert np.isfinite(np.load(tmp_path / "lifted.npz")["shapes"]).all()


def test_a_video_is_lifted_and_measured(tmp_path: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "lift_video.py")]
    said = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    aligned, in_camera, place = map(float, re.findall(r"([\d.]+) mm", said.stdout))
    assert aligned < 80 and in_camera < 120 and place < 150


def test_examples_are_short() -> None:
    for name, most in {
        **dict.fromkeys(("lift_array", "lift_video", "publish_keypoints", "elbow_angle"), 32),
        **dict.fromkeys(("print_points", "point_at_wrist"), 45),
    }.items():
        lines = (EXAMPLES / f"{name}.py").read_text("utf-8").splitlines()
        assert len([line for line in lines if line.strip()]) <= most


def test_the_notebook_lifts_draws_and_trains() -> None:
    notebook = json.loads((EXAMPLES / "lift_draw_train.ipynb").read_text("utf-8"))
    variables: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), variables)
    assert variables["lifted"].shapes.shape == (100, 25, 3)
    assert variables["mine"].name == "mine"


INTERRUPTED = """
import builtins, os, runpy, signal, sys, time
moment, script = sys.argv[1:]
original = builtins.__import__

def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.5)  # until all handlers have run

def import_slowly(name, *args, **others):
    if name == "rclpy" and moment == "imports" and not sent:
        sent.append(name)
        interrupt()
    return original(name, *args, **others)

def publish(self, message):
    interrupt()
    publish_really(self, message)

sent = []
builtins.__import__ = import_slowly
if moment == "publish":
    from rclpy.publisher import Publisher
    publish_really, Publisher.publish = Publisher.publish, publish
runpy.run_path(script, run_name="__main__")
"""


@pytest.mark.parametrize(
    ("moment", "name"),
    [
        ("imports", "publish_keypoints"),
        ("imports", "print_points"),
        ("imports", "elbow_angle"),
        ("imports", "point_at_wrist"),
        ("publish", "publish_keypoints"),
    ],
)
def test_an_interrupt_at_any_moment_ends_an_example_without_an_error(
    moment: str, name: str
) -> None:
    live = environment() | {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(take_domain()),
    }
    command = [sys.executable, "-W", "ignore", "-c", INTERRUPTED, moment]
    ended = subprocess.run(
        [*command, str(EXAMPLES / f"{name}.py")],
        env=live,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize("name", ["elbow_angle", "point_at_wrist", "print_points"])
def test_an_interrupt_ends_an_example_to_which_nothing_comes(name: str) -> None:
    domain = {"ROS_DOMAIN_ID": str(take_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    command = [sys.executable, str(EXAMPLES / f"{name}.py")]
    live = environment() | domain
    with subprocess.Popen(command, env=live, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline().startswith("waiting for ")
        time.sleep(0.5)  # until it spins
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(20) == 0
        finally:
            process.kill()


def played(tmp_path: Path, example: str, *parameters: str) -> list[str]:
    """Return what an example says of the published person, lifted with parameters."""
    live = environment() | {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(take_domain()),
    }
    commands = (
        ["-m", "deep_nrsfm_ros.node.lifter", "--ros-args", "-p", "keypoint_layout:=body25b"]
        + [word for parameter in parameters for word in ("-p", parameter)],
        [str(EXAMPLES / "publish_keypoints.py")],
        [str(EXAMPLES / f"{example}.py")],
    )
    logs = [tmp_path / f"{number}.log" for number in range(len(commands))]
    running = []
    for words, path in zip(commands, logs, strict=True):
        with path.open("w") as log:
            command = [sys.executable, *words]
            running.append(subprocess.Popen(command, env=live, stdout=log, stderr=log))
    try:
        deadline = time.monotonic() + 150
        while "confidence" not in logs[2].read_text():
            assert time.monotonic() < deadline and all(p.poll() is None for p in running)
            time.sleep(0.2)
        for process in running:
            process.send_signal(signal.SIGINT)
        assert [process.wait(30) for process in running] == [0, 0, 0]
    finally:
        for process in running:
            process.kill()
            process.wait()
    assert not any("Traceback" in path.read_text() for path in logs)
    return logs[2].read_text().splitlines()


def test_a_published_person_is_printed(tmp_path: Path) -> None:
    waiting, first, *_ = played(tmp_path, "print_points")
    assert waiting == "waiting for points of the lifter on /lifter/points"
    x, y, z, confidence = re.findall(r"-?\d+\.\d+", first)
    assert np.linalg.norm(np.array([x, y, z], float)) < 2  # metres from the middle of the person
    assert 0 < float(confidence) < 1  # of whatever frame came first


def test_a_wrist_is_pointed_at_in_the_frame_of_the_robot(tmp_path: Path) -> None:
    view = read_clip().session.views[0]
    camera = view.camera
    focal, (width, height) = camera.intrinsics.focal[0], camera.size
    pose = "camera_pose:=[0.5, 0.0, 1.4, -0.5, 0.5, -0.5, 0.5]"  # level, looks along x
    waiting, *lines = played(
        tmp_path,
        "point_at_wrist",
        *("target_frame:=base_link", pose, f"image_width:={width}", f"image_height:={height}"),
        f"field_of_view:={2 * np.degrees(np.arctan(width / 2 / focal)):.1f}",
    )
    assert waiting == "waiting for people of the lifter on /lifter/points"
    said = re.compile(
        r"object1: \((.*), (.*), (.*)\) m in base_link: "
        r"pan (.*), tilt (.*) degrees, confidence (.*)"
    )
    found = [said.fullmatch(line) for line in lines]
    assert found and all(found)
    x, y, z, pan, tilt, confidence = np.array([each.groups() for each in found if each], float).T
    assert (confidence >= 0.495).all()
    np.testing.assert_allclose(pan, np.degrees(np.arctan2(y, x)), atol=1)
    np.testing.assert_allclose(tilt, np.degrees(np.arctan2(z, np.hypot(x, y))), atol=1)
    wrist = np.nanmedian(view.truth[:, JOINTS.index("left_wrist")], 0) / 1000
    expected = [0.5 + wrist[2], -wrist[0], 1.4 - wrist[1]]
    np.testing.assert_allclose([x[0], y[0], z[0]], expected, atol=0.4)
