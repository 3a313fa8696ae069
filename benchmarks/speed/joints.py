# SPDX-License-Identifier: Apache-2.0
"""CPU time and latency of a message of five people, with and without what is said of joints."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, TwistStamped
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, JointState, MultiDOFJointState, PointCloud2
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from benchmarks.speed.round_trip import serialised_keypoints
from benchmarks.speed.timing import (
    print_and_write,
    random_domain,
    require_one_thread,
    speed_parser,
)
from benchmarks.table import Table, bars
from deep_nrsfm_ros.layouts.presets import HUMAN25
from deep_nrsfm_ros.messages.stamps import RateLimit
from deep_nrsfm_ros.node import lifter
from deep_nrsfm_ros.node.bodies import BodyPublishers

PEOPLE, RATE = 5, 30.0
SWITCHED_OFF, SILENT, OWN, ALL, UNLIMITED, RELIABLE = ROWS = (
    *("without the code for joints", "nobody listens", "~/joints, ~/joint_states, ~/tracks"),
    *("all of it", "all of it, no limit", "all of it, reliable"),
)
LEGEND = {
    "us": f"CPU time of all threads of the node for a message of {PEOPLE} people, model human",
    "% of a core": f"at {RATE:.0f} messages a second, lifting and ~/points included",
    "for joints %": f"the same, without the row '{SWITCHED_OFF}'",
    "more %": f"us above the row '{SWITCHED_OFF}', in % of it",
    "points us": "median time from the call with a message until ~/points is handed to the "
    "middleware",
    "last us": "the same until the last topic is",
    OWN: "with a subscriber to each, in another process; it asks for best effort, as subscribers "
    "to sensors do",
    ALL: "these, ~/markers, ~/objects, and joint_states, urdf, position and velocity of each "
    "person (body.humans), the last two at most ten times a second; without /tf, whose package is "
    "not on PyPI",
    UNLIMITED: "the same as with body.motion_rate 0: position and velocity with each message",
    RELIABLE: "with subscribers who ask for reliable messages: the middleware checks that each "
    "has come",
}
_KINDS = {
    "joint_states": JointState,
    "urdf": String,
    "position": PointStamped,
    "velocity": TwistStamped,
}
_ALL = "body.humans:=true"
_TURNS = 3  # times that the listeners to everything take turns
_PAIRS = 4  # rounds of the two first rows, which hardly differ, for each of the others


def topics(*, everything: bool) -> dict[str, Any]:
    """Return the topics that are listened to, with the types of their messages."""
    found: dict[str, Any] = {
        "/lifter/points": PointCloud2,
        "/lifter/joints": MultiDOFJointState,
        "/lifter/joint_states": JointState,
        "/lifter/tracks": DiagnosticArray,
    }
    if everything:
        found |= {"/lifter/markers": MarkerArray, "/lifter/objects": MultiDOFJointState}
        for person in range(1, PEOPLE + 1):
            for name, kind in _KINDS.items():
                found[f"/humans/bodies/object{person}/{name}"] = kind
    return found


def listen(row: str) -> None:
    """Subscribe as a row says until the process is terminated."""
    rclpy.init()
    node = rclpy.create_node("listener")
    reliability = ReliabilityPolicy.RELIABLE if row == RELIABLE else ReliabilityPolicy.BEST_EFFORT
    quality = QoSProfile(depth=10, reliability=reliability)
    for topic, kind in topics(everything=row != OWN).items():
        node.create_subscription(kind, topic, lambda raw: None, quality, raw=True)
    with suppress(ExternalShutdownException):
        rclpy.spin(node)
    node.destroy_node()  # else publishers would wait for this subscriber's lease to end


@contextmanager
def listener(row: str) -> Iterator[None]:
    """Run `listen` in a process of its own."""
    words = (sys.executable, "-m", "benchmarks.speed.joints", "--listen", row)
    process = subprocess.Popen(words)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


class Costs(NamedTuple):
    """What a message costs, in us.

    Attributes:
        work: CPU time of all threads.
        points: time until ~/points is sent.
        last: time until the last topic is.
    """

    work: float
    points: float
    last: float


class Lifter:
    """A lifter in this process that lifts people who stand before its camera."""

    def __init__(self, *settings: str) -> None:
        """Start the node."""
        words = ("input_type:=sensor_msgs/PointCloud2", "camera_info:=camera_info", *settings)
        rclpy.init(args=["--ros-args", *(w for text in words for w in ("-p", text))])
        self.node: Any = lifter.LifterNode()
        k = [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0]
        self.node._camera._receive(CameraInfo(k=k, d=[0.0] * 5, distortion_model="plumb_bob"))
        ((self._source, _),) = self.node._keypoint_topics._subscribed.values()
        self._raw = serialised_keypoints(PEOPLE, len(HUMAN25))
        self._number = 30
        self._sent = 0.0
        points: Any = self.node._points
        send = points.publish

        def publish(raw: bytes) -> None:
            send(raw)
            self._sent = time.perf_counter()

        points.publish = publish

    def lift(self, calls: int) -> Costs:
        """Lift messages at the rate of their stamps; return what each costs."""
        latencies = np.empty((calls, 2))
        began = time.process_time()
        for call in range(calls):
            start = time.perf_counter()
            self._number += 1
            second, rest = divmod(self._number / RATE, 1)
            stamp = struct.pack("<iI", int(second), int(1e9 * rest))
            self.node._lift(self._source, self._raw[:4] + stamp + self._raw[12:])
            latencies[call] = self._sent - start, time.perf_counter() - start
        spent = (time.process_time() - began) / calls
        return Costs(1e6 * spent, *(1e6 * np.median(latencies, 0)).tolist())

    def wait_for(self, publishers: Sequence[Any], seconds: float = 60.0) -> None:
        """Wait until all publishers have a subscriber."""
        counts = [publisher.get_subscription_count for publisher in publishers]
        self._wait(lambda: all(count() for count in counts), "no subscriber", seconds)

    def wait_for_silence(self, publisher: Any, seconds: float = 60.0) -> None:
        """Wait until a publisher has no subscriber."""
        self._wait(lambda: not publisher.get_subscription_count(), "a subscriber", seconds)

    def _wait(self, reached: Callable[[], bool], obstacle: str, seconds: float) -> None:
        """Wait until something is reached."""
        end = time.monotonic() + seconds
        while not reached():
            if time.monotonic() > end:
                raise TimeoutError(obstacle)
            time.sleep(0.05)

    def close(self) -> None:
        """End the node."""
        self.node.close()
        self.node.destroy_node()
        rclpy.try_shutdown()


def measure(rounds: int, calls: int) -> dict[str, Costs]:
    """Return the median costs of a message for each row."""
    costs: dict[str, list[Costs]] = {name: [] for name in ROWS}
    off = mock.patch.object(BodyPublishers, "has_subscriber", return_value=False)
    silent = Lifter()
    silent.lift(calls)
    for _ in range(_PAIRS * rounds):
        with off:
            costs[SWITCHED_OFF].append(silent.lift(calls))
        costs[SILENT].append(silent.lift(calls))
    bodies = silent.node._bodies
    with listener(OWN):
        silent.wait_for((silent.node._points, bodies._joints, bodies._angles, bodies._tracks))
        silent.lift(calls)
        for _ in range(rounds):
            costs[OWN].append(silent.lift(calls))
    silent.close()
    everything = Lifter(_ALL)
    everything.lift(2)
    no_limit = mock.patch.object(RateLimit, "is_due", return_value=True)
    own = [b.angles for bodies in everything.node._bodies._bodies.values() for b in bodies]
    for _ in range(_TURNS):
        for row in (ALL, RELIABLE):
            with listener(row):
                everything.wait_for((everything.node._markers, *own))
                everything.lift(calls)
                for _ in range(-(-rounds // _TURNS)):
                    costs[row].append(everything.lift(calls))
                    if row == ALL:
                        with no_limit:
                            costs[UNLIMITED].append(everything.lift(calls))
            everything.wait_for_silence(everything.node._markers)
    everything.close()
    return {name: Costs(*np.median(each, 0).tolist()) for name, each in costs.items()}


def benchmark(args: Namespace) -> Iterator[Table]:
    """Measure and yield the table."""
    os.environ["ROS_DOMAIN_ID"] = str(random_domain())
    columns = ("us", "% of a core", "for joints %", "more %", "points us", "last us")
    table = Table(
        "joints", f"What the joints of {PEOPLE} people cost", ("row",), columns, LEGEND, bars("us")
    )
    results = measure(*((1, 3) if args.quick else (15, 60)))
    without = results[SWITCHED_OFF].work
    for name, (us, points, last) in results.items():
        share = [1e-4 * RATE * x for x in (us, us - without)]
        values = (us, *share, 100 * (us / without - 1), points, last)
        table.add((name,), dict(zip(columns, values, strict=True)))
    yield table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = speed_parser(__doc__)
    parser.add_argument("--listen", choices=(OWN, ALL, RELIABLE), help="be the listener of a row")
    args = parser.parse_args(argv)
    if args.listen:
        listen(args.listen)
    else:
        print_and_write(benchmark(args), args.output)


if __name__ == "__main__":
    require_one_thread()
    main()
