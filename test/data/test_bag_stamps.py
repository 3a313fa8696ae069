# SPDX-License-Identifier: Apache-2.0
"""Bags whose stamps are not all of one clock, or go back."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from deep_nrsfm_ros.data.bags import point_cloud
from deep_nrsfm_ros.data.keypoint_files import read_bag
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import COCO17

STORE = get_typestore(Stores.ROS2_JAZZY)
CLOUD = "sensor_msgs/msg/PointCloud2"
SECOND = 1_000_000_000
WALL = 1_700_000_000 * SECOND


def write(path: Path, stamps: list[int], period: int = SECOND // 10) -> Path:
    """Write a bag of clouds whose first keypoint is at x = 1, 2, ..., recorded by a wall clock."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/keypoints", CLOUD, typestore=STORE)
        for i, stamp in enumerate(stamps):
            time = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp, SECOND))
            header = STORE.types["std_msgs/msg/Header"](time, "camera")
            points = np.random.default_rng(i).uniform(10, 900, (1, 17, 2))
            points[0, 0, 0] = i + 1
            message = point_cloud(header, points, np.ones((1, 17)))
            raw = STORE.serialize_cdr(message, CLOUD)
            writer.write(connection, WALL + i * period, raw)
    return path


def test_first_stamps_of_zero_do_not_come_last(tmp_path: Path) -> None:
    stamps = [0, 0, 0, *(12 * SECOND + i * SECOND // 10 for i in range(3, 9))]
    detections = read_bag(write(tmp_path / "bag", stamps), ReadOptions(layout=COCO17))
    assert detections.points[:, 0, 0].tolist() == list(range(1, 10))
    assert np.allclose(np.diff(detections.stamps), SECOND / 10)
    assert detections.stamps[-1] == stamps[-1]
    assert any("3 of 9 stamps" in warning for warning in detections.warnings)


def test_loops_are_not_mixed(tmp_path: Path) -> None:
    stamps = [20 * SECOND + i * SECOND // 5 for i in range(15)] * 2
    bag = write(tmp_path / "bag", stamps, SECOND // 5)
    detections = read_bag(bag, ReadOptions(layout=COCO17))
    assert detections.points[:, 0, 0].tolist() == list(range(1, 31))
    assert (np.diff(detections.stamps) > 0).all()
    assert any("go back 1 times" in warning for warning in detections.warnings)
