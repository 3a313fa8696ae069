# SPDX-License-Identifier: Apache-2.0
"""Interleaved timing, name of the machine and command line of the benchmarks of speed.

A time depends on the machine and on its load. The ratio of two contenders that are measured side by
side, in rounds A B A B, depends on them less.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import Table
from deep_nrsfm_ros.commands.demo.domain import take_domain


def machine() -> str:
    """Return the name of the processor and the number of cores available to this process."""
    names = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    cores = len(os.sched_getaffinity(0))
    return f"{next(iter(names), 'unknown processor')}, {cores} core{'s' * (cores > 1)}"


def interleaved(
    contenders: Mapping[str, Callable[[], object]],
    rounds: int,
    seconds: float,
    warm_up: int = 4,
) -> dict[str, NDArray[np.float64]]:
    """Time the contenders in rounds A B A B.

    Args:
        contenders: name -> function to time.
        rounds: number of rounds.
        seconds: time for each contender in a round; at least one call is made.
        warm_up: untimed calls at the start; torch.jit compiles in its second and third call.

    Returns:
        name -> seconds (k,) of each call.
    """
    durations: dict[str, list[float]] = {name: [] for name in contenders}
    for call in contenders.values():
        for _ in range(warm_up):
            call()
    for _ in range(rounds):
        for name, call in contenders.items():
            end = time.perf_counter() + seconds
            while True:
                began = time.perf_counter()
                call()
                durations[name].append(time.perf_counter() - began)
                if time.perf_counter() >= end:
                    break
    return {name: np.array(times) for name, times in durations.items()}


def require_one_thread() -> None:
    """Restart this program with one NumPy thread, which NumPy reads only at its start."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
        os.execv(sys.executable, sys.orig_argv)


def random_domain() -> int:
    """Return a DDS domain of this process alone; restrict discovery to this machine."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    return take_domain()


@contextmanager
def environment(**values: str | None) -> Iterator[None]:
    """Set environment variables within the context; a value of None unsets one."""
    previous = {name: os.environ.get(name) for name in values}
    _set_variables(values)
    try:
        yield
    finally:
        _set_variables(previous)


def _set_variables(values: Mapping[str, str | None]) -> None:
    """Set each variable; None unsets it."""
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def process_memory(pid: int | str = "self", field: str = "VmRSS") -> float:
    """Return the memory of a process in MB: VmRSS (resident) or VmHWM (peak resident)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


def speed_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options that all benchmarks of speed share."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument(
        "--quick",
        action="store_true",
        help="check that it works, within seconds; the figures mean nothing",
    )
    return parser


def print_and_write(tables: Iterable[Table], output: Path) -> None:
    """Print and write each table when it is ready, with the machine in its title."""
    for table in tables:
        table.title += f" ({machine()})"
        print(table.markdown(), flush=True)
        table.write(output)
