"""Keep the lifter at work for long, training and not: is every message answered, does memory grow?

Prints a line every ten seconds. The lifter hears by reliable transport here, so that a message
without an answer is one that it lost. Exit code 1: a message was lost, or memory grew too much.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from deep_nrsfm_ros.commands.demo.client import lifter
from deep_nrsfm_ros.node.publishing import PointCloud
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.nrsfm.lifting import Lifted
from deep_nrsfm_ros.observations.bags import frames, write_bag

P = 17
WINDOW = 10.0
SETTLED = 3  # windows after which memory shall grow no more
OVERRIDES = {"reliability": "reliable", "history": "keep_all"}
COLUMNS = "{:>8} {:>9} {:>7} {:>9} {:>8} {:>8} {:>8} {:>8}"


def views(f: int, rng: np.random.Generator) -> NDArray[np.floating]:
    """Return (f, 17, 2) pixels of a made-up object that deforms, seen by random cameras."""
    shapes = centre(rng.standard_normal((P, 3)) + 0.3 * rng.standard_normal((f, P, 3)))
    seen: NDArray[np.floating] = 100 * (shapes @ random_cameras(f, rng)) + [320, 240]
    return seen


def memory(pid: int) -> float:
    """Return the resident memory of a process in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1024


class Soak:
    """A client that sends at a rate and measures the answers."""

    def __init__(self, points: NDArray[np.floating], rate: float) -> None:
        """Send the views `points` (f, 17, 2), over and over, `rate` a second."""
        rclpy.init()
        self._node = rclpy.create_node("soak")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._publisher = self._node.create_publisher(
            PointCloud2, "keypoints", QoSProfile(depth=1000)
        )
        self._node.create_subscription(
            PointCloud2, "/lifter/points", self._take, QoSProfile(depth=1000)
        )
        self._messages = [_message(view) for view in points]
        self._period, self.sent, self.answered = 1 / rate, 0, 0
        self._waiting: dict[int, float] = {}
        self._latencies: list[float] = []
        while not self._publisher.get_subscription_count():
            self._executor.spin_once(timeout_sec=0.1)

    def send(self, seconds: float) -> NDArray[np.floating]:
        """Send for so long; return the latencies (k) in ms of what was answered meanwhile."""
        self._latencies.clear()
        begin, number = time.perf_counter(), 0
        while (now := time.perf_counter()) < begin + seconds:
            due = begin + number * self._period
            if now < due:
                self._executor.spin_once(timeout_sec=due - now)
                continue
            message = self._messages[self.sent % len(self._messages)]
            message.header.stamp.sec = self.sent
            self._waiting[self.sent] = time.perf_counter()
            self._publisher.publish(message)
            self.sent, number = self.sent + 1, number + 1
        return np.array(self._latencies or [np.nan])

    def drain(self, seconds: float) -> None:
        """Wait for the last answers."""
        end = time.perf_counter() + seconds
        while self._waiting and time.perf_counter() < end:
            self._executor.spin_once(timeout_sec=0.1)

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
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown()

    def _take(self, message: PointCloud2) -> None:
        """Note an answer."""
        sent = self._waiting.pop(message.header.stamp.sec, None)
        if sent is not None:
            self.answered += 1
            self._latencies.append((time.perf_counter() - sent) * 1e3)


def _message(view: NDArray[np.floating]) -> PointCloud2:
    """Return keypoints (17, 2) as a message of its own."""
    zeros = np.zeros(1, np.float32)
    points = np.concatenate([view, np.zeros((P, 1))], -1)[None].astype(np.float32)
    seen = Lifted(points, zeros, zeros, zeros, zeros, confidence=np.ones((1, P), np.float32))
    return PointCloud().fill(Header(), seen)


def soak(given: argparse.Namespace, folder: Path) -> bool:
    """Run; return whether no message was lost and memory stayed."""
    rng = np.random.default_rng(0)
    write_bag(folder / "bag", "/keypoints", frames(views(500, rng), np.ones((500, P))))
    parameters = {
        **{f"qos_overrides./keypoints.subscription.{k}": v for k, v in OVERRIDES.items()},
        "models_dir": str(folder / "models"),
        "train.bags": f"[{folder / 'bag'}]",
        "train.steps": 1_000_000,
        "train.activate": "false",
    }
    print(
        COLUMNS.format("minute", "training", "sent", "answered", "p50 ms", "p99 ms", "max ms", "MB")
    )
    grown, training = 0.0, False
    with lifter(parameters, folder / "log") as process:
        client, windows = Soak(views(100, rng), given.rate), round(given.minutes * 60 / WINDOW)
        settled = 0.0
        for i in range(windows):
            wanted = bool(4 * i // windows % 2)  # off, on, off, on
            if wanted != training:
                client.call("/lifter/train" if wanted else "/lifter/cancel_training")
                training = wanted
            sent, answered = client.sent, client.answered
            ms = client.send(WINDOW)
            now = memory(process.pid)
            settled = now if i == min(SETTLED, windows - 1) else settled
            grown = now - settled if settled else 0.0
            figures = (*np.percentile(ms, (50, 99)), ms.max(), now)
            counts = (client.sent - sent, client.answered - answered)
            row = (f"{(i + 1) * WINDOW / 60:.1f}", "on" if training else "off", *counts)
            print(COLUMNS.format(*row, *(f"{figure:.2f}" for figure in figures)), flush=True)
        client.drain(60)
        lost = client.sent - client.answered
        client.close()
    print(f"{client.sent} sent, {client.answered} answered, {lost} lost")
    print(f"memory grew by {grown:.1f} MB")
    return not lost and grown < given.growth


def main(argv: Sequence[str] | None = None) -> None:
    """Run the soak test on the domain of the environment."""
    parser = argparse.ArgumentParser(prog="soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=2.0, help="how long (default: 2)")
    parser.add_argument("--rate", type=float, default=200.0, help="messages a second")
    parser.add_argument("--growth", type=float, default=5.0, help="MB that memory may grow")
    given = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        sys.exit(0 if soak(given, Path(folder)) else 1)


if __name__ == "__main__":
    main()
