# SPDX-License-Identifier: Apache-2.0
"""A detector for the lifter: MediaPipe Pose on a video, images, a camera or an image topic.

    pip install mediapipe==0.10.14
    ros2 run deep_nrsfm_ros mediapipe_detector --ros-args -p source:=0
    ros2 run deep_nrsfm_ros lifter --ros-args -p keypoint_layout:=mediapipe33

The wheel has the weights and brings OpenCV. For every image `keypoints` (sensor_msgs/PointCloud2)
holds the 33 landmarks of one person, x and y in pixels and confidence = MediaPipe's visibility, or
nothing (height 0). With `detect:=hands` `right_hand_keypoints` and `left_hand_keypoints` hold the
21 landmarks of hands instead (layout hand21; lift left hands with `mirrored:=true`). With
`detect:=holistic` `keypoints` holds the body and both hands of one person (layout mediapipe75), and
the topics of the hands are there too. The stamp is the image's: a topic's own; when it came, of a
camera; of a file, the start plus its place in the video. Copy this, and put your own detector in
place of `Detector`.
"""

from __future__ import annotations

import signal
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import mediapipe
import numpy as np
import rclpy
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.time import Time
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Header

RGB = NDArray[np.uint8]  # (height, width, 3)

PARAMETERS: dict[str, tuple[Any, str]] = {
    "source": ("", "video file, folder of images or number of a camera; empty: the topic `image`"),
    "rate": (30.0, "images a second, of a folder"),
    "frame_id": ("camera", "frame of the keypoints, where images do not come with one"),
    "listeners": (1, "begin when so many listen to the keypoints, over all topics"),
    "detect": ("pose", "pose = a body, hands = hands, holistic = a body with both hands"),
    "selfie": (False, "whether the images are mirrored, as by front cameras: left and right hands"),
    "smooth": (True, "let MediaPipe smooth the landmarks over time, which makes them late"),
}
LANDMARKS, HAND = 33, 21
KEYPOINTS, RIGHT, LEFT = "keypoints", "right_hand_keypoints", "left_hand_keypoints"
TOPICS = {
    "pose": {KEYPOINTS: LANDMARKS},
    "hands": {RIGHT: HAND, LEFT: HAND},
    "holistic": {KEYPOINTS: LANDMARKS + 2 * HAND, RIGHT: HAND, LEFT: HAND},
}
"""Topics of each kind of detection, and the landmarks of one object of each."""
ENDING = (signal.SIGINT, signal.SIGTERM)
# Bytes of a pixel, and the places of red, green and blue in it.
ENCODINGS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "mono8": (1, [0, 0, 0])}


class Detection(NamedTuple):
    """The p landmarks of one person or hand; x right, y down, z forward."""

    points: NDArray[np.float32]  # (p, 2) pixels
    confidence: NDArray[np.float32]  # (p,) visibility, 0 to 1
    world: NDArray[np.float32]  # (p, 3) MediaPipe's own 3D, metres about the hips; (0, 3): none


class Detector:
    """MediaPipe Pose, which follows one person from image to image."""

    def __init__(self, smooth: bool = True) -> None:
        """Load the pose model."""
        self._pose = mediapipe.solutions.pose.Pose(smooth_landmarks=smooth)

    def __call__(self, image: RGB) -> Detection | None:
        """Return the person in the image, None if nobody is seen."""
        found = self._pose.process(image)
        if found.pose_landmarks is None:
            return None
        flat = [(m.x, m.y, m.visibility) for m in found.pose_landmarks.landmark]
        world = [(m.x, m.y, m.z) for m in found.pose_world_landmarks.landmark]
        values = np.array(flat, np.float32)
        size = np.array(image.shape[1::-1], np.float32)
        return Detection(values[:, :2] * size, values[:, 2], np.array(world, np.float32))


