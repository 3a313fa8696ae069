# SPDX-License-Identifier: Apache-2.0
"""The detector turns images of every source into keypoints, with stand-ins for its libraries."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header

from deep_nrsfm_ros.commands.demo.domain import take_domain
from deep_nrsfm_ros.data.pose2sim import JOINTS, extract_videos, read_session
from deep_nrsfm_ros.layouts.presets import BODY25B, HAND21, MEDIAPIPE33, MEDIAPIPE75
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.decoding import POINT_CLOUD, read_observation

SIZE = (40, 60)  # height and width
DEADLINE = 60.0


def coloured(*red_green: int) -> np.ndarray:
    """Return an image in OpenCV's order of channels: blue, green, red."""
    image = np.zeros((*SIZE, 3), np.uint8)
    image[..., 2], image[..., 1] = red_green
    return image


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def image_message(image: np.ndarray, encoding: str, padding: int = 0) -> Image:
    height, width = image.shape[:2]
    rows = np.pad(image.reshape(height, -1), ((0, 0), (0, padding)), constant_values=7)
    header = Header(frame_id="eye")
    header.stamp.sec = 12
    return Image(
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        step=rows.shape[1],
        data=rows.tobytes(),
    )


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "places"), [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("mono8", [0])]
)
def test_images_of_every_encoding(
    module: Any, encoding: str, places: list[int], padding: int
) -> None:
    image = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)
    if encoding == "mono8":
        image[...] = image[..., :1]
    sent = np.ascontiguousarray(image[..., places])
    np.testing.assert_array_equal(module.rgb(image_message(sent, encoding, padding)), image)


@pytest.mark.parametrize(
    "change",
    [
        {"encoding": "bayer_rggb8"},
        {"data": b"\0" * 10},
        {"width": 61},
        {"height": 0, "data": b""},
        {"step": 0, "data": b""},
    ],
)
def test_images_that_cannot_be_read(module: Any, change: dict[str, Any]) -> None:
    message = image_message(coloured(1, 2), "bgr8")
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(ValueError, match="^image "):
        module.rgb(message)


def test_the_message_is_what_the_lifter_reads(module: Any) -> None:
    found = module.Detector()(coloured(0, 51)[..., ::-1].copy())
    message = module.cloud([found], module.LANDMARKS, Header(frame_id="eye"))
    seen = read_observation(message, POINT_CLOUD, len(MEDIAPIPE33))
    np.testing.assert_allclose(seen.points[0], found.points)
    np.testing.assert_allclose(seen.points[0, 0], [0, 0.2 * SIZE[0]], atol=1e-4)
    np.testing.assert_allclose(seen.confidence, 0.9)
    assert len(MEDIAPIPE33) == module.LANDMARKS
    assert not len(
        read_observation(module.cloud([], module.LANDMARKS, Header()), POINT_CLOUD, 33).points
    )
    with pytest.raises(MessageError):
        read_observation(message, POINT_CLOUD, len(BODY25B))


def test_hands_are_told_apart_and_selfies_too(module: Any) -> None:
    image = np.ascontiguousarray(coloured(1, 2)[..., ::-1])
    for selfie in (False, True):
        found = module.HandDetector(selfie)(image)
        assert {topic: len(hands) for topic, hands in found.items()} == module_topics(1)
        # The first hand, on the left of the image, is called Left for a mirrored image.
        first = found[module.LEFT if selfie else module.RIGHT][0]
        np.testing.assert_allclose(first.points[0], [0.1 * SIZE[1], 0.5 * SIZE[0]], rtol=1e-5)
        np.testing.assert_allclose(first.confidence, 0.9)
        message = module.cloud([first, first], module.HAND, Header())
        seen = read_observation(message, POINT_CLOUD, len(HAND21))
        assert seen.points.shape == (2, 21, 2)
    nothing = module.HandDetector()(np.zeros((*SIZE, 3), np.uint8))
    assert {topic: len(hands) for topic, hands in nothing.items()} == module_topics(0)


def module_topics(count: int) -> dict[str, int]:
    return {"right_hand_keypoints": count, "left_hand_keypoints": count}


def test_a_body_with_hands_is_one_object(module: Any) -> None:
    found = module.HolisticDetector()(np.ascontiguousarray(coloured(0, 51)[..., ::-1]))
    (whole,), (left,) = found[module.KEYPOINTS], found[module.LEFT]
    assert not found[module.RIGHT]
    assert whole.points.shape == (len(MEDIAPIPE75), 2)
    assert module.TOPICS["holistic"][module.KEYPOINTS] == len(MEDIAPIPE75)
    start = MEDIAPIPE75.index("left_hand_wrist")
    np.testing.assert_array_equal(whole.points[start : start + 21], left.points)
    np.testing.assert_allclose(whole.confidence[: len(MEDIAPIPE33)], 0.9)
    assert (whole.confidence[start : start + 21] == 1).all()
    assert (whole.confidence[MEDIAPIPE75.index("right_hand_wrist") :] == 0).all()
    nobody = module.HolisticDetector()(np.zeros((*SIZE, 3), np.uint8))
    assert not any(nobody.values())


def test_an_unknown_kind_of_detection_is_a_message(start: Any) -> None:
    process = start(detect="feet")
    said = process.communicate(timeout=DEADLINE)[0]
    assert process.returncode == 1 and "Traceback" not in said
    assert "detect is 'feet'; expected one of pose, hands, holistic" in said


def test_nobody_is_none(module: Any) -> None:
    assert module.Detector()(np.zeros((*SIZE, 3), np.uint8)) is None


