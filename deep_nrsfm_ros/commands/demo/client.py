# SPDX-License-Identifier: Apache-2.0
"""Client of the demo: start the lifter, play keypoints to it over DDS, and record its messages."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from deep_nrsfm_ros.data.cameras import Camera
from deep_nrsfm_ros.lifting.intrinsics import PLUMB_BOB

Info = Mapping[str, Any]
"""Of a message: `source_timestamp` and `received_timestamp` in ns of the system's clock."""

NO_LATENCY = (
    "no latency, since points arrived before their keypoints were sent: the clock was set "
    "meanwhile, or sender and receiver have different clocks"
)

_TIMEOUT = 60.0  # seconds
_LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_STORE = get_typestore(Stores.ROS2_JAZZY)


class DemoError(RuntimeError):
    """The demo cannot continue; the text says why."""


def lifter(
    parameters: Mapping[str, Any], log: Path
) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """Return a context manager that runs the lifter, as `node` does."""
    return node("deep_nrsfm_ros.node.lifter", parameters, log)


@contextmanager
def node(
    module: str, parameters: Mapping[str, Any], log: Path
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node as a process while the context lasts.

    Args:
        module: Python module of the node.
        parameters: ROS parameters.
        log: file for its output.
    """
    command = [sys.executable, "-m", module, "--ros-args"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={value}"]
    with log.open("wb") as output:
        process = subprocess.Popen(
            command,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C must reach only the demo, which ends the node itself
        )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


class Played(NamedTuple):
    """How the lifter responded to the messages of one camera.

    Attributes:
        stamps: of the messages sent, ns.
        latencies: from publishing keypoints to receiving points, of the messages lifted, seconds;
            negative where two clocks were compared.
        rate: points received per second, Hz.
        error: median of the residuals in the diagnostics.
    """

    stamps: list[int]
    latencies: list[float]
    rate: float
    error: float

    def latency(self, percent: float) -> float:
        """Return a percentile (0 to 100) of the latencies in ms; NaN if one is negative."""
        if not self.latencies or min(self.latencies) < 0:
            return math.nan
        return float(np.percentile(self.latencies, percent)) * 1e3


class Client:
    """Plays a bag of keypoints to the lifter and records the lifter's messages in another bag.

    Attributes:
        health: values of the latest diagnostics.
        training: values of the latest training status.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        source: Path | None,
        bag: Path,
        camera_info: str = "camera_info",
    ) -> None:
        """Connect to a lifter.

        Args:
            process: runs the lifter.
            source: bag to play, with PointCloud2 messages on one topic; None: nothing to play.
            bag: to record; must not exist.
            camera_info: topic of `announce`.
        """
        self._process = process
        self._messages = _by_camera(source) if source else {}
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("demo", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self.health: dict[str, str] = {}
        self.training: dict[str, str] = {}
        self._received: dict[int, float] = {}
        self._errors: list[float] = []
        self._publisher = self._node.create_publisher(PointCloud2, "keypoints", 10)
        self._camera_info = self._node.create_publisher(CameraInfo, camera_info, _LATCHED)
        self._record(PointCloud2, "/lifter/points", self._take_points)
        self._record(QuaternionStamped, "/lifter/camera_rotation", lambda *_: None)
        self._record(DiagnosticArray, "/diagnostics", self._take_report)
        self._record(DiagnosticStatus, "/lifter/training_status", self._take_training, _LATCHED)

    def __enter__(self) -> Client:
        """Return the client."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the DDS domain and close the bag."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)
        self._writer.close()

    def meet(self) -> None:
        """Wait until the lifter and this client have discovered each other."""
        self.wait(self._publisher.get_subscription_count, "the lifter's subscription")
        self.wait(lambda: self.health and self.training, "the lifter's diagnostics")

    def announce(self, camera: Camera) -> None:
        """Publish the intrinsics of a camera, and wait until the lifter's diagnostics show them."""
        message = CameraInfo(width=camera.size[0], height=camera.size[1])
        message.header.frame_id = camera.name
        message.distortion_model = PLUMB_BOB
        message.k, message.d = camera.matrix.ravel().tolist(), camera.distortion.tolist()
        self._camera_info.publish(message)
        self.wait(
            lambda: f"length {camera.matrix[0, 0]:.1f} " in self.health.get("camera", ""),
            f"the intrinsics of {camera.name}",
        )

    def play(self, camera: str) -> Played:
        """Publish the messages of a camera at the rate of their stamps; wait for diagnostics.

        Args:
            camera: frame_id of the messages.

        Raises:
            DemoError: no message was lifted.
        """
        messages, sent = self._messages[camera], {}
        self._forget()
        begin = time.perf_counter() - messages[0][0] / 1e9
        for stamp, raw in messages:
            self._spin_until(begin + stamp / 1e9)
            self._received.pop(stamp, None)  # the answer to an earlier message of this stamp
            sent[stamp] = time.time()
            self._publisher.publish(raw)
        return self._played(sent)

    def _forget(self) -> None:
        """Discard the points received so far."""
        self._received.clear()
        self._errors.clear()

    def _played(self, sent: Mapping[int, float]) -> Played:
        """Wait for diagnostics; return how messages, sent at times by stamp, were lifted."""
        reports = len(self._errors)
        self.wait(lambda: len(self._errors) > reports, "diagnostics")
        received = {stamp: at for stamp, at in self._received.items() if stamp in sent}
        if not received:
            raise DemoError(f"the lifter lifted no message: {self.health['last problem']}")
        span = max(received.values()) - min(received.values())
        return Played(
            list(sent),
            [at - sent[stamp] for stamp, at in received.items()],
            (len(received) - 1) / span if span else 0.0,
            float(np.nanmedian(self._errors)),
        )

    def train(self) -> str:
        """Start a training by the lifter's service and return the response.

        Raises:
            DemoError: the lifter refuses.
        """
        client = self._node.create_client(Trigger, "/lifter/train")
        self.wait(client.service_is_ready, "the training service")
        future = client.call_async(Trigger.Request())
        self.wait(future.done, "the response of the training service")
        response = future.result()
        if not response.success:
            raise DemoError(f"the lifter refused to train: {response.message}")
        return str(response.message)

    def wait_a_second(self) -> None:
        """Spin until the lifter's next diagnostics, at most about 1 s."""
        before = self.health
        self.wait(lambda: self.health is not before, "diagnostics")

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until a condition holds.

        Args:
            condition: returns a true value when it holds.
            what: is waited for, for the error text.

        Raises:
            DemoError: it does not hold within 60 s, or the lifter has ended.
        """
        deadline = time.perf_counter() + _TIMEOUT
        while not condition():
            if self._process.poll() is not None:
                raise DemoError("the lifter has ended")
            if time.perf_counter() > deadline:
                raise DemoError(f"waited {_TIMEOUT:.0f} s in vain for {what}")
            self._executor.spin_once(timeout_sec=0.05)

    def _spin_until(self, end: float) -> None:
        """Receive until `end` on the performance counter."""
        while (left := end - time.perf_counter()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def _record(
        self, kind: Any, topic: str, take: Callable[[Any, Info], None], qos: QoSProfile | int = 100
    ) -> None:
        """Record every message of a topic in the bag, and pass it to `take`.

        Its `Info` has the times at which the middleware sent and received it, in ns of the system's
        clock. The time of a callback is later, and callbacks of two topics may change places.
        """
        package, name = kind.__module__.split(".")[0], kind.__name__
        connection = self._writer.add_connection(topic, f"{package}/msg/{name}", typestore=_STORE)

        def receive(raw: bytes, info: Info) -> None:
            take(deserialize_message(raw, kind), info)
            self._writer.write(connection, time.time_ns(), raw)

        callback: Any = receive  # rclpy's types leave out callbacks that take the info
        self._node.create_subscription(kind, topic, callback, qos, raw=True)

    def _take_points(self, message: PointCloud2, info: Info) -> None:
        """Keep the time at which points were received."""
        self._received[_stamp(message.header)] = 1e-9 * (
            info["received_timestamp"] or time.time_ns()
        )

    def _take_report(self, message: DiagnosticArray, _: Info) -> None:
        """Keep the values of the latest diagnostics."""
        for status in message.status:
            if status.name == "/lifter: lifting":
                self.health = {pair.key: pair.value for pair in status.values}
                self._errors.append(float(self.health["residual"]))

    def _take_training(self, message: DiagnosticStatus, _: Info) -> None:
        """Keep the latest training status."""
        values = {pair.key: pair.value for pair in message.values}
        self.training = values | {"message": message.message}


def _by_camera(bag: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Return stamp in ns and serialised message of all messages of a bag, by frame_id."""
    messages: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
    with Reader(bag) as reader:
        for _, _, raw in reader.messages():
            header = deserialize_message(raw, PointCloud2).header
            messages[header.frame_id].append((_stamp(header), raw))
    return messages


def _stamp(header: Header) -> int:
    """Return the stamp in ns."""
    return int(header.stamp.sec * 1_000_000_000 + header.stamp.nanosec)