class HandDetector:
    """MediaPipe Hands: up to four hands, each left or right."""

    def __init__(self, selfie: bool = False) -> None:
        """Load the model; `selfie`: the images are mirrored."""
        self._hands = mediapipe.solutions.hands.Hands(max_num_hands=4)
        self._selfie = selfie

    def __call__(self, image: RGB) -> dict[str, list[Detection]]:
        """Return the hands in the image by topic."""
        found = self._hands.process(image)
        hands: dict[str, list[Detection]] = {RIGHT: [], LEFT: []}
        sides = found.multi_handedness or ()
        for side, landmarks in zip(sides, found.multi_hand_landmarks or (), strict=True):
            told = side.classification[0]
            # MediaPipe names the sides for mirrored images.
            right = (told.label == "Right") == self._selfie
            hand = _marks(landmarks, image, HAND, told.score)
            hands[RIGHT if right else LEFT].append(hand)
        return hands


class HolisticDetector:
    """MediaPipe Holistic: one person's body and hands, the left one and the right one."""

    def __init__(self, smooth: bool = True) -> None:
        """Load the model."""
        self._holistic = mediapipe.solutions.holistic.Holistic(smooth_landmarks=smooth)

    def __call__(self, image: RGB) -> dict[str, list[Detection]]:
        """Return the person and the hands in the image by topic."""
        found = self._holistic.process(image)
        left = _marks(found.left_hand_landmarks, image, HAND, 1.0)
        right = _marks(found.right_hand_landmarks, image, HAND, 1.0)
        parts = (_marks(found.pose_landmarks, image, LANDMARKS), left, right)
        whole = Detection(*(np.concatenate(values) for values in zip(*parts, strict=True)))
        seen = ((KEYPOINTS, whole), (RIGHT, right), (LEFT, left))
        return {topic: [one] if one.confidence.any() else [] for topic, one in seen}


def _marks(landmarks: Any, image: RGB, count: int, score: float | None = None) -> Detection:
    """Return MediaPipe's landmarks; all missing if there are none.

    Args:
        landmarks: of MediaPipe, or None.
        image: that they are of.
        count: number of landmarks.
        score: confidence of all; None: the visibility of each.
    """
    values = np.zeros((count, 3), np.float32)
    if landmarks is not None:
        values[:] = [(m.x, m.y, m.visibility) for m in landmarks.landmark]
        if score is not None:
            values[:, 2] = score
    size = np.array(image.shape[1::-1], np.float32)
    return Detection(values[:, :2] * size, values[:, 2], np.zeros((0, 3), np.float32))


def images(source: str, rate: float = 30.0) -> Iterator[tuple[float, RGB]]:
    """Return the images of a source and their seconds; raise ValueError if it cannot be opened."""
    if Path(source).is_dir():
        found = (cv2.imread(str(path)) for path in sorted(Path(source).iterdir()))
        seen = ((i / rate, bgr) for i, bgr in enumerate(bgr for bgr in found if bgr is not None))
    else:
        capture = cv2.VideoCapture(int(source) if source.isdecimal() else source)
        if not capture.isOpened():
            raise ValueError(f"source {source!r} is no video, no folder and no camera's number")
        read = iter(capture.read, (False, None))
        seen = ((capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3, bgr) for _, bgr in read)
    return ((seconds, np.ascontiguousarray(bgr[..., ::-1])) for seconds, bgr in seen)


def rgb(message: Image) -> RGB:
    """Return the image of a message; raise ValueError for one that cannot be read."""
    kind, height, width, step = message.encoding, message.height, message.width, message.step
    if kind not in ENCODINGS:
        raise ValueError(f"image is {kind!r}; expected one of {', '.join(ENCODINGS)}")
    depth, places = ENCODINGS[kind]
    if not height * width or step < width * depth or len(message.data) != height * step:
        raise ValueError(f"image of {width} x {height} pixels ({kind}) has a wrong step or size")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : width * depth]
    return np.ascontiguousarray(rows.reshape(height, width, depth)[..., places])


def cloud(found: list[Detection], landmarks: int, header: Header) -> PointCloud2:
    """Return the message: a row of points for each object."""
    rows = [np.column_stack([one.points, one.confidence]) for one in found]
    names = enumerate(("x", "y", "confidence"))
    fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in names]
    message = PointCloud2(header=header, height=len(rows), width=landmarks, fields=fields)
    message.point_step, message.row_step, message.is_dense = 12, 12 * landmarks, True
    message.data = array("B", np.array(rows, "<f4").tobytes())
    return message


