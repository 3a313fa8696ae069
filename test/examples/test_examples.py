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
    for name in ("lift_array", "lift_video", "publish_keypoints", "print_points", "elbow_angle"):
        lines = (EXAMPLES / f"{name}.py").read_text("utf-8").splitlines()
        assert len([line for line in lines if line.strip()]) <= 32


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


def test_a_published_person_is_printed(tmp_path: Path) -> None:
    live = environment() | {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(take_domain()),
    }
    commands = (
        ["-m", "deep_nrsfm_ros.node.lifter", "--ros-args", "-p", "keypoint_layout:=body25b"],
        [str(EXAMPLES / "publish_keypoints.py")],
        [str(EXAMPLES / "print_points.py")],
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
    waiting, first, *_ = logs[2].read_text().splitlines()
    assert waiting == "waiting for points of the lifter on /lifter/points"
    x, y, z, confidence = re.findall(r"-?\d+\.\d+", first)
    assert np.linalg.norm(np.array([x, y, z], float)) < 2  # metres from the middle of the person
    assert 0 < float(confidence) < 1  # of whatever frame came first
