# SPDX-License-Identifier: Apache-2.0
"""Objects in a fixed frame."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from benchmarks.data.walking_person import IMAGE, in_layout
from deep_nrsfm_ros.layouts.presets import COCO17
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node.camera import Camera, CameraOptions
from deep_nrsfm_ros.node.target_frame import TargetFrame, TargetOptions
from test.node.conftest import Connect, StartLifter
from test.node.test_publishing import lifted
from test.node.test_self_check import stream

LEVEL = (2.0, 0.0, 1.4, -0.5, 0.5, -0.5, 0.5)  # looks along x, 1.4 m high
NODE: Any = None
CAMERA = Header(frame_id="camera")


def target(pose: tuple[float, ...] = LEVEL, frame: str = "map") -> TargetFrame:
    return TargetFrame(NODE, TargetOptions(frame, pose), positioned=True)


def test_objects_before_a_level_camera_are_where_they_are_on_the_map() -> None:
    objects = lifted(1, 3)
    # Ahead, to the right, on the floor.
    objects.shapes[0] = np.array([[0, 0, 3], [1, 0, 3], [0, 1.4, 3]])
    header, moved = target()(Header(1, 2, "camera"), objects)
    assert header == Header(1, 2, "map")
    wanted = np.array([[5, 0, 1.4], [5, -1, 1.4], [5, 0, 0]])
    np.testing.assert_allclose(moved.shapes[0], wanted, atol=1e-6)
    np.testing.assert_allclose(moved.rotations[0] @ [0, 0, 1], [1, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(moved.residual, objects.residual)


def test_gravity_is_known_with_the_target() -> None:
    up = target().up(CAMERA)
    assert up is not None
    np.testing.assert_allclose(up, [0, -1, 0], atol=1e-9)
    assert target((0.0,) * 7, "").up(CAMERA) is None


def test_frames_of_tf_are_followed() -> None:
    frames = target()
    frames._pose = None
    with pytest.raises(MessageError, match="no transform from 'camera' to target_frame 'map'"):
        frames(CAMERA, lifted(1))
    frames._tree.add("map", "base", (0, 0, 2**-0.5, 2**-0.5), (1, 2, 0))  # a quarter to the left
    frames._tree.add("base", "camera", (-0.5, 0.5, -0.5, 0.5), (0.1, 0, 1))
    objects = lifted(1, 1)
    objects.shapes[0] = [[0, 0, 2]]
    _, moved = frames(CAMERA, objects)
    np.testing.assert_allclose(moved.shapes[0, 0], [1, 4.1, 1], atol=1e-6)


class Log:
    """Stands in for a node and its logger."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def get_logger(self) -> Log:
        return self

    def warning(self, text: str) -> None:
        self.warnings.append(text)


def test_the_transform_is_that_of_the_stamp_or_the_newest_with_one_warning() -> None:
    node: Any = Log()
    frames = TargetFrame(node, TargetOptions("map", LEVEL), positioned=True)
    frames._pose = None
    for second in (10, 11):  # 1 m/s
        translation = (float(second), 0.0, 0.0)
        frames._tree.add("map", "camera", (0, 0, 0, 1), translation, second * 1_000_000_000)

    def place(seconds: int, nanoseconds: int) -> float:
        objects = lifted(1, 1)
        objects.shapes[0] = 0
        _, moved = frames(Header(seconds, nanoseconds, "camera"), objects)
        return float(moved.shapes[0, 0, 0])

    assert place(10, 250_000_000) == 10.25 and place(11, 40_000_000) == 11 and not node.warnings
    assert place(11, 300_000_000) == 11 and place(9, 0) == 10
    (warning,) = node.warnings
    assert "0.300 s off" in warning


@pytest.mark.parametrize(
    ("options", "positioned", "reason"),
    [
        (TargetOptions("map", LEVEL), False, "without camera_info"),
        (TargetOptions("", LEVEL), True, "camera_pose is set without target_frame"),
    ],
)
def test_what_cannot_be_is_refused(
    options: TargetOptions, reason: str, *, positioned: bool
) -> None:
    with pytest.raises(ValueError, match=reason):
        TargetFrame(NODE, options, positioned=positioned)
    with pytest.raises(ValueError, match="seven numbers"):
        TargetOptions("map", (1.0, 2.0))


def test_a_height_without_a_camera_is_refused() -> None:
    options = CameraOptions(camera_height=1.4)
    with pytest.raises(ValueError, match="camera_height is 1.4 without camera_info"):
        Camera(NODE, options)


@pytest.mark.skipif(find_spec("tf2_msgs") is not None, reason="tf2_msgs is there")
def test_without_tf2_a_pose_is_needed() -> None:
    with pytest.raises(ValueError, match=r"target_frame is 'map': .*tf2_msgs.*or set camera_pose"):
        target((0.0,) * 7)


def test_people_are_upright_in_the_image_whatever_the_target(
    start_lifter: StartLifter, connect: Connect
) -> None:
    """In a frame whose y axis points up nobody is upside down: the image says it, not the frame."""
    pose = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    start_lifter(
        model="human",
        keypoint_layout="coco17",
        field_of_view=65.0,
        image_width=IMAGE[0],
        image_height=IMAGE[1],
        target_frame="map",
        camera_pose=pose,
    )
    client = connect()
    with stream(client, *in_layout(COCO17)):
        status = client.wait_for_health(lambda _, v: int(v["messages lifted"]) > 60)
    assert "upside down: y must point down" not in str(status)
