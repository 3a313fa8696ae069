# SPDX-License-Identifier: Apache-2.0
"""The lifter against a relay node, over DDS: latency, highest rate, start time and memory.

Both receive the same messages from the same client, in alternating rounds. The relay is the lower
bound of the latency.
"""

from __future__ import annotations

import os
import tempfile
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.speed.round_trip import (
    LOSSLESS,
    NODES,
    RunningNode,
    running_node,
    serialised_keypoints,
)
from benchmarks.speed.timing import print_and_write, speed_parser
from benchmarks.table import Table, bars
from deep_nrsfm_ros.layouts.presets import CMU31

P = len(CMU31)
RATIO = "ratio to the relay"


class Effort(NamedTuple):
    """The amount of measurement."""

    rates: tuple[float, ...]  # messages per second
    objects: tuple[int, ...]  # per message
    rounds: int
    seconds: float  # of each node in a round
    trials: int  # steps of the search for the highest rate
    starts: int


FULL = Effort((30.0, 100.0, 500.0), (1, 5, 20), 3, 5.0, 12, 15)
QUICK = Effort((100.0,), (1,), 1, 0.2, 2, 1)


def latency(effort: Effort, folder: Path) -> Table:
    """Return the table of latencies at each rate and number of objects."""
    table = Table(
        "latency",
        "Latency over DDS, from publishing keypoints until points and rotation have arrived",
        ("objects", "Hz", "node"),
        ("answered %", "p50 ms", "p99 ms"),
        {
            "relay": "a node that publishes each message again, with a quaternion",
            "answered %": "both subscribe with best effort, depth 1: messages may be lost",
            RATIO: "row lifter / row relay",
        },
        bars("p50 ms", "p99 ms"),
    )
    with ExitStack() as stack:
        nodes = {
            name: stack.enter_context(running_node(name, serialised_keypoints(1, P), folder))
            for name in NODES
        }
        for objects in effort.objects:
            raw = serialised_keypoints(objects, P)
            for rate in effort.rates:
                add_latency(table, (str(objects), f"{rate:.0f}"), nodes, raw, rate, effort)
    return table


def add_latency(
    table: Table,
    labels: tuple[str, str],
    nodes: dict[str, RunningNode],
    raw: bytes,
    rate: float,
    effort: Effort,
) -> None:
    """Measure each node at one rate; add their rows and the ratio."""
    sent = dict.fromkeys(nodes, 0)
    seconds: dict[str, list[float]] = {name: [] for name in nodes}
    for _ in range(effort.rounds):
        for name, contender in nodes.items():
            played = contender.client.play(raw, rate, effort.seconds)
            sent[name] += played.sent
            seconds[name].extend(played.latencies)
    figures_by_node = {
        name: {
            "answered %": 100 * len(times) / sent[name],
            "p50 ms": 1e3 * float(np.percentile(times, 50)),
            "p99 ms": 1e3 * float(np.percentile(times, 99)),
        }
        for name, times in seconds.items()
    }
    add_with_ratio(table, labels, figures_by_node)


def add_with_ratio(
    table: Table, labels: tuple[str, ...], figures_by_node: dict[str, dict[str, float]]
) -> None:
    """Add a row for each node, and one with the ratio of lifter to relay."""
    for name, figures in figures_by_node.items():
        table.add((*labels, name), figures)
    relay, lifter = figures_by_node["relay"], figures_by_node["lifter"]
    table.add((*labels, RATIO), {name: lifter[name] / relay[name] for name in relay})


def highest_rate(effort: Effort, folder: Path) -> Table:
    """Return the table of the highest rates without loss."""
    table = Table(
        "highest_rate",
        "Highest rate with no message lost, one object a message, the node on one core",
        ("node",),
        ("Hz",),
        {
            "Hz": "of a reliable, keep-all publisher: every message is answered at the latest "
            "100 ms after the last one, so that no queue grows; doubled, then bisected. The client "
            "sends and receives in one process; its own limit shows with the relay first",
            RATIO: "row lifter / row relay",
        },
        bars("Hz"),
    )
    raw = serialised_keypoints(1, P)
    with ExitStack() as stack:
        nodes = {
            name: stack.enter_context(running_node(name, raw, folder, LOSSLESS)) for name in NODES
        }
        for contender in nodes.values():
            pin(contender.process.pid)
        searches = {name: Search(100.0) for name in nodes}
        for _ in range(effort.trials):
            for name, search in searches.items():
                client = nodes[name].client
                played = client.play(raw, search.rate, effort.seconds / 3, grace=0.1)
                client.play(raw, 10.0, 0.1, grace=5.0)  # empties the queue
                search.update(kept=len(played.latencies) == played.sent)
    add_with_ratio(table, (), {name: {"Hz": search.best} for name, search in searches.items()})
    return table


class Search:
    """Search for the highest rate without loss: doubling, then bisection.

    Attributes:
        rate: the next rate to try, in Hz.
        best: the highest rate without loss so far, NaN if none.
    """

    def __init__(self, rate: float) -> None:
        """Start the search at `rate`."""
        self.rate, self.best = rate, float("nan")
        self._least, self._most = 0.0, float("inf")

    def update(self, *, kept: bool) -> None:
        """Store whether `rate` was without loss, and choose the next rate."""
        if kept:
            self.best = self._least = self.rate
        else:
            self._most = self.rate
        doubled, halved = 2 * self._least, (self._least + self._most) / 2
        self.rate = doubled if self._most == float("inf") else halved


def pin(process: int) -> None:
    """Bind all threads of a process to the last available core."""
    core = max(os.sched_getaffinity(0))
    for thread in Path(f"/proc/{process}/task").iterdir():
        os.sched_setaffinity(int(thread.name), {core})


def start(effort: Effort, folder: Path) -> Table:
    """Return the table of start times and memory; each start is a new process."""
    table = Table(
        "start",
        "Start, and resident memory",
        ("node",),
        ("start s", "memory MB"),
        {
            "start s": "from the start of the process to its first answer, median of "
            f"{effort.starts}, interleaved; the client announces itself ten times per second",
            "memory MB": "resident, after some messages, median of the same starts",
            RATIO: "row lifter / row relay",
        },
        bars("start s"),
    )
    raw, samples = serialised_keypoints(1, P), {name: [(0.0, 0.0)] * 0 for name in NODES}
    for _ in range(effort.starts):
        for name in NODES:
            with running_node(name, raw, folder) as contender:
                contender.client.play(raw, 100.0, effort.seconds / 3)
                samples[name].append((contender.start, contender.memory()))
    medians = {name: np.median(values, 0).tolist() for name, values in samples.items()}
    add_with_ratio(
        table, (), {n: dict(zip(table.figures, v, strict=True)) for n, v in medians.items()}
    )
    return table


def benchmark(args: Namespace) -> Iterator[Table]:
    """Yield the tables of latency, highest rate and start."""
    effort = QUICK if args.quick else FULL
    with tempfile.TemporaryDirectory() as name:
        for measure in (latency, highest_rate, start):
            yield measure(effort, Path(name))


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    args = speed_parser(__doc__).parse_args(argv)
    print_and_write(benchmark(args), args.output)


if __name__ == "__main__":
    main()
