# SPDX-License-Identifier: Apache-2.0
"""Whoever sets parameters of a running lifter reaches the owner's folders and no others."""

from __future__ import annotations

import shutil
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from std_msgs.msg import Float32MultiArray

from test.node.conftest import Connect, StartLifter

STAND_IN = (str(Path(__file__).with_name("lifter_with_stand_in_training.py")),)


def keypoints() -> Float32MultiArray:
    points = np.random.default_rng(0).uniform(50, 600, 17 * 2)
    return Float32MultiArray(data=array("f", points.astype(np.float32)))


def test_paths_outside_are_refused_and_the_lifter_goes_on(
    start_lifter: StartLifter,
    connect: Connect,
    models: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    outside = tmp_path_factory.mktemp("outside")
    stolen = Path(shutil.copy(models / "joints.safetensors", outside / "joints.safetensors"))
    (outside / "door.yaml").write_text("name: door\nkeypoints: [a, b, c, d]")
    (models / "leaves.safetensors").symlink_to(stolen)
    lifter = start_lifter(STAND_IN, input_type="std_msgs/Float32MultiArray")
    client = connect()
    publisher = client.publisher(Float32MultiArray)
    before = client.exchange(publisher, keypoints()).data
    up = f"../../{outside.name}/joints.safetensors"
    for word in (str(stolen), up, "leaves", "leaves.safetensors", "~nobody_here/x.safetensors"):
        reason = client.set_parameters(model=word)
        assert "outside of bags_dir" in reason or "is no path" in reason, reason
    assert "door.yaml, which leads to" in client.set_parameters(
        keypoint_layout=str(outside / "door.yaml")
    )
    for name, value in {
        "bags": [str(outside)],
        "object": str(outside / "door.yaml"),
        "keypoint_layout": str(outside / "door.yaml"),
        "from": str(stolen),
    }.items():
        default: object = [str(models / "joints")] if name == "bags" else ""
        assert client.set_parameters(**{f"train__{name}": value}) == ""
        refused = client.call("/lifter/train")
        assert not refused.success and f"train.{name} names" in refused.message, refused.message
        assert "put it there, or start the lifter with -p bags_dir:=FOLDER" in refused.message
        assert client.set_parameters(**{f"train__{name}": default}) == ""
    for name in ("bags_dir", "models_dir", "train__max_minutes", "train__max_frames"):
        other: Any = 1000 if name.endswith("frames") else 1.0 if name.endswith("minutes") else "/"
        assert "read-only" in client.set_parameters(**{name: other})
    assert client.exchange(publisher, keypoints()).data == before
    assert lifter.process.poll() is None


def test_a_request_beyond_the_owners_limits_is_refused(
    start_lifter: StartLifter, connect: Connect, models: Path
) -> None:
    train = {"bags": [str(models / "joints")], "max_minutes": 5, "free_disk": 1e9}
    start_lifter(STAND_IN, train=train)
    client = connect()
    refused = client.call("/lifter/train")
    assert not refused.success and "needs 1000000000 MB (train.free_disk)" in refused.message
    client.set_parameters(train__minutes=6)
    refused = client.call("/lifter/train")
    assert not refused.success and "allows at most 5 (train.max_minutes)" in refused.message
