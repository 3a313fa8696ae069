# SPDX-License-Identifier: Apache-2.0
"""A node in a process of its own, and a client that sends it keypoints and times the answers.

Each node has a DDS domain of its own, so that several run at once without hearing each other and
are measured in alternating rounds.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from geometry_msgs.msg import QuaternionStamped
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2

from benchmarks.speed.timing import environment, process_memory, random_domain
from deep_nrsfm_ros.commands.demo.client import node
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node.publishing import point_cloud
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras

DEADLINE = 60.0  # seconds until a node must have answered
KEEP_ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
LOSSLESS = {
    "qos_overrides./keypoints.subscription.reliability": "reliable",
    "qos_overrides./keypoints.subscription.history": "keep_all",
}
"""Parameters of a node with a lossless subscription."""
PROMPT_DISCOVERY = Path(__file__).parents[2] / "config" / "prompt_discovery.xml"
"""Discovery settings of the client; without them a start sometimes takes 3 s longer."""


class RoundTrips(NamedTuple):
    """The result of sending messages at a rate.

    Attributes:
        sent: number of messages.
        seconds: duration of sending.
        latencies: (k,) seconds from publishing until both answers had arrived, of the answered.
    """

    sent: int
    seconds: float
    latencies: NDArray[np.float64]


def serialised_keypoints(objects: int, p: int) -> bytes:
    """Return a serialised PointCloud2 of `objects` random objects with p keypoints each."""
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((objects, p, 3)))
    points = np.zeros((objects, p, 3), np.float32)
    points[..., :2] = 100 * (shapes @ random_cameras(objects, rng)) + [320, 240]
    zeros = np.zeros(objects, np.float32)
    sure = np.ones((objects, p), np.float32)
    message = Lifted(points, zeros, zeros, zeros, zeros, sure, wrong=sure < 1)
    return point_cloud(Header(frame_id="camera"), message)


class Client:
    """Sends serialised messages to one node and receives its serialised answers."""

    def __init__(self, name: str, domain: int) -> None:
        """Create the client of the node `name` in a DDS domain."""
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        # For the client only: the measured node runs with the default settings.
        with environment(FASTRTPS_DEFAULT_PROFILES_FILE=str(PROMPT_DISCOVERY)):
            self._node = rclpy.create_node(f"client_of_{name}", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publisher = self._node.create_publisher(PointCloud2, "keypoints", KEEP_ALL)
        for kind, topic in ((PointCloud2, "points"), (QuaternionStamped, "camera_rotation")):
            self._node.create_subscription(
                kind, f"/{name}/{topic}", self._receive, KEEP_ALL, raw=True
            )
        self._number, self._answers = 0, 0
        self._sent: dict[int, float] = {}
        self._half_answered: set[int] = set()
        self._latencies: list[float] = []

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def meet(self, raw: bytes) -> float:
        """Send messages until one is answered; return the time.perf_counter() of the answer.

        Raises:
            TimeoutError: no answer within `DEADLINE` seconds.
        """
        deadline, answers = time.perf_counter() + DEADLINE, self._answers
        while self._answers == answers:
            if time.perf_counter() > deadline:
                raise TimeoutError("the node has answered nothing")
            self._send(raw)
            self._spin(time.perf_counter() + 0.01, until_answered=True)
        answered_at = time.perf_counter()
        self._spin(answered_at + 0.5)  # receive the remaining answers
        return answered_at

    def play(self, raw: bytes, rate: float, seconds: float, grace: float = 0.5) -> RoundTrips:
        """Send a message `rate` times per second; receive answers until `grace` seconds later."""
        self._sent.clear()
        self._half_answered.clear()
        self._latencies = []
        began = time.perf_counter()
        count = max(1, round(rate * seconds))
        for i in range(count):
            self._spin(began + i / rate)
            self._send(raw)
        duration = time.perf_counter() - began
        self._spin(time.perf_counter() + grace, until_answered=True)
        return RoundTrips(count, duration, np.array(self._latencies))

    def _send(self, raw: bytes) -> None:
        """Publish a message with its number as the stamp, which follows 4 bytes of CDR header."""
        self._number += 1
        stamped = raw[:4] + self._number.to_bytes(4, "little") + raw[8:]
        self._sent[self._number] = time.perf_counter()
        self._publisher.publish(stamped)

    def _receive(self, raw: bytes) -> None:
        """Store the latency when the second of the two answers to a message arrives."""
        number = int.from_bytes(raw[4:8], "little")
        if number not in self._half_answered:
            self._half_answered.add(number)
        elif (sent := self._sent.pop(number, None)) is not None:
            self._latencies.append(time.perf_counter() - sent)
            self._answers += 1

    def _spin(self, end: float, *, until_answered: bool = False) -> None:
        """Receive until `end` or, with `until_answered`, until all messages are answered."""
        while (left := end - time.perf_counter()) > 0:
            if until_answered and not self._sent:
                return
            self._executor.spin_once(timeout_sec=left)


class RunningNode(NamedTuple):
    """A running node.

    Attributes:
        process: the process of the node.
        client: its client.
        start: seconds from the start of the process to its first answer.
    """

    process: subprocess.Popen[bytes]
    client: Client
    start: float

    def memory(self) -> float:
        """Return the node's resident memory in MB."""
        return process_memory(self.process.pid)


NODES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "relay": ("benchmarks.speed.relay_node", "relay", {}),
    "lifter": ("deep_nrsfm_ros.node.lifter", "lifter", {"model": "cmu31"}),
}
"""Kind of node -> module, name, parameters."""


@contextmanager
def running_node(
    kind: str, raw: bytes, folder: Path, parameters: Mapping[str, Any] | None = None
) -> Iterator[RunningNode]:
    """Yield one of `NODES` when it has answered the message `raw`; its log is in `folder`."""
    module, name, defaults = NODES[kind]
    domain = random_domain()
    client = Client(name, domain)
    # Let Python write bytecode, as pip does at installation.
    variables = {"ROS_DOMAIN_ID": str(domain), "PYTHONDONTWRITEBYTECODE": None}
    try:
        with environment(**variables):
            began = time.perf_counter()
            with node(module, defaults | dict(parameters or {}), folder / f"{kind}.log") as process:
                yield RunningNode(process, client, client.meet(raw) - began)
    finally:
        client.close()
