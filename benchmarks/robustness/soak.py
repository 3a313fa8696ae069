# SPDX-License-Identifier: Apache-2.0
"""Keep the lifter at work for long, training and not: is every message counted, does memory grow?

Prints a line every ten seconds. The lifter listens as it does by itself, best effort and depth 1:
where the machine is too busy it misses messages, and counts them. Exit code 1: what it says in
/diagnostics to have lifted, rejected and dropped is not what was sent, or memory grew too much.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from benchmarks.speed.timing import process_memory
from deep_nrsfm_ros.commands.demo.client import lifter
from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.messages.serialised import Header
from deep_nrsfm_ros.node.publishing import point_cloud
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras

P = 17
WINDOW = 10.0
SETTLED = 3  # windows after which memory must not grow
RELIABLE = {"reliability": "reliable", "history": "keep_all"}
COLUMNS = "{:>8} {:>9} {:>7} {:>9} {:>8} {:>8} {:>8} {:>8} {:>8}"
COUNTERS = ("lifted", "without objects", "rejected", "dropped")


def random_views(f: int, rng: np.random.Generator) -> NDArray[np.floating]:
    """Return (f, 17, 2) pixels of a random deforming object, seen by random cameras."""
    shapes = centre(rng.standard_normal((P, 3)) + 0.3 * rng.standard_normal((f, P, 3)))
    pixels: NDArray[np.floating] = 100 * (shapes @ random_cameras(f, rng)) + [320, 240]
    return pixels


class SoakClient:
    """A client that sends messages at a rate and measures the latency of the answers."""

    def __init__(self, points: NDArray[np.floating], rate: float) -> None:
        """Prepare to send the views `points` (f, 17, 2) repeatedly, `rate` per second."""
        rclpy.init()
        self._node = rclpy.create_node("soak")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._publisher = self._node.create_publisher(
            PointCloud2, "keypoints", QoSProfile(depth=1000)
        )
        self._node.create_subscription(
            PointCloud2, "/lifter/points", self._receive, QoSProfile(depth=1000)
        )
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._store_report, 10)
        self._messages = [_message(view) for view in points]
        self._period, self.sent, self.answered = 1 / rate, 0, 0
        self._number, self._last = 0, -1
        self._waiting: dict[int, float] = {}
        self._latencies: list[float] = []
        self._reports, self._reported = 0, dict.fromkeys(COUNTERS, 0)
        self._base = self.settle()
        self.sent = self.answered = 0

    @property
    def counters(self) -> dict[str, int]:
        """What the lifter has said since the start, by `COUNTED`."""
        return {name: self._reported[name] - self._base[name] for name in COUNTERS}

    def send(self, seconds: float) -> NDArray[np.floating]:
        """Send for `seconds`; return the latencies (k,) in ms of the answers."""
        self._latencies.clear()
        begin, number = time.perf_counter(), 0
        while (now := time.perf_counter()) < begin + seconds:
            due = begin + number * self._period
            if now < due:
                self._executor.spin_once(timeout_sec=due - now)
                continue
            self._send()
            number += 1
        return np.array(self._latencies or [np.nan])

    def settle(self, seconds: float = 60.0) -> dict[str, int]:
        """Wait for the last answers, or so long; return what the lifter says when all is still.

        The last message of all must be answered: from its number the lifter knows what it dropped.
        """
        self._spin(lambda: not self._waiting, seconds)
        for _ in range(int(seconds)):
            self._send()
            if self._spin(lambda: self._last == self._number - 1, 1.0):
                break
        before = self._reports
        self._spin(lambda: self._reports >= before + 2, seconds)  # the first report may be older
        return dict(self._reported)

    def call(self, service: str) -> str:
        """Call a service and return its answer; raise RuntimeError if it refuses."""
        client = self._node.create_client(Trigger, service)
        client.wait_for_service(30)
        future = client.call_async(Trigger.Request())
        while not future.done():
            self._executor.spin_once(timeout_sec=0.1)
        answer = future.result()
        if not answer.success:
            raise RuntimeError(answer.message)
        return str(answer.message)

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown()

    def _send(self) -> None:
        """Send the next message."""
        message = self._messages[self._number % len(self._messages)]
        message.header.stamp.sec = self._number
        self._waiting[self._number] = time.perf_counter()
        self._publisher.publish(message)
        self.sent, self._number = self.sent + 1, self._number + 1

    def _spin(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Spin until the condition holds or `seconds` have passed; return whether it holds."""
        end = time.perf_counter() + seconds
        while not condition() and time.perf_counter() < end:
            self._executor.spin_once(timeout_sec=0.1)
        return condition()

    def _receive(self, message: PointCloud2) -> None:
        """Store the latency of an answer; older unanswered messages count as lost."""
        self._last = message.header.stamp.sec
        sent = self._waiting.get(self._last)
        for number in [n for n in self._waiting if n <= self._last]:
            del self._waiting[number]
        if sent is not None:
            self.answered += 1
            self._latencies.append((time.perf_counter() - sent) * 1e3)

    def _store_report(self, message: DiagnosticArray) -> None:
        """Store the counters of a diagnostics report."""
        reported = {pair.key: pair.value for status in message.status for pair in status.values}
        self._reported = {name: int(reported[f"messages {name}"]) for name in COUNTERS}
        self._reports += 1


