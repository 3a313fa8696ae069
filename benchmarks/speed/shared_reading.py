# SPDX-License-Identifier: Apache-2.0
"""Frames per second that processes of a training read from a bag, and memory of a large training.

Each process reads its own share of the bag. The rate is all frames over the processor time of the
slowest process, which does not depend on what else the machine does. `--curation` measures the
curation alone, for more and more frames. With `--long` a training reads, curates and learns ten
million frames.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.speed.timing import print_and_write, speed_parser
from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.bags import Frame, read_bags, write_bag
from deep_nrsfm_ros.data.curation import curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.share import Share
from deep_nrsfm_ros.large_arrays import empty, release
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras

TOPIC = "/keypoints"
LARGE = 10_000_000
"""Frames of the large training."""
_BASE = 20_000  # different frames, which are repeated with noise
_NOISE = 3.0  # pixels, of an object of about 200
_MIB = 2**20


def repeated_frames(frames: int, objects: int) -> Iterator[Frame]:
    """Yield messages of so many objects, repeated with noise until there are enough frames."""
    rng = np.random.default_rng(0)
    shapes = rng.standard_normal((17, 3)) + 0.2 * rng.standard_normal((_BASE, 17, 3))
    base = 100 * (centre(shapes) @ random_cameras(_BASE, rng)) + 400
    for message in range(frames // objects):
        rows = (message * objects + np.arange(objects)) % _BASE
        points = base[rows] + _NOISE * rng.standard_normal((objects, 17, 2))
        yield Frame(message * 10_000_000, points.astype(np.float32), np.ones((objects, 17)))


def rate(bag: Path, frames: int, processes: int) -> float:
    """Return the frames per second of processor time that processes read together."""
    command = [sys.executable, "-m", "benchmarks.speed.shared_reading", "--bag", str(bag)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    seconds: list[float] = []
    for index in range(processes):  # one after the other, since their times do not depend on it
        words = [*command, "--share", str(index), str(processes)]
        ended = subprocess.run(
            words, env=environment, stdout=subprocess.PIPE, text=True, check=True
        )
        seconds.append(json.loads(ended.stdout))
    return float(frames / max(seconds))


def read_share(bag: Path, share: Share) -> float:
    """Read a share of a bag; return the seconds of processor time."""
    began = time.process_time()
    read_bags([bag], HUMAN17, HUMAN17, ReadOptions(TOPIC), share=share)
    return time.process_time() - began


def large_training(bag: Path, frames: int, folder: Path) -> list[str]:
    """Return the arguments of the program `train` for a bag of `repeated_frames`."""
    words = ["--bag", str(bag), "--object", HUMAN17.name, "--from", "none", "--name", "large"]
    words += ["--steps", "300", "--seeds", "1", "--threads", "1"]
    return [*words, "--max-frames", str(frames), "--output", str(folder)]


def train(bag: Path, frames: int, folder: Path) -> tuple[float, float]:
    """Train on a bag by the program; return peak resident memory in MiB and seconds of CPU time."""
    words = large_training(bag, frames, folder)
    command = [sys.executable, "-m", "deep_nrsfm_ros", "train", *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise ValueError(f"the training of {frames} frames ended with {process.returncode}")
    return usage.ru_maxrss / 1024, usage.ru_utime + usage.ru_stime


def curation(counts: Sequence[int]) -> Iterator[Table]:
    """Yield the table of the time and memory of the curation of these numbers of frames."""
    table = Table(
        "curation",
        f"Curation of frames of {len(HUMAN17)} keypoints, one thread",
        ("frames",),
        ("us a frame", "peak MiB", "dataset MiB"),
        {
            "us a frame": "processor time",
            "peak MiB": "resident, of the whole process, pages of temporary files included",
        },
        bars("us a frame"),
    )
    for count in sorted(counts):
        points = empty((count, len(HUMAN17), 2), np.float32)
        visible = empty(points.shape[:2], bool)
        visible[:] = True
        for i, frame in enumerate(repeated_frames(count, 1000)):
            points[1000 * i : 1000 * (i + 1)] = frame.points
        release((points, visible))
        began = time.process_time()
        curate(Dataset(points, visible, HUMAN17, "made"))
        seconds = time.process_time() - began
        figures = {
            "us a frame": 1e6 * seconds / count,
            "peak MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "dataset MiB": (points.nbytes + visible.nbytes) / _MIB,
        }
        table.add((str(count),), figures)
        release((points, visible))
    yield table


def benchmark(args: Namespace) -> Iterator[Table]:
    """Yield the table of rates, and with `--long` that of the large training."""
    table = Table(
        "shared_reading",
        f"Reading frames of {len(HUMAN17)} keypoints from a bag",
        ("objects a message", "frames", "processes"),
        ("frames/s", "ratio"),
        {"frames/s": "all frames over the processor time of the slowest process"},
        bars("frames/s"),
    )
    with tempfile.TemporaryDirectory() as folder:
        for objects, frames in ((1, 60_000), (100, 1_000_000)):
            frames //= 100 if args.quick else 1
            bag = Path(folder) / f"of_{objects}"
            write_bag(bag, TOPIC, repeated_frames(frames, objects))
            alone = rate(bag, frames, 1)
            for processes in (1, 2):
                measured = alone if processes == 1 else rate(bag, frames, processes)
                figures = {"frames/s": measured, "ratio": measured / alone}
                table.add((str(objects), str(frames), str(processes)), figures)
        yield table
        if args.long:
            bag = Path(folder) / "large"
            write_bag(bag, TOPIC, repeated_frames(args.frames, 1000))
            memory, seconds = train(bag, args.frames, Path(folder))
            large = Table(
                "large_training",
                "A training beyond what memory should hold",
                ("frames",),
                ("peak MiB", "dataset MiB", "CPU s"),
                {"peak MiB": "resident, pages of temporary files included"},
                bars("peak MiB"),
            )
            size = args.frames * len(HUMAN17) * 9 / _MIB
            figures = {"peak MiB": memory, "dataset MiB": size, "CPU s": seconds}
            large.add((str(args.frames),), figures)
            yield large


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = speed_parser(__doc__)
    parser.add_argument("--long", action="store_true", help="also the large training: 15 minutes")
    parser.add_argument(
        "--frames", type=int, default=LARGE, help="of the large training (default: %(default)s)"
    )
    parser.add_argument(
        "--curation", type=int, nargs="+", help="the curation of these thousands of frames alone"
    )
    parser.add_argument("--bag", type=Path, help="internal: read a share of this bag")
    parser.add_argument("--share", type=int, nargs=2, help="internal: process, processes")
    args = parser.parse_args(argv)
    if args.bag:
        print(json.dumps(read_share(args.bag, Share(*args.share))))
    elif args.curation:
        print_and_write(curation([1000 * each for each in args.curation]), args.output)
    else:
        print_and_write(benchmark(args), args.output)


if __name__ == "__main__":
    main()
