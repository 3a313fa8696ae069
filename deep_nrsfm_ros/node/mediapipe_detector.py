"""A detector for the lifter: MediaPipe Pose on a video, images, a camera or an image topic.

    pip install mediapipe==0.10.14
    ros2 run deep_nrsfm_ros mediapipe_detector --ros-args -p source:=0
    ros2 run deep_nrsfm_ros lifter --ros-args -p keypoint_layout:=mediapipe33

The wheel has the weights and brings OpenCV. For every image `keypoints` (sensor_msgs/PointCloud2)
holds the 33 landmarks of one person, x and y in pixels and confidence = MediaPipe's visibility, or
nothing (height 0). The stamp is the image's: a topic's own; when it came, of a camera; of a file,
the start plus its place in the video. Copy this, and put your own detector in place of `Detector`.
"""

from __future__ import annotations

import signal
import sys
import time
from array import array
from collections.abc import Iterator
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
    "listeners": (1, "begin when so many listen to `keypoints`"),
    "smooth": (True, "let MediaPipe smooth the landmarks over time, which makes them late"),
}
LANDMARKS = 33
ENDING = (signal.SIGINT, signal.SIGTERM)
# Bytes of a pixel, and the places of red, green and blue in it.
ENCODINGS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "mono8": (1, [0, 0, 0])}


class Detection(NamedTuple):
    """The landmarks of one person; x right, y down, z forward."""

    points: NDArray[np.float32]  # (33, 2) pixels
    confidence: NDArray[np.float32]  # (33,) visibility, 0 to 1
    world: NDArray[np.float32]  # (33, 3) MediaPipe's own 3D, metres about the hips


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


def cloud(found: Detection | None, header: Header) -> PointCloud2:
    """Return the message: a row of points for a person, no row for nobody."""
    rows = [] if found is None else [np.column_stack([found.points, found.confidence])]
    names = enumerate(("x", "y", "confidence"))
    fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in names]
    message = PointCloud2(header=header, height=len(rows), width=LANDMARKS, fields=fields)
    message.point_step, message.row_step, message.is_dense = 12, 12 * LANDMARKS, True
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
        self._detect = Detector(self._given["smooth"])
        self._begun, self._start, self._persons = False, 0, 0
        self._spent: list[float] = []
        self._publisher = self.create_publisher(PointCloud2, "keypoints", 10)
        self._live = self._given["source"].isdecimal()
        if self._given["source"]:
            self._images = images(self._given["source"], self._given["rate"])
            self.create_timer(0.002, self._next)
        else:
            latest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            self.create_subscription(Image, "image", self._take, latest)

    def _waits(self) -> bool:
        """Tell whether too few have listened yet."""
        self._begun |= self._publisher.get_subscription_count() >= self._given["listeners"]
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
        self._persons += found is not None
        self._publisher.publish(cloud(found, header))

    def close(self) -> None:
        """Wait until all is heard, and say what was seen."""
        self._publisher.wait_for_all_acked(Duration(seconds=5))
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
