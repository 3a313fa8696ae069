# SPDX-License-Identifier: Apache-2.0
"""The live demo from videos to its table, in real processes over real DDS, with stand-ins."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from deep_nrsfm_ros.data.cameras import Camera
from deep_nrsfm_ros.data.pose2sim import WHEEL
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.model_files.model_file import Model, save_model
from deep_nrsfm_ros.nrsfm.network import Architecture, initialise
from deep_nrsfm_ros.nrsfm.normalisation import Normaliser
from test.fixtures.forked_python import NODE, run_forked

FRAMES = 30


@pytest.fixture
def command(tmp_path: Path, ring: list[Camera], write_session: Any, stand_ins: None) -> list[str]:
    """Return the words that make Python run the demo on a made-up session, untrained."""
    write_session(tmp_path / WHEEL, ring, ring, [0.0] * 4, FRAMES)
    network = initialise(Architecture(widths=(16, 8)), len(HUMAN17), np.random.default_rng(0))
    model = Model("untrained", network, HUMAN17, Normaliser(), np.eye(3, dtype=np.float32))
    save_model(tmp_path / "untrained.safetensors", model)
    options = {"cache": tmp_path, "output": tmp_path / "out"}
    options["model"] = tmp_path / "untrained.safetensors"
    words = [f"--{name}={value}" for name, value in options.items()]
    return ["-m", "examples.demo_live", *words]


def add_videos(wheel: Path) -> None:
    """Add videos of images in all colours, but for one image in which nobody is."""
    video = np.full((FRAMES, 48, 36, 3), 90, np.uint8)
    video[3] = 0
    data = io.BytesIO()
    np.save(data, video)
    with zipfile.ZipFile(wheel, "a") as archive:
        for i in range(1, 5):
            name = f"Pose2Sim/Demo/S00_Demo_Session/P/S_BalancingTrial/videos/cam{i:02}.mp4"
            archive.writestr(name, data.getvalue())


def test_from_videos_to_the_table(command: list[str], tmp_path: Path) -> None:
    add_videos(tmp_path / WHEEL)
    done = run_forked(command, NODE, timeout=170, forks=True, env=dict(os.environ))
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert said.count(f"{FRAMES} images, {FRAMES - 1} with a person") == 4
    table = [line.split() for line in said.splitlines() if line.lstrip().startswith(("cam", "mea"))]
    assert [row[0] for row in table] == ["camera", "cam01", "cam02", "cam03", "cam04", "mean"]
    assert all(row[1] == str(FRAMES) for row in table[1:])
    # Nobody is in one image, and best effort may lose others where the machine is busy.
    assert all(0 < float(row[2]) < FRAMES for row in table[1:])
    assert (tmp_path / "out" / "demo.png").read_bytes().startswith(b"\x89PNG")
    with Reader(tmp_path / "out" / "recorded") as bag:
        counts = {topic: found.msgcount for topic, found in bag.topics.items()}
    assert counts["/keypoints"] == 4 * FRAMES
    assert counts["/lifter/points"] == sum(int(row[2]) for row in table[1:5])


def test_a_session_without_videos_is_told(command: list[str], tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=170)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "no videos of the trial 'Balancing'" in done.stderr
