# SPDX-License-Identifier: Apache-2.0
"""Latency of the lifter over DDS, idle and during a training."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.speed.timing import random_domain
from deep_nrsfm_ros.commands.demo.client import Client, DemoError, Played, lifter
from deep_nrsfm_ros.data.bags import frames, write_bag
from deep_nrsfm_ros.layouts.presets import HUMAN25
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras
from deep_nrsfm_ros.training.job import ENDED

CAMERA = "camera"
PERCENTILES = (50.0, 99.0)


def write_keypoints(bag: Path, rate: float, seconds: float) -> None:
    """Write keypoints of a randomly deforming object; the values do not change the time."""
    rng = np.random.default_rng(0)
    f, p = round(rate * seconds), len(HUMAN25)
    shapes = centre(rng.standard_normal((p, 3)) + 0.3 * rng.standard_normal((f, p, 3)))
    points = 100 * (shapes @ random_cameras(f, rng)) + [320, 240]
    write_bag(bag, "/keypoints", frames(points, np.ones((f, p)), rate, CAMERA))


@contextmanager
def connected(folder: Path) -> Iterator[Client]:
    """Yield a client of a lifter whose training on the bag in `folder` does not end."""
    bag = folder / "keypoints"
    parameters = {
        "models_dir": folder,
        "train.bags": f"[{bag}]",
        "train.topic": "/keypoints",
        "train.steps": 10_000_000,
        "train.seeds": 1,
    }
    with (
        lifter(parameters, folder / "log") as process,
        Client(process, bag, folder / "answers") as client,
    ):
        client.meet()
        yield client


def measure(folder: Path, rounds: int) -> dict[str, list[Played]]:
    """Play the bag `rounds` times idle, then `rounds` times during a training."""
    with connected(folder) as client:
        client.play(CAMERA)  # warm up
        idle = [client.play(CAMERA) for _ in range(rounds)]
        client.train()
        while client.training["state"] != "training":
            if client.training["state"] in ENDED:
                raise DemoError(client.training["message"])
            client.wait_a_second()
        return {"idle": idle, "training": [client.play(CAMERA) for _ in range(rounds)]}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command; exit code 1 if the lifter failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=60.0, help="messages per second")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a round")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args(argv)
    os.environ["ROS_DOMAIN_ID"] = str(random_domain())
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_keypoints(folder / "keypoints", args.rate, args.seconds)
        try:
            measured = measure(folder, args.rounds)
        except DemoError as error:
            sys.exit(f"failed: {error}\n{(folder / 'log').read_text()}")
    percentiles = {}
    print("| | sent | answered | p50 ms | p99 ms |\n|---|---|---|---|---|")
    for name, rounds in measured.items():
        latencies = 1e3 * np.concatenate([played.latencies for played in rounds])
        sent = sum(len(played.stamps) for played in rounds)
        p50, p99 = percentiles[name] = np.percentile(latencies, PERCENTILES)
        print(f"| {name} | {sent} | {len(latencies)} | {p50:.2f} | {p99:.2f} |")
    ratio = percentiles["training"] / percentiles["idle"]
    print(f"| training / idle | | | {ratio[0]:.2f} | {ratio[1]:.2f} |")


if __name__ == "__main__":
    main()
