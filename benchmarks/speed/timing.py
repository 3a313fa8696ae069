"""What the benchmarks of speed share: contenders by turns, the machine's name, a command line.

A time says little on another machine, and little on this one an hour later. A ratio of two that
were measured side by side, in rounds A B A B, says more: it is what the tables are about.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import Table


def machine() -> str:
    """Return the name of the processor and how many cores this process may use."""
    names = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    cores = len(os.sched_getaffinity(0))
    return f"{next(iter(names), 'unknown processor')}, {cores} core{'s' * (cores > 1)}"


def by_turns(
    contenders: Mapping[str, Callable[[], object]],
    rounds: int,
    seconds: float,
    warm_up: int = 4,
) -> dict[str, NDArray[np.float64]]:
    """Return the seconds (k,) that each call took, the contenders called in rounds A B A B.

    seconds: length of each one's turn in a round; a turn has one call at the least. warm_up: calls
    before that are not timed; torch.jit compiles in its second and third.
    """
    took: dict[str, list[float]] = {name: [] for name in contenders}
    for call in contenders.values():
        for _ in range(warm_up):
            call()
    for _ in range(rounds):
        for name, call in contenders.items():
            end = time.perf_counter() + seconds
            while True:
                began = time.perf_counter()
                call()
                took[name].append(time.perf_counter() - began)
                if time.perf_counter() >= end:
                    break
    return {name: np.array(times) for name, times in took.items()}


def on_one_thread() -> None:
    """Start this program again unless NumPy has one thread, which it reads at its start alone."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
        os.execv(sys.executable, sys.orig_argv)


def fresh_domain(*others: int) -> int:
    """Return a DDS domain at random, none of the others; let nothing leave this machine."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    return random.choice([number for number in range(1, 102) if number not in others])


@contextmanager
def environment(**values: str | None) -> Iterator[None]:
    """Set variables of this process, and of those that it starts, for a while; None: unset."""
    before = {name: os.environ.get(name) for name in values}
    _set_variables(values)
    try:
        yield
    finally:
        _set_variables(before)


def _set_variables(values: Mapping[str, str | None]) -> None:
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def arguments(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with what all benchmarks of speed are told."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument(
        "--quick", action="store_true", help="see that it works; the figures say nothing"
    )
    return parser


def show(tables: Iterable[Table], output: Path) -> None:
    """Print and write each table as soon as it is there, the machine in its title."""
    for table in tables:
        table.title += f" ({machine()})"
        print(table.markdown(), flush=True)
        table.write(output)
