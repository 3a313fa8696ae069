# SPDX-License-Identifier: Apache-2.0
"""Camera files become intrinsics; what is wrong with one is said with its name."""

from __future__ import annotations

from pathlib import Path

import pytest

from deep_nrsfm_ros.data.camera_file import CameraFileError, read_camera_file
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics

ECHOED = """\
header:
  stamp: {sec: 7, nanosec: 0}
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.28
- 0.09
- 0.0
- 0.0
- 0.0
k: [600.0, 0.0, 320.0, 0.0, 610.0, 236.0, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [580.0, 0.0, 315.0, 0.0, 0.0, 590.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 2
binning_y: 0
roi:
  x_offset: 20
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""
CALIBRATED = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [600, 0, 320, 0, 610, 236, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.09, 0, 0, 0]
projection_matrix:
  rows: 3
  cols: 4
  data: [580, 0, 315, 0, 0, 590, 240, 0, 0, 0, 1, 0]
"""
LENS = (-0.28, 0.09, 0.0, 0.0, 0.0)


def written(folder: Path, text: str) -> Path:
    path = folder / "camera.yaml"
    path.write_text(text)
    return path


def test_a_camera_info_as_ros2_topic_echo_prints_it(tmp_path: Path) -> None:
    found = read_camera_file(written(tmp_path, ECHOED))
    assert found == Intrinsics((300, 610), (150, 236), LENS)


def test_a_file_of_camera_calibration(tmp_path: Path) -> None:
    path = written(tmp_path, CALIBRATED)
    assert read_camera_file(path) == Intrinsics((600, 610), (320, 236), LENS)
    assert read_camera_file(path, rectified=True) == Intrinsics((580, 590), (315, 240))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("model: human", "neither k nor camera_matrix"),
        ("k: 600", "k is 600; it must be a list"),
        ("k: [600, 0, 320]", "k has 3 numbers; expected 9"),
        ("k: [a, b]", "could not convert"),
        ("camera_matrix: {rows: 3}", "k is empty; it must be a list"),
        ("k: [0, 0, 0, 0, 0, 0, 0, 0, 0]", "not calibrated"),
        (CALIBRATED.replace("plumb_bob", "fov"), "distortion_model is 'fov'"),
        ("k: [1, 2]\nroi: 3", "roi is 3"),
        ("- 1", "it must hold fields"),
        ("k: [", "is not YAML"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, text: str, reason: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(CameraFileError, match=r"^camera file .*camera\.yaml: ") as raised:
        read_camera_file(path)
    assert reason in str(raised.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CameraFileError, match=r"nowhere\.yaml: cannot be read"):
        read_camera_file(tmp_path / "nowhere.yaml")