def test_a_folder_is_seen_in_order_and_what_is_no_image_left_out(
    module: Any, tmp_path: Path
) -> None:
    for i in (2, 0, 1):
        np.save(tmp_path / f"{i}.npy", coloured(10 * i, 0))
    (tmp_path / "10.txt").write_text("no image")
    seen = list(module.images(str(tmp_path), rate=4.0))
    assert [seconds for seconds, _ in seen] == [0, 0.25, 0.5]
    assert [image[0, 0].tolist() for _, image in seen] == [[0, 0, 0], [10, 0, 0], [20, 0, 0]]


@pytest.mark.parametrize("source", ["nothing.mp4", "99"])
def test_a_source_that_is_none(module: Any, source: str) -> None:
    with pytest.raises(ValueError, match=f"source '{source}' is no video, no folder and no camera"):
        module.images(source)


class Ears:
    """Hears the keypoints, on a domain of its own."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("ears", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.heard: list[PointCloud2] = []
        self.node.create_subscription(PointCloud2, "keypoints", self.heard.append, 100)

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain for {what}"
            self._executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture
def start(
    stand_ins: None, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Return a function that starts the detector with parameters."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(take_domain()))
    started = []

    def run(**parameters: Any) -> subprocess.Popen[str]:
        words = [word for k, v in parameters.items() for word in ("-p", f"{k}:={v}")]
        started.append(
            subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "deep_nrsfm_ros.node.mediapipe_detector",
                    "--ros-args",
                    *words,
                ],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
        )
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def ears(start: Any) -> Iterator[Ears]:
    listener = Ears()
    yield listener
    listener.close()


def test_a_video_from_the_first_image_to_the_last(start: Any, ears: Ears, tmp_path: Path) -> None:
    with (tmp_path / "video.mp4").open("wb") as file:
        np.save(file, np.stack([coloured(10 * i, 50 * (i != 3)) for i in range(6)]))
        file.flush()
    before = time.time_ns()
    process = start(source=tmp_path / "video.mp4", frame_id="eye", listeners=1)
    ears.wait(lambda: process.poll() is not None, "the end of the video")
    said = process.communicate()[0]
    ears.wait(lambda: len(ears.heard) == 6, f"six messages: {said}")
    assert process.returncode == 0 and "6 images, 6 with a person" in said, said
    stamps = [stamp_of(message) for message in ears.heard]
    assert before < stamps[0] < time.time_ns()
    assert np.diff(stamps).tolist() == [20_000_000] * 5
    assert {message.header.frame_id for message in ears.heard} == {"eye"}
    xs = [read_observation(message, POINT_CLOUD, 33).points[0, 0, 0] for message in ears.heard]
    np.testing.assert_allclose(xs, [10 * i / 255 * SIZE[1] for i in range(6)], atol=1e-3)


def test_a_topic_keeps_its_header_and_outlives_bad_images(start: Any, ears: Ears) -> None:
    process = start()
    publisher = ears.node.create_publisher(Image, "image", 10)
    ears.wait(publisher.get_subscription_count, "the detector to listen")
    images = [image_message(coloured(90, 9), "yuv"), image_message(coloured(90, 9), "bgr8")]
    images.append(image_message(coloured(0, 0), "bgr8"))

    def heard() -> bool:
        for message in images:  # best effort may lose one
            publisher.publish(message)
            time.sleep(0.1)
        return {message.height for message in ears.heard} == {0, 1}

    ears.wait(heard, "a person and nobody")
    assert {(m.header.frame_id, m.header.stamp.sec) for m in ears.heard} == {("eye", 12)}
    client = AsyncParameterClient(ears.node, "/detector")
    assert client.wait_for_services(DEADLINE)
    future = client.describe_parameters(["source", "rate", "frame_id", "listeners", "smooth"])
    ears.wait(future.done, "the descriptions")
    described = future.result().descriptors
    assert len(described) == 5 and all(d.description and d.read_only for d in described)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=DEADLINE)[0]
    assert process.returncode == 0 and "Traceback" not in said, said
    assert "image is 'yuv'; expected one of rgb8, bgr8, mono8" in said


@pytest.mark.parametrize("source", ["nowhere.mp4", 99])
def test_a_bad_source_is_a_message(start: Any, source: Any) -> None:
    process = start(source=source, rate=30)
    said = process.communicate(timeout=DEADLINE)[0]
    assert process.returncode == 1 and "Traceback" not in said
    assert f"detector: source '{source}' is no video" in said


def test_the_real_one_sees_the_person(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe", reason="`make demo-live` installs it")
    wheel = Path(os.environ.get("POSE2SIM_WHEEL", ".cache/pose2sim-0.6.0-py3-none-any.whl"))
    if not wheel.exists() or not zipfile.is_zipfile(wheel):
        pytest.skip(f"{wheel} is not there; `make demo-live` fetches it")
    from deep_nrsfm_ros.node.mediapipe_detector import Detector, images

    videos = extract_videos(wheel, "Balancing", tmp_path)
    assert sorted(videos) == ["cam01", "cam02", "cam03", "cam04"]
    _, image = next(images(str(videos["cam01"])))
    found = Detector()(image)
    assert found is not None
    limbs = [MEDIAPIPE33.index(joint) for joint in JOINTS]
    view = read_session(wheel).views[0]
    other = view.points[0, [BODY25B.index(joint) for joint in JOINTS]]
    assert np.median(np.linalg.norm(found.points[limbs] - other, axis=1)) < 30  # pixels of 1920
    assert np.linalg.norm(found.world[limbs], axis=1).max() < 1.5
