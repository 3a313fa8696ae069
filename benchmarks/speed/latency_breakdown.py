# SPDX-License-Identifier: Apache-2.0
"""Time of each step of one message, in microseconds.

A lifter in this process receives serialised messages; its answers go over DDS to another process.
Waiting for a message and taking it from DDS are not included; `benchmarks.speed.latency` measures
them with the relay.
"""

from __future__ import annotations

import os
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import rclpy

from benchmarks.speed.round_trip import serialised_keypoints
from benchmarks.speed.timing import print_and_write, random_domain, require_one_thread, speed_parser
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.demo.client import node
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.lifting import lifter as lifting
from deep_nrsfm_ros.lifting.smoothing import Smoother
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.node import lifter, publishing

OBJECTS = (1, 5, 20)
STEPS: dict[str, tuple[tuple[Any, str], ...]] = {
    "decode": ((MessageReader, "__call__"),),
    "map": ((KeypointMap, "__call__"),),
    "lift": ((lifting.Lifter, "lift"),),
    "smooth (off)": ((Smoother, "__call__"),),
    "serialise": ((publishing, "point_cloud"), (publishing, "camera_rotation")),
}
"""Step -> its functions; the time of other steps that they call is subtracted."""
PUBLISH, REST = "publish", "rest of the node"
SUM, TOTAL, SUM_TO_TOTAL = "sum", "total, without step timers", "sum / total"


class Stopwatch:
    """Sums the seconds spent in each step, without the steps that it calls.

    Attributes:
        seconds: step -> seconds.
    """

    def __init__(self) -> None:
        """Start at zero."""
        self.seconds: dict[str, float] = {}
        self._inner = [0.0]

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Add the time within the context to a step."""
        self._inner.append(0.0)
        began = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - began
            self.seconds[step] = self.seconds.get(step, 0.0) + elapsed - self._inner.pop()
            self._inner[-1] += elapsed

    def wrapped(self, step: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with timed calls."""

        def call(*args: Any, **kwargs: Any) -> Any:
            with self.timed(step):
                return function(*args, **kwargs)

        return call

    def patch(self, stack: ExitStack, step: str, owner: Any, name: str) -> None:
        """Time the attribute `name` of `owner` until the stack closes."""
        patched = self.wrapped(step, getattr(owner, name))
        stack.enter_context(mock.patch.object(owner, name, patched))


class InProcessLifter:
    """A lifter node in this process; another process subscribes to it."""

    def __init__(self) -> None:
        """Create the node and load its model."""
        self._node: Any = lifter.LifterNode()
        ((self._source, _),) = self._node._keypoint_topics._subscribed.values()
        self.publishers = (self._node._points, self._node._rotation)
        self.published: list[Any] = []

    def lift(self, raw: bytes) -> None:
        """Lift a serialised message, as the executor calls the node."""
        self._node._lift(self._source, raw)

    def lift_timed(self, raw: bytes, stopwatch: Stopwatch) -> None:
        """Lift a serialised message with timed steps."""
        with stopwatch.timed(REST):
            self.lift(raw)

    def wait_for_subscriber(self) -> None:
        """Wait for a subscriber to the points; raise TimeoutError after 60 s."""
        deadline = time.monotonic() + 60
        while not self.publishers[0].get_subscription_count():
            if time.monotonic() > deadline:
                raise TimeoutError("no subscriber within 60 s")
            time.sleep(0.05)

    def close(self) -> None:
        """Destroy the node."""
        self._node.close()
        self._node.destroy_node()


def measure(
    lifter_under_test: InProcessLifter, raw: bytes, rounds: int, calls: int
) -> dict[str, float]:
    """Return the microseconds of each step, of their sum and of the total: medians of rounds."""
    rows: list[dict[str, float]] = []
    for _ in range(rounds):
        began = time.perf_counter()
        for _ in range(calls):
            lifter_under_test.lift(raw)
        totals = time.perf_counter() - began
        stopwatch = Stopwatch()
        with ExitStack() as stack:
            for step, functions in STEPS.items():
                for owner, name in functions:
                    stopwatch.patch(stack, step, owner, name)
            for publisher in lifter_under_test.publishers:
                stopwatch.patch(stack, PUBLISH, publisher, "publish")
            for _ in range(calls):
                lifter_under_test.lift_timed(raw, stopwatch)
        order = (*STEPS, PUBLISH, REST)
        row = {step: 1e6 * stopwatch.seconds[step] / calls for step in order}
        row |= {SUM: sum(row.values()), TOTAL: 1e6 * totals / calls}
        rows.append(row)
    return {step: float(np.median([row[step] for row in rows])) for step in rows[0]}


def tabulate(results: dict[int, dict[str, float]]) -> Table:
    """Return the table of number of objects -> step -> microseconds."""
    names = [f"{objects} object{'s' * (objects > 1)}" for objects in results]
    table = Table(
        "latency_breakdown",
        "Time of each step of one message: model cmu31, 31 keypoints",
        ("step",),
        (*names, *(f"{name} %" for name in names)),
        {
            "columns": "microseconds and percent of the sum, by the number of objects in a message",
            "steps": "without the steps that they call; mean of a round, median of the rounds",
            "decode": "from serialised bytes, a message of a known kind",
            "serialise": "the answers",
            SUM_TO_TOTAL: "above 1: the cost of the step timers",
        },
        bars(*names),
    )
    totals = dict(zip(names, results.values(), strict=True))
    for step in next(iter(results.values())):
        figures = {name: times[step] for name, times in totals.items()}
        if step not in (SUM, TOTAL):
            figures |= {f"{n} %": 100 * times[step] / times[SUM] for n, times in totals.items()}
        table.add((step,), figures)
    table.add((SUM_TO_TOTAL,), {name: times[SUM] / times[TOTAL] for name, times in totals.items()})
    return table


def benchmark(args: Namespace) -> Iterator[Table]:
    """Measure a lifter in this process, with a relay node as its subscriber."""
    rounds, calls = (1, 5) if args.quick else (25, 100)
    os.environ["ROS_DOMAIN_ID"] = str(random_domain())
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        parameters = {"input": "/lifter/points"}
        stack.enter_context(node("benchmarks.speed.relay_node", parameters, Path(name) / "log"))
        # A type of its own: with "auto" the lifter would wait for a publisher.
        settings = ("model:=cmu31", "input_type:=sensor_msgs/PointCloud2")
        rclpy.init(args=["--ros-args", *(word for text in settings for word in ("-p", text))])
        stack.callback(rclpy.try_shutdown)
        lifter_under_test = InProcessLifter()
        stack.callback(lifter_under_test.close)
        lifter_under_test.wait_for_subscriber()
        results = {}
        for objects in OBJECTS:
            raw = serialised_keypoints(objects, len(CMU31))
            lifter_under_test.lift(raw)  # warm up
            results[objects] = measure(lifter_under_test, raw, rounds, calls)
    yield tabulate(results)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    args = speed_parser(__doc__).parse_args(argv)
    print_and_write(benchmark(args), args.output)


if __name__ == "__main__":
    require_one_thread()
    main()
