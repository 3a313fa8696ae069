"""Where the microseconds of one message go: the lifter's own functions, timed as it calls them.

A lifter in this process is handed serialised messages; its answers go over DDS to another
process. What waiting for a message and taking it from DDS cost is not in it: that is the relay's
share in `benchmarks.speed.latency`.
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

from benchmarks.speed.round_trip import keypoints
from benchmarks.speed.timing import arguments, fresh_domain, on_one_thread, show
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
    "read": ((MessageReader, "__call__"),),
    "map": ((KeypointMap, "__call__"),),
    "lift": ((lifting.Lifter, "__call__"),),
    "steady (off)": ((Smoother, "__call__"),),
    "build": ((publishing, "point_cloud"), (publishing, "camera_rotation")),
}
"""Each step and the functions that are it, less what they call of other steps."""
PUBLISH, REST = "publish", "the rest of the node"
SUM, WHOLE, SHARE = "sum", "whole, nothing else timed", "sum / whole"


class Stopwatch:
    """Adds up the seconds spent in each step, without those in steps that it calls."""

    def __init__(self) -> None:
        """Start with nothing."""
        self.seconds: dict[str, float] = {}
        self._inner = [0.0]

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Count the time inside for a step."""
        self._inner.append(0.0)
        began = time.perf_counter()
        try:
            yield
        finally:
            took = time.perf_counter() - began
            self.seconds[step] = self.seconds.get(step, 0.0) + took - self._inner.pop()
            self._inner[-1] += took

    def around(self, step: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function, its calls timed."""

        def call(*args: Any, **named: Any) -> Any:
            with self.timed(step):
                return function(*args, **named)

        return call

    def watch(self, stack: ExitStack, step: str, owner: Any, name: str) -> None:
        """Time what `owner` knows as `name` until the stack is left."""
        patched = self.around(step, getattr(owner, name))
        stack.enter_context(mock.patch.object(owner, name, patched))


class Lifter:
    """A lifter in this process, with someone in another who listens."""

    def __init__(self) -> None:
        """Load the model; `run` takes messages."""
        self._node: Any = lifter.LifterNode()
        ((self._source, _),) = self._node._keypoint_topics._subscribed.values()
        self.publishers = (self._node._points, self._node._rotation)
        self.published: list[Any] = []

    def run(self, raw: bytes) -> None:
        """Lift a message, as the executor would have the node do it."""
        self._node._lift(self._source, raw)

    def run_watched(self, raw: bytes, watch: Stopwatch) -> None:
        """Lift a message, timed."""
        with watch.timed(REST):
            self.run(raw)

    def meet(self) -> None:
        """Wait until someone listens to the points."""
        deadline = time.monotonic() + 60
        while not self.publishers[0].get_subscription_count():
            if time.monotonic() > deadline:
                raise TimeoutError("nobody listens")
            time.sleep(0.05)

    def close(self) -> None:
        """End it."""
        self._node.close()
        self._node.destroy_node()


def measure(subject: Lifter, raw: bytes, rounds: int, calls: int) -> dict[str, float]:
    """Return the microseconds of each step, of their sum and of the whole: medians over rounds."""
    rows: list[dict[str, float]] = []
    for _ in range(rounds):
        began = time.perf_counter()
        for _ in range(calls):
            subject.run(raw)
        whole = time.perf_counter() - began
        watch = Stopwatch()
        with ExitStack() as stack:
            for step, functions in STEPS.items():
                for owner, name in functions:
                    watch.watch(stack, step, owner, name)
            for publisher in subject.publishers:
                watch.watch(stack, PUBLISH, publisher, "publish")
            for _ in range(calls):
                subject.run_watched(raw, watch)
        order = (*STEPS, PUBLISH, REST)
        row = {step: 1e6 * watch.seconds[step] / calls for step in order}
        row |= {SUM: sum(row.values()), WHOLE: 1e6 * whole / calls}
        rows.append(row)
    return {step: float(np.median([row[step] for row in rows])) for step in rows[0]}


def tabulate(found: dict[int, dict[str, float]]) -> Table:
    """Return the table of microseconds by number of objects: step -> time."""
    names = [f"{objects} object{'s' * (objects > 1)}" for objects in found]
    table = Table(
        "latency_breakdown",
        "Where the microseconds of one message go: model cmu31, 31 keypoints",
        ("step",),
        (*names, *(f"{name} %" for name in names)),
        {
            "columns": "us, and their share of the sum, by the number of objects in a message",
            "steps": "without what they call of other steps; mean of a run, median of the runs",
            "read": "from serialised bytes, a message like the one before it",
            "build": "serialised",
            SHARE: "above 1: what the timing itself costs",
        },
        bars(*names),
    )
    whole = dict(zip(names, found.values(), strict=True))
    for step in next(iter(found.values())):
        figures = {name: times[step] for name, times in whole.items()}
        if step not in (SUM, WHOLE):
            figures |= {f"{n} %": 100 * times[step] / times[SUM] for n, times in whole.items()}
        table.add((step,), figures)
    table.add((SHARE,), {name: times[SUM] / times[WHOLE] for name, times in whole.items()})
    return table


def benchmark(given: Namespace) -> Iterator[Table]:
    """Run a lifter here and someone who listens to it elsewhere."""
    rounds, calls = (1, 5) if given.quick else (25, 100)
    os.environ["ROS_DOMAIN_ID"] = str(fresh_domain())
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        parameters = {"input": "/lifter/points"}
        stack.enter_context(node("benchmarks.speed.relay_node", parameters, Path(name) / "log"))
        rclpy.init(args=["--ros-args", "-p", "model:=cmu31"])
        stack.callback(rclpy.try_shutdown)
        subject = Lifter()
        stack.callback(subject.close)
        subject.meet()
        found = {}
        for objects in OBJECTS:
            raw = keypoints(objects, len(CMU31))
            subject.run(raw)  # the first call is slow
            found[objects] = measure(subject, raw, rounds, calls)
    yield tabulate(found)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    given = arguments(__doc__).parse_args(argv)
    show(benchmark(given), given.output)


if __name__ == "__main__":
    on_one_thread()
    main()