def _message(view: NDArray[np.floating]) -> PointCloud2:
    """Return keypoints (17, 2) as a PointCloud2."""
    zeros = np.zeros(1, np.float32)
    points = np.concatenate([view, np.zeros((P, 1))], -1)[None].astype(np.float32)
    sure = np.ones((1, P), np.float32)
    pixels = Lifted(points, zeros, zeros, zeros, zeros, sure, wrong=sure < 1)
    return deserialize_message(point_cloud(Header(), pixels), PointCloud2)


def soak(args: argparse.Namespace, folder: Path) -> bool:
    """Run; return whether every message was counted and memory did not grow."""
    rng = np.random.default_rng(0)
    write_bag(folder / "bag", "/keypoints", frames(random_views(500, rng), np.ones((500, P))))
    overrides = RELIABLE if args.reliable else {}
    parameters = {
        **{f"qos_overrides./keypoints.subscription.{k}": v for k, v in overrides.items()},
        "models_dir": str(folder / "models"),
        "train.bags": f"[{folder / 'bag'}]",
        "train.steps": 1_000_000,
        "train.activate": "never",
    }
    headings = (
        "minute",
        "training",
        "sent",
        "answered",
        "dropped",
        "p50 ms",
        "p99 ms",
        "max ms",
        "MB",
    )
    print(COLUMNS.format(*headings))
    growth, training = 0.0, False
    with lifter(parameters, folder / "log") as process:
        client, windows = (
            SoakClient(random_views(100, rng), args.rate),
            round(args.minutes * 60 / WINDOW),
        )
        settled = 0.0
        for i in range(windows):
            should_train = bool(4 * i // windows % 2)  # off, on, off, on
            if should_train != training:
                client.call("/lifter/train" if should_train else "/lifter/cancel_training")
                training = should_train
            sent, answered, dropped = client.sent, client.answered, client.counters["dropped"]
            ms = client.send(WINDOW)
            now = process_memory(process.pid)
            settled = now if i == min(SETTLED, windows - 1) else settled
            growth = now - settled if settled else 0.0
            figures = (*np.percentile(ms, (50, 99)), ms.max(), now)
            new_dropped = client.counters["dropped"] - dropped
            counts = (client.sent - sent, client.answered - answered, new_dropped)
            row = (f"{(i + 1) * WINDOW / 60:.1f}", "on" if training else "off", *counts)
            print(COLUMNS.format(*row, *(f"{figure:.2f}" for figure in figures)), flush=True)
        client.settle()
        client.close()
    uncounted = client.sent - sum(client.counters.values())
    reported = ", ".join(f"{count} {name}" for name, count in client.counters.items())
    print(
        f"{client.sent} sent: {reported}, {uncounted} not counted; "
        f"{client.answered} answers came back"
    )
    print(f"memory grew by {growth:.1f} MB")
    return not uncounted and growth < args.growth


def main(argv: Sequence[str] | None = None) -> None:
    """Run the soak test on the domain of the environment."""
    parser = argparse.ArgumentParser(prog="soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=2.0, help="duration (default: 2)")
    parser.add_argument("--rate", type=float, default=200.0, help="messages per second")
    parser.add_argument(
        "--reliable", action="store_true", help="queue messages that arrive during a lift"
    )
    parser.add_argument("--growth", type=float, default=5.0, help="MB that memory may grow")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        sys.exit(0 if soak(args, Path(folder)) else 1)


if __name__ == "__main__":
    main()
