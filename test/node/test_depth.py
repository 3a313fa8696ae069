# SPDX-License-Identifier: Apache-2.0
"""Measured depth: matching by stamp, bad depth, and a lifter over DDS."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField, Range
from std_msgs.msg import Header as RosHeader

from deep_nrsfm_ros.body.depth import surface_radii
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.decoding import POINT_FIELDS, POINT_STEP, pack_points
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.messages.unused_options import unused_depth
from deep_nrsfm_ros.node.camera import Camera, CameraOptions
from deep_nrsfm_ros.node.depth import DepthOptions, DepthSubscription
from test.fixtures.standing_person import standing_person
from test.node.conftest import Client, LifterProcess, lifters, own_domain, write_models

P = len(HUMAN17)
W, H = 640, 480
CAMERA = Intrinsics((400.0, 400.0), (320.0, 240.0))
RADII = surface_radii(HUMAN17, 0.5)
KNEE = HUMAN17.index("left_knee")
SIZE = 0.7  # of the person who is seen; the lifter takes it for an adult


def person(size: float = 1.0) -> np.ndarray:
    """Return points (17, 3) of a person half turned to the camera, 4 m away if an adult."""
    front, left, up = standing_person().T
    c, s = np.cos(0.6), np.sin(0.6)
    return size * np.stack([c * left + s * front, -up, 4 + s * left - c * front], -1)


def pixels() -> np.ndarray:
    return CAMERA.pixels(person()[:, :2] / person()[:, 2:])


def header(stamp: float = 100.0, frame: str = "optical") -> RosHeader:
    message = RosHeader(frame_id=frame)
    message.stamp.sec, message.stamp.nanosec = int(stamp), round(stamp % 1 * 1e9)
    return message


def image(stamp: float = 100.0, frame: str = "optical", **changes: Any) -> Image:
    """Return the depth of the person: a square around each keypoint, a wall, a box at the knee."""
    depth = np.full((H, W), 6000, np.uint16)
    order = np.argsort(-person()[:, 2])
    for i in order.tolist():
        x, y = pixels()[i].astype(int)
        metres = SIZE * (person()[i, 2] - RADII[i])
        depth[y - 5 : y + 6, x - 5 : x + 6] = 1000 * (1.0 if i == KNEE else metres)
    fields = {"encoding": "16UC1", "width": W, "height": H, "step": 2 * W}
    fields |= {"data": array("B", depth.tobytes()), "header": header(stamp, frame)}
    return Image(**(fields | changes))


class Log(SimpleNamespace):
    """A node that subscribes to nothing and keeps its warnings."""

    def __init__(self, *publishers: str) -> None:
        infos = [SimpleNamespace(topic_type=kind) for kind in publishers]
        self.warnings: list[str] = []
        super().__init__(
            create_subscription=lambda *_, **__: SimpleNamespace(topic_name="/depth"),
            get_publishers_info_by_topic=lambda _: infos,
            get_logger=lambda: SimpleNamespace(warning=self.warnings.append),
        )


class Bench:
    """A subscription without DDS, and a person as lifted."""

    def __init__(self, type_: str = "image", *publishers: str) -> None:
        self.node = Log(*publishers)
        node: Any = self.node
        camera: Any = SimpleNamespace(
            enabled=True, intrinsics=CAMERA, size=(W, H), require_intrinsics=lambda: CAMERA
        )
        self.depth = DepthSubscription(node, DepthOptions("/depth", type_), camera)

    def receive(self, message: Any) -> None:
        self.depth._receive(serialize_message(message))

    def scale(self, stamp: float = 100.0, frame: str = "optical") -> float:
        """Return the factor that a message of keypoints gives the person."""
        shape = person()[None].astype(np.float32)
        one = np.ones((1, P), np.float32)
        R = np.eye(3, dtype=np.float32)[None]
        lifted = Lifted(shape, R, one[:, 0], shape[:, 0, :2], one[:, 0], one, one < 0)
        pipeline: Any = SimpleNamespace(model=SimpleNamespace(layout=HUMAN17), reference_length=0.5)
        at = header(stamp, frame)
        own = Header(at.stamp.sec, at.stamp.nanosec, frame)
        lifted, placed = self.depth(own, lifted, ("/k anna",), stamp, pipeline)
        factor = float(lifted.shapes[0, 0, 2] / shape[0, 0, 2])
        assert placed[0] == (factor != 1)
        np.testing.assert_allclose(lifted.shapes, factor * shape, rtol=1e-5)
        assert lifted.scale[0] == pytest.approx(1 / factor)
        return factor


def test_the_nearest_depth_within_the_tolerance_is_used() -> None:
    bench = Bench()
    for stamp in (100.0, 100.04, 103.0):
        bench.receive(image(stamp, encoding="rgb8" if stamp == 100.0 else "16UC1"))
    assert len(bench.depth._messages) == 1  # they are forgotten after a jump
    for stamp in (103.1, 103.2):
        bench.receive(image(stamp))
    assert bench.scale(103.12) == pytest.approx(SIZE, rel=0.02)
    values = bench.depth.report()
    assert values["depth"] == "1 of 1 messages with depth"
    told = values["depth of /k anna"]
    assert "16 of 17 confident keypoints agree, scale 0.70; occluded: left_knee" in told
    assert bench.scale(104.0) == pytest.approx(SIZE, rel=0.02)  # the size is remembered
    values = bench.depth.report()
    assert values["depth"].startswith("0 of 1 messages with depth: the nearest depth on /depth is")
    assert "0.800 s before the keypoints; depth.tolerance is 0.05" in bench.depth.problem
    assert "too few agree, scale 0.70 as before" in values["depth of /k anna"]
    assert len(bench.node.warnings) == 1


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (image(encoding="rgb8"), "encoding is 'rgb8'; expected 16UC1"),
        (image(width=320), "depth image is 320 x 480 and the camera's image 640 x 480"),
        (image(data=array("B")), "do not fit into the 0 bytes"),
        (image(frame="depth_optical"), "is in frame 'depth_optical' and the keypoints are in 'opt"),
    ],
    ids=["colour", "size", "empty", "frame"],
)
def test_depth_of_no_use_is_told_once_and_changes_nothing(message: Image, reason: str) -> None:
    bench = Bench()
    bench.receive(message)
    for _ in range(3):
        assert bench.scale() == 1
    assert reason in bench.depth.report()["depth"] and reason in bench.depth.problem
    assert len(bench.node.warnings) == 1 and reason in bench.node.warnings[0]


def test_depth_beside_most_of_the_body_is_doubted_once() -> None:
    bench = Bench()
    shifted = np.roll(np.frombuffer(image().data, np.uint16).reshape(H, W), 40, 1)
    data = array("B", shifted.tobytes())
    for i in range(2):
        for k in range(8):
            stamp = 100.0 + i + 0.1 * k
            bench.receive(image(stamp, data=data))
            bench.scale(stamp)
        bench.depth.report()
        assert "% of the keypoints have the depth on /depth" in bench.depth.problem
    assert len(bench.node.warnings) == 1 and "in doubt: only" in bench.node.warnings[0]
    for k in range(8):
        bench.receive(image(110.0 + 0.1 * k))
        bench.scale(110.0 + 0.1 * k)
    bench.depth.report()
    assert not bench.depth.problem


def test_bytes_of_another_type_are_no_depth() -> None:
    bench = Bench()
    bench.depth._receive(b"\x00\x01\x00")
    assert "too few for a header" in bench.node.warnings[0]
    bench.depth._receive(serialize_message(image())[:40])
    assert bench.scale() == 1 and len(bench.node.warnings) == 2


@pytest.mark.parametrize(
    ("publishers", "reason"),
    [
        ((), "nobody publishes it"),
        (("sensor_msgs/msg/PointCloud2",), "carries sensor_msgs/PointCloud2; depth.type image is"),
        (("sensor_msgs/msg/Image",), "has sent nothing yet"),
    ],
)
def test_silence_is_explained(publishers: tuple[str, ...], reason: str) -> None:
    bench = Bench("image", *publishers)
    assert bench.scale() == 1 and not bench.node.warnings
    assert reason in bench.depth.report()["depth"] and reason in bench.node.warnings[0]


def test_a_cloud_and_a_range_give_the_place_too() -> None:
    surface = person() * (SIZE * (1 - RADII / person()[:, 2]))[:, None]
    fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
    cloud = PointCloud2(header=header(), height=1, width=P, fields=fields, point_step=12)
    cloud.row_step, cloud.data = 12 * P, array("B", surface.astype(np.float32).tobytes())
    bench = Bench("points")
    bench.receive(cloud)
    assert bench.scale() == pytest.approx(SIZE, rel=0.02)

    bench = Bench("range")
    beam = {"field_of_view": 0.02, "min_range": 0.1, "max_range": 9.0}
    bench.receive(Range(header=header(frame="sonar"), range=SIZE * 3.9, **beam))
    assert bench.scale() == pytest.approx(SIZE, rel=0.02)
    assert "by the range" in bench.depth.report()["depth of /k anna"]
    bench.receive(Range(header=header(100.1), range=float("inf"), **beam))
    assert bench.scale(100.1) == pytest.approx(SIZE, rel=0.02)
    assert "scale 0.7" in (told := bench.depth.report()["depth of /k anna"]) and "before" in told


def test_depth_without_a_camera_is_refused() -> None:
    node: Any = None
    camera = Camera(node, CameraOptions())
    with pytest.raises(ValueError, match=r"depth.topic is '/depth' without camera_info"):
        DepthSubscription(node, DepthOptions("/depth"), camera)


def test_options_of_depth_without_a_topic_are_warned_of() -> None:
    assert not unused_depth(DepthOptions("/depth", "range", 0.2)) and not unused_depth(
        DepthOptions()
    )
    warnings = unused_depth(DepthOptions(type_="range", tolerance=0.2))
    assert warnings.keys() == {"depth.type", "depth.tolerance"}
    assert warnings["depth.type"].endswith("has no effect, since depth.topic is empty")


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple[LifterProcess, Client]]:
    """Start a lifter with depth."""
    parameters = {"model": "human17", "camera_info": "camera_info", "depth.topic": "depth"}
    with own_domain() as number, lifters(write_models(tmp_path / "models"), tmp_path) as start:
        lifter, client = start(**parameters), Client(number)
        yield lifter, client
        client.close()


def test_a_small_person_is_at_her_place_over_dds(running: tuple[LifterProcess, Client]) -> None:
    _, client = running
    fields = [PointField(name=n, offset=o, datatype=7, count=1) for n, o in POINT_FIELDS]
    message = PointCloud2(header=header(), height=1, width=P, fields=fields, point_step=POINT_STEP)
    message.row_step = P * POINT_STEP
    message.data = array("B", pack_points(pixels()[None].astype(np.float32), np.ones((1, P))))
    camera = CameraInfo(header=header(), width=W, height=H, distortion_model="plumb_bob")
    camera.k = [400.0, 0.0, 320.0, 0.0, 400.0, 240.0, 0.0, 0.0, 1.0]
    topics = ((CameraInfo, "camera_info"), (Image, "depth"), (PointCloud2, "keypoints"))
    publishers = [client.publisher(kind, topic=topic) for kind, topic in topics]

    def send() -> None:
        for publisher, each in zip(publishers, (camera, image(), message), strict=True):
            publisher.publish(each)

    client.node.create_timer(0.1, send)
    said: dict[str, str] = {}

    def has_depth(_: Any, values: dict[str, str]) -> bool:
        said.update(values)
        return any("occluded: left_knee" in v for k, v in values.items() if k.startswith("depth"))

    client.wait_for_health(has_depth)
    points = np.frombuffer(client.heard["/lifter/points"][-1].data, np.float32).reshape(-1, 4)
    trunk = points[HUMAN17.index("neck"), :3] - points[HUMAN17.index("mid_hip"), :3]
    assert np.linalg.norm(trunk) == pytest.approx(0.5 * SIZE, rel=0.1)
    assert points[:, 2].mean() == pytest.approx(person(SIZE)[:, 2].mean(), rel=0.03)
