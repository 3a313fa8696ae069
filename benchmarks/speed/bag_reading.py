# SPDX-License-Identifier: Apache-2.0
"""Messages per second read from bags into a dataset, against rosbags alone."""

from __future__ import annotations

import tempfile
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from benchmarks.speed.timing import interleaved, print_and_write, require_one_thread, speed_parser
from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.bags import STORAGES, frames, read_bags, write_bag
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.presets import CMU31

TOPIC = "/keypoints"
BARE, OURS = "rosbags alone", "read_bags"
_STORE = get_typestore(Stores.ROS2_JAZZY)


def decode(bag: Path) -> int:
    """Decode every message of a bag without keeping it; return the number of messages."""
    count = 0
    with Reader(bag) as reader:
        for connection, _, raw in reader.messages():
            _STORE.deserialize_cdr(raw, connection.msgtype)
            count += 1
    return count


def benchmark(args: Namespace) -> Iterator[Table]:
    """Write a bag of each storage and read it by both readers, interleaved."""
    messages, rounds = (500, 1) if args.quick else (50_000, 5)
    table = Table(
        "bag_reading",
        f"Reading a bag of {messages} PointCloud2 messages of {len(CMU31)} keypoints",
        ("storage", "by"),
        ("messages/s", "share"),
        {
            BARE: "Reader.messages and deserialize_cdr; results are discarded",
            OURS: "into a dataset: decoded, checked and mapped to a layout",
            "share": f"of the messages/s of {BARE}",
        },
        bars("messages/s"),
    )
    rng = np.random.default_rng(0)
    points = rng.uniform(1, 600, (messages, len(CMU31), 2))
    with tempfile.TemporaryDirectory() as folder:
        for storage in STORAGES:
            bag = Path(folder) / storage
            write_bag(bag, TOPIC, frames(points, np.ones(points.shape[:2])), storage)
            durations = interleaved(readers(bag), rounds, 0, warm_up=1)
            rates = {by: messages / np.median(seconds) for by, seconds in durations.items()}
            for by, rate in rates.items():
                figures = {"messages/s": float(rate), "share": float(rate / rates[BARE])}
                table.add((storage, by), figures)
    yield table


def readers(bag: Path) -> dict[str, Callable[[], int]]:
    """Return reader -> function that reads the bag and returns the number of messages."""

    def ours() -> int:
        return read_bags([bag], CMU31, CMU31, ReadOptions(TOPIC)).messages

    return {BARE: lambda: decode(bag), OURS: ours}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    args = speed_parser(__doc__).parse_args(argv)
    print_and_write(benchmark(args), args.output)


if __name__ == "__main__":
    require_one_thread()
    main()
