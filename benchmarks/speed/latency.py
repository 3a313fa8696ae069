"""The lifter against a relay node, over DDS: latency, highest rate, start and memory.

Both hear the same messages from the same client, by turns; the relay is the floor.
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

from benchmarks.speed.round_trip import LOSSLESS, NODES, Contender, keypoints, started
from benchmarks.speed.timing import arguments, show
from benchmarks.table import Table, bars
from deep_nrsfm_ros.layouts.presets import CMU31

P = len(CMU31)
RATIO = "ratio to the relay"


class Size(NamedTuple):
    """How much is measured."""

    rates: tuple[float, ...]  # messages a second
    objects: tuple[int, ...]  # a message
    rounds: int
    seconds: float  # of a node's turn in a round
    trials: int  # of the highest rate
    starts: int


WHOLE = Size((30.0, 100.0, 500.0), (1, 5, 20), 3, 5.0, 12, 15)
QUICK = Size((100.0,), (1,), 1, 0.2, 2, 1)


def latency(size: Size, folder: Path) -> Table:
    """Return the latency of both at each rate and number of objects."""
    table = Table(
        "latency",
        "Latency over DDS, from publishing keypoints until points and rotation are there",
        ("objects", "Hz", "node"),
        ("answered %", "p50 ms", "p99 ms"),
        {
            "relay": "a node that receives the message and publishes it, and a quaternion",
            "answered %": "both hear by best effort, depth 1: what comes too fast is dropped",
            RATIO: "of the row lifter to the row relay",
        },
        bars("p50 ms", "p99 ms"),
    )
    with ExitStack() as stack:
        nodes = {
            name: stack.enter_context(started(name, keypoints(1, P), folder)) for name in NODES
        }
        for objects in size.objects:
            raw = keypoints(objects, P)
            for rate in size.rates:
                add_latency(table, (str(objects), f"{rate:.0f}"), nodes, raw, rate, size)
    return table


def add_latency(
    table: Table,
    labels: tuple[str, str],
    nodes: dict[str, Contender],
    raw: bytes,
    rate: float,
    size: Size,
) -> None:
    """Add the rows of one rate: each node's, and the ratio."""
    sent = dict.fromkeys(nodes, 0)
    seconds: dict[str, list[float]] = {name: [] for name in nodes}
    for _ in range(size.rounds):
        for name, contender in nodes.items():
            played = contender.client.play(raw, rate, size.seconds)
            sent[name] += played.sent
            seconds[name].extend(played.latencies)
    found = {
        name: {
            "answered %": 100 * len(times) / sent[name],
            "p50 ms": 1e3 * float(np.percentile(times, 50)),
            "p99 ms": 1e3 * float(np.percentile(times, 99)),
        }
        for name, times in seconds.items()
    }
    add_with_ratio(table, labels, found)


def add_with_ratio(
    table: Table, labels: tuple[str, ...], found: dict[str, dict[str, float]]
) -> None:
    """Add a row for each node, and one with the figures of the lifter over those of the relay."""
    for name, figures in found.items():
        table.add((*labels, name), figures)
    relay, lifter = found["relay"], found["lifter"]
    table.add((*labels, RATIO), {name: lifter[name] / relay[name] for name in relay})


def highest_rate(size: Size, folder: Path) -> Table:
    """Return the highest rates that both keep up with."""
    table = Table(
        "highest_rate",
        "Highest rate with no message lost, one object a message, the node on one core",
        ("node",),
        ("Hz",),
        {
            "Hz": "of a reliable, keep-all publisher: all that was sent is answered at the latest "
            "100 ms after the last, so that no queue grows; found by doubling, then by halving "
            "the interval. The client sends and hears from one process: where it cannot, the rate "
            "is its own limit, which it then reaches with the relay first",
            RATIO: "of the row lifter to the row relay",
        },
        bars("Hz"),
    )
    raw = keypoints(1, P)
    with ExitStack() as stack:
        nodes = {name: stack.enter_context(started(name, raw, folder, LOSSLESS)) for name in NODES}
        for contender in nodes.values():
            pin(contender.process.pid)
        searches = {name: Search(100.0) for name in nodes}
        for _ in range(size.trials):
            for name, search in searches.items():
                client = nodes[name].client
                played = client.play(raw, search.rate, size.seconds / 3, grace=0.1)
                client.play(raw, 10.0, 0.1, grace=5.0)  # empties the queue
                search.tell(kept=len(played.latencies) == played.sent)
    add_with_ratio(table, (), {name: {"Hz": search.best} for name, search in searches.items()})
    return table


class Search:
    """The highest rate that can be kept: doubled while it is, then the interval halved."""

    def __init__(self, rate: float) -> None:
        """Begin with a rate; `rate` is the next to be tried, `best` the highest that was kept."""
        self.rate, self.best = rate, float("nan")
        self._least, self._most = 0.0, float("inf")

    def tell(self, *, kept: bool) -> None:
        """Take in whether `rate` was kept, and choose the next."""
        if kept:
            self.best = self._least = self.rate
        else:
            self._most = self.rate
        doubled, halved = 2 * self._least, (self._least + self._most) / 2
        self.rate = doubled if self._most == float("inf") else halved


def pin(process: int) -> None:
    """Keep all threads of a process on the last core there is."""
    core = max(os.sched_getaffinity(0))
    for thread in Path(f"/proc/{process}/task").iterdir():
        os.sched_setaffinity(int(thread.name), {core})


def start(size: Size, folder: Path) -> Table:
    """Return the time to the first answer and the memory of both, each start a new process."""
    table = Table(
        "start",
        "Start, and resident memory",
        ("node",),
        ("start s", "memory MB"),
        {
            "start s": "from the start of the process to its first answer, the median of "
            f"{size.starts}, by turns; the client says ten times a second that it is there",
            "memory MB": "resident, after some messages, the median of the same",
            RATIO: "of the row lifter to the row relay",
        },
        bars("start s"),
    )
    raw, seen = keypoints(1, P), {name: [(0.0, 0.0)] * 0 for name in NODES}
    for _ in range(size.starts):
        for name in NODES:
            with started(name, raw, folder) as contender:
                contender.client.play(raw, 100.0, size.seconds / 3)
                seen[name].append((contender.start, contender.memory()))
    medians = {name: np.median(values, 0).tolist() for name, values in seen.items()}
    add_with_ratio(
        table, (), {n: dict(zip(table.figures, v, strict=True)) for n, v in medians.items()}
    )
    return table


def benchmark(given: Namespace) -> Iterator[Table]:
    """Measure all of it."""
    size = QUICK if given.quick else WHOLE
    with tempfile.TemporaryDirectory() as name:
        for measure in (latency, highest_rate, start):
            yield measure(size, Path(name))


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    given = arguments(__doc__).parse_args(argv)
    show(benchmark(given), given.output)


if __name__ == "__main__":
    main()
