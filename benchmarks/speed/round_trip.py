"""A node in a process of its own, and a client that sends it keypoints and times the answers.

Each node has a DDS domain of its own, so that several are alive at once, measured by turns, and
never hear each other.
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

from benchmarks.speed.timing import environment, fresh_domain
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
"""Parameters of a node that shall lose nothing."""
PROMPT_DISCOVERY = Path(__file__).parents[2] / "config" / "prompt_discovery.xml"
"""By which the client makes itself known: else a start takes 3 s longer, or not, by luck."""


class Played(NamedTuple):
    """What came of messages that were sent at a rate.

    sent: how many. seconds: that sending took. latencies: (k,) seconds from publishing until both
    answers were there, of those answered.
    """

    sent: int
    seconds: float
    latencies: NDArray[np.float64]


def keypoints(objects: int, p: int) -> bytes:
    """Return a serialised message of objects of p keypoints that no model knows."""
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((objects, p, 3)))
    points = np.zeros((objects, p, 3), np.float32)
    points[..., :2] = 100 * (shapes @ random_cameras(objects, rng)) + [320, 240]
    zeros = np.zeros(objects, np.float32)
    seen = Lifted(points, zeros, zeros, zeros, zeros, np.ones((objects, p), np.float32))
    return point_cloud(Header(frame_id="camera"), seen)


class Client:
    """Sends messages to one node and hears its answers, serialised: that costs the least."""

    def __init__(self, name: str, domain: int) -> None:
        """Talk to the node called `name` in a domain."""
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        # For the client alone: the node that is measured is as its users have it.
        with environment(FASTRTPS_DEFAULT_PROFILES_FILE=str(PROMPT_DISCOVERY)):
            self._node = rclpy.create_node(f"client_of_{name}", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publisher = self._node.create_publisher(PointCloud2, "keypoints", KEEP_ALL)
        for kind, topic in ((PointCloud2, "points"), (QuaternionStamped, "camera_rotation")):
            self._node.create_subscription(kind, f"/{name}/{topic}", self._take, KEEP_ALL, raw=True)
        self._number, self._answers = 0, 0
        self._sent: dict[int, float] = {}
        self._half: set[int] = set()
        self._latencies: list[float] = []

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def meet(self, raw: bytes) -> float:
        """Send a message now and then until one is answered; return time.perf_counter() then.

        Raises TimeoutError if none is.
        """
        deadline, answers = time.perf_counter() + DEADLINE, self._answers
        while self._answers == answers:
            if time.perf_counter() > deadline:
                raise TimeoutError("the node has answered nothing")
            self._send(raw)
            self._spin(time.perf_counter() + 0.01, until_answered=True)
        met = time.perf_counter()
        self._spin(met + 0.5)  # what is still under way
        return met

    def play(self, raw: bytes, rate: float, seconds: float, grace: float = 0.5) -> Played:
        """Send a message `rate` times a second; hear answers until `grace` seconds after."""
        self._sent.clear()
        self._half.clear()
        self._latencies = []
        began = time.perf_counter()
        count = max(1, round(rate * seconds))
        for i in range(count):
            self._spin(began + i / rate)
            self._send(raw)
        took = time.perf_counter() - began
        self._spin(time.perf_counter() + grace, until_answered=True)
        return Played(count, took, np.array(self._latencies))

    def _send(self, raw: bytes) -> None:
        """Publish a message with its number as the stamp, which follows four bytes of CDR."""
        self._number += 1
        stamped = raw[:4] + self._number.to_bytes(4, "little") + raw[8:]
        self._sent[self._number] = time.perf_counter()
        self._publisher.publish(stamped)

    def _take(self, raw: bytes) -> None:
        """Note when the second of the two answers to a message came."""
        number = int.from_bytes(raw[4:8], "little")
        if number not in self._half:
            self._half.add(number)
        elif (sent := self._sent.pop(number, None)) is not None:
            self._latencies.append(time.perf_counter() - sent)
            self._answers += 1

    def _spin(self, end: float, *, until_answered: bool = False) -> None:
        """Receive until `end`, or until nothing is unanswered."""
        while (left := end - time.perf_counter()) > 0:
            if until_answered and not self._sent:
                return
            self._executor.spin_once(timeout_sec=left)


class Contender(NamedTuple):
    """A node that runs, its client, and the seconds from its start to its first answer."""

    process: subprocess.Popen[bytes]
    client: Client
    start: float

    def memory(self) -> float:
        """Return the node's resident memory in MB."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


NODES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "relay": ("benchmarks.speed.relay_node", "relay", {}),
    "lifter": ("deep_nrsfm_ros.node.lifter", "lifter", {"model": "cmu31"}),
}
"""What is measured: module, name of the node, parameters."""


@contextmanager
def started(
    what: str, raw: bytes, folder: Path, parameters: Mapping[str, Any] | None = None
) -> Iterator[Contender]:
    """Yield one of `NODES` as soon as it has answered the message `raw`; its log is in `folder`."""
    module, name, own = NODES[what]
    domain = fresh_domain()
    client = Client(name, domain)
    # What pip installs is compiled: so be this.
    variables = {"ROS_DOMAIN_ID": str(domain), "PYTHONDONTWRITEBYTECODE": None}
    try:
        with environment(**variables):
            began = time.perf_counter()
            with node(module, own | dict(parameters or {}), folder / f"{what}.log") as process:
                yield Contender(process, client, client.meet(raw) - began)
    finally:
        client.close()
