# SPDX-License-Identifier: Apache-2.0
"""Training samples per second, against plain torch, and the gain from two torchrun processes."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from benchmarks.speed.plain_torch import PlainTraining
from benchmarks.speed.timing import interleaved, print_and_write, speed_parser
from benchmarks.table import Table, bars
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.nrsfm.layout_loss import LayoutLoss
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, LayoutLossWeights, Preset
from deep_nrsfm_ros.training.distributed import join
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.setup import Setup
from deep_nrsfm_ros.training.trainer import Trainer

P = 31
BATCH = 64
OURS, PLAIN = "ours", "plain torch"
LEGEND = {
    "samples/s": f"frames per second of training steps, batch {BATCH}; frames of the cycle loss "
    "are not counted",
    "ratio": f"to {PLAIN}: above 1 is faster",
    PLAIN: "one convolution per layer, SVD, autograd, torch.optim.Adam with one tensor per "
    "weight; the cycle loss by a second pass, where ours uses the shapes of the previous batch",
    "network": "default: the default recipe; default, bones: with bone_length_weight 1; paper: its "
    "12 dictionaries and its loss, the same batch",
}
CASES = {"default": ("default", 0.0), "default, bones": ("default", 1.0), "paper": ("paper", 0.0)}
"""Preset and bone_length_weight of each case of the table."""


def preset(name: str, batch: int) -> Preset:
    """Return the preset `name` with the batch size `batch`."""
    base = PRESETS[name]
    return base._replace(recipe=dataclasses.replace(base.recipe, batch=batch))


def frames(f: int) -> FrameStore:
    """Return f random frames; the values do not change the time."""
    points = np.random.default_rng(0).standard_normal((f, P, 2), dtype=np.float32)
    return FrameStore.of(points, np.ones((f, P), bool))


def contenders(case: str, data: FrameStore) -> tuple[Trainer, PlainTraining]:
    """Return our trainer and plain torch, with the same weights and losses."""
    name, bone_length_weight = CASES[case]
    weights = LayoutLossWeights(bone_length_weight=bone_length_weight)
    layout_loss = LayoutLoss(weights, CMU31) if bone_length_weight else None
    chosen = preset(name, BATCH)
    ours = Trainer(data, chosen, 0, Setup(layout_loss=layout_loss))
    return ours, PlainTraining(ours.net, data.points, chosen, layout_loss)


def steps(args: Namespace) -> Table:
    """Return the table of samples per second of one process."""
    rounds, seconds = (1, 0.02) if args.quick else (5, 2.0)
    table = Table(
        "training_speed",
        "Training samples per second of one process",
        ("network", "threads", "by"),
        ("samples/s", "ratio"),
        LEGEND,
        bars("ratio"),
    )
    before, data = torch.get_num_threads(), frames(200 if args.quick else 10_000)
    for case in CASES:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            ours, plain = contenders(case, data)
            calls = {PLAIN: plain.advance, OURS: ours.advance}
            rates = {n: BATCH / t.mean() for n, t in interleaved(calls, rounds, seconds).items()}
            for by, rate in rates.items():
                figures = {"samples/s": float(rate), "ratio": float(rate / rates[PLAIN])}
                table.add((case, str(threads), by), figures)
    torch.set_num_threads(before)
    return table


def torchrun_table() -> Table:
    """Return the table of one and two torchrun processes that share the same batch."""
    rounds, seconds = 3, 3.0
    table = Table(
        "torchrun",
        "Training samples per second of torchrun, the default recipe, one thread per process",
        ("batch", "processes"),
        ("samples/s", "ratio"),
        {"samples/s": "of all processes together; they share the batch", "ratio": "to one process"},
        bars("ratio"),
    )
    for batch in (BATCH, 256, 1024):
        rates_by_processes: dict[int, list[float]] = {1: [], 2: []}
        for _ in range(rounds):
            for processes, rates in rates_by_processes.items():
                rates.append(torchrun_rate(processes, batch, seconds))
        for processes, rates in rates_by_processes.items():
            rate, single = np.median(rates), np.median(rates_by_processes[1])
            figures = {"samples/s": float(rate), "ratio": float(rate / single)}
            table.add((str(batch), str(processes)), figures)
    return table


def torchrun_rate(processes: int, batch: int, seconds: float) -> float:
    """Return the samples per second of `processes` processes that share a batch."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += [f"--nproc-per-node={processes}", "-m", "benchmarks.speed.training_speed"]
    command += ["--worker-batch", str(batch), "--seconds", str(seconds)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout)


def torchrun_worker(batch: int, seconds: float) -> None:
    """Train as one of the processes started by torchrun; rank 0 prints the samples per second."""
    torch.set_num_threads(1)
    group = join()
    trainer = Trainer(frames(10_000), preset("default", batch), 0, Setup(group=group))
    (durations,) = interleaved({"": trainer.advance}, 8, 0.0).values()
    # All processes take the number of steps of rank 0, or they would wait for each other.
    steps = group.broadcast(max(1, round(seconds / float(np.median(durations)))))
    began = time.perf_counter()
    for _ in range(steps):
        trainer.advance()
    if not group.rank:
        print(steps * batch / (time.perf_counter() - began))
    group.close()


def benchmark(args: Namespace) -> Iterator[Table]:
    """Yield the table of one process and, without --quick, the table of torchrun."""
    yield steps(args)
    if not args.quick:
        yield torchrun_table()


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = speed_parser(__doc__)
    parser.add_argument(
        "--worker-batch", type=int, help="internal: batch of a process started by torchrun"
    )
    parser.add_argument("--seconds", type=float, default=3.0, help="internal: its duration")
    args = parser.parse_args(argv)
    if args.worker_batch:
        torchrun_worker(args.worker_batch, args.seconds)
    else:
        print_and_write(benchmark(args), args.output)


if __name__ == "__main__":
    main()