class DetectorNode(Node):
    """Publishes `keypoints` for every image of its source; `finished` tells the end of files."""

    def __init__(self) -> None:
        """Declare the parameters and open the source; raise ValueError if there is none."""
        super().__init__("detector")
        self._given = {}
        for name, (default, text) in PARAMETERS.items():
            # Of dynamic type, as `source:=0` and `rate:=30` are integers to ROS.
            kind = ParameterDescriptor(description=text, read_only=True, dynamic_typing=True)
            self._given[name] = type(default)(self.declare_parameter(name, default, kind).value)
        self.finished = Future()
        if self._given["detect"] not in TOPICS:
            kinds = ", ".join(TOPICS)
            raise ValueError(f"detect is {self._given['detect']!r}; expected one of {kinds}")
        self._topics = TOPICS[self._given["detect"]]
        self._detect = self._detector()
        self._begun, self._start, self._persons = False, 0, 0
        self._spent: list[float] = []
        self._by_topic = {
            topic: self.create_publisher(PointCloud2, topic, 10) for topic in self._topics
        }
        self._live = self._given["source"].isdecimal()
        if self._given["source"]:
            self._images = images(self._given["source"], self._given["rate"])
            self.create_timer(0.002, self._next)
        else:
            latest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            self.create_subscription(Image, "image", self._take, latest)

    def _detector(self) -> Callable[[RGB], dict[str, list[Detection]]]:
        """Return the function that finds the objects of each topic in an image."""
        if self._given["detect"] == "hands":
            return HandDetector(self._given["selfie"])
        if self._given["detect"] == "holistic":
            return HolisticDetector(self._given["smooth"])
        detect = Detector(self._given["smooth"])

        def person(image: RGB) -> dict[str, list[Detection]]:
            found = detect(image)
            return {KEYPOINTS: [] if found is None else [found]}

        return person

    def _waits(self) -> bool:
        """Tell whether too few have listened yet."""
        listeners = sum(p.get_subscription_count() for p in self._by_topic.values())
        self._begun |= listeners >= self._given["listeners"]
        return not self._begun

    def _next(self) -> None:
        """Publish what the next image shows; that of a file not before its time."""
        if not self._live and self._waits():
            return
        seconds, image = next(self._images, (0.0, None))
        if image is None:
            self.finished.set_result(None)
            return
        now = self.get_clock().now().nanoseconds
        self._start = self._start or now
        stamp = now if self._live else self._start + round(seconds * 1e9)
        time.sleep(max(0, stamp - now) / 1e9)
        header = Header(stamp=Time(nanoseconds=stamp).to_msg(), frame_id=self._given["frame_id"])
        self._publish(image, header)

    def _take(self, message: Image) -> None:
        """Publish what the image of a message shows, or say what is wrong with it."""
        try:
            self._publish(rgb(message), message.header)
        except ValueError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=2.0)

    def _publish(self, image: RGB, header: Header) -> None:
        """Publish what an image shows, once there are listeners."""
        if self._waits():
            return
        begin = time.perf_counter()
        found = self._detect(image)
        self._spent.append(time.perf_counter() - begin)
        self._persons += any(found.values())
        for topic, publisher in self._by_topic.items():
            publisher.publish(cloud(found[topic], self._topics[topic], header))

    def close(self) -> None:
        """Wait until all is heard, and say what was seen."""
        for publisher in self._by_topic.values():
            publisher.wait_for_all_acked(Duration(seconds=5))
        spent = f", p50 {1e3 * np.median(self._spent):.0f} ms an image" if self._spent else ""
        self.get_logger().info(f"{len(self._spent)} images, {self._persons} with a person{spent}")


def main() -> None:
    """Run the node until its files end or it is told to stop; exit code 1 for a bad source."""
    # None of rclpy's handlers: they shut the context down amid whatever this thread asks of ROS.
    signals: list[int] = []
    for number in ENDING:
        signal.signal(number, lambda number, _: signals.append(number))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = DetectorNode()
    except ValueError as error:
        rclpy.shutdown()
        sys.exit(f"detector: {error}")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while not signals and not node.finished.done():
            executor.spin_once(timeout_sec=0.2)  # a signal does not wake it
        if not signals:
            node.close()
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()
        for number in ENDING:  # launchers and terminals send the signal twice
            signal.signal(number, signal.SIG_IGN)


if __name__ == "__main__":
    main()
