"""Samples a second of training: ours against torch as the paper writes it, and torchrun's gain."""

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
from benchmarks.speed.timing import arguments, by_turns, show
from benchmarks.table import Table, bars
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Preset
from deep_nrsfm_ros.training.distributed import join
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.trainer import Trainer

P = 31
BATCH = 64
OURS, PLAIN = "ours", "plain torch"
LEGEND = {
    "samples/s": f"frames that training steps take in, batch {BATCH}; the cycle loss's are not "
    "counted",
    "ratio": f"to {PLAIN}: above 1 is faster",
    PLAIN: "a convolution a layer, SVD, autograd, torch.optim.Adam with a tensor a weight; the "
    "cycle loss of the default by a second pass, where ours takes the shapes of the batch before",
    "network": "default: the default recipe; paper: its 12 dictionaries and its loss, the batch "
    "as above",
}


def preset(name: str, batch: int) -> Preset:
    """Return a preset with another batch."""
    base = PRESETS[name]
    return base._replace(recipe=dataclasses.replace(base.recipe, batch=batch))


def frames(f: int) -> FrameStore:
    """Return f frames of no shape in particular; their values cost no time."""
    points = np.random.default_rng(0).standard_normal((f, P, 2), dtype=np.float32)
    return FrameStore.of(points, np.ones((f, P), bool))


def contenders(name: str, data: FrameStore) -> tuple[Trainer, PlainTraining]:
    """Return both, with the same weights."""
    chosen = preset(name, BATCH)
    ours = Trainer(data, chosen, 0)
    return ours, PlainTraining(ours.net, data.points, chosen)


def steps(given: Namespace) -> Table:
    """Return the table of one process."""
    rounds, seconds = (1, 0.02) if given.quick else (5, 2.0)
    table = Table(
        "training_speed",
        "Samples a second of one process",
        ("network", "threads", "by"),
        ("samples/s", "ratio"),
        LEGEND,
        bars("ratio"),
    )
    before, data = torch.get_num_threads(), frames(200 if given.quick else 10_000)
    for name in PRESETS:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            ours, plain = contenders(name, data)
            calls = {PLAIN: plain.advance, OURS: ours.advance}
            rates = {n: BATCH / t.mean() for n, t in by_turns(calls, rounds, seconds).items()}
            for by, rate in rates.items():
                figures = {"samples/s": float(rate), "ratio": float(rate / rates[PLAIN])}
                table.add((name, str(threads), by), figures)
    torch.set_num_threads(before)
    return table


def teams() -> Table:
    """Return the table of torchrun: the same whole batch, shared out."""
    rounds, seconds = 3, 3.0
    table = Table(
        "torchrun",
        "Samples a second of torchrun, the default recipe, one thread a process",
        ("batch", "processes"),
        ("samples/s", "ratio"),
        {"samples/s": "of all together; they share the batch", "ratio": "to one process"},
        bars("ratio"),
    )
    for batch in (BATCH, 256, 1024):
        found: dict[int, list[float]] = {1: [], 2: []}
        for _ in range(rounds):
            for processes, rates in found.items():
                rates.append(team_rate(processes, batch, seconds))
        for processes, rates in found.items():
            rate, alone = np.median(rates), np.median(found[1])
            figures = {"samples/s": float(rate), "ratio": float(rate / alone)}
            table.add((str(batch), str(processes)), figures)
    return table


def team_rate(processes: int, batch: int, seconds: float) -> float:
    """Return the samples a second of so many processes."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += [f"--nproc-per-node={processes}", "-m", "benchmarks.speed.training_speed"]
    command += ["--in-team", str(batch), "--seconds", str(seconds)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout)


def in_team(batch: int, seconds: float) -> None:
    """Train as one process of a team, which torchrun has started; the first prints samples/s."""
    torch.set_num_threads(1)
    team = join()
    trainer = Trainer(frames(10_000), preset("default", batch), 0, team=team)
    (once,) = by_turns({"": trainer.advance}, 8, 0.0).values()
    # All take as many steps as the first can in the time, or they would wait for each other.
    steps = team.tell(max(1, round(seconds / float(np.median(once)))))
    began = time.perf_counter()
    for _ in range(steps):
        trainer.advance()
    if not team.rank:
        print(steps * batch / (time.perf_counter() - began))
    team.leave()


def benchmark(given: Namespace) -> Iterator[Table]:
    """Measure steps of one process, then of two."""
    yield steps(given)
    if not given.quick:
        yield teams()


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = arguments(__doc__)
    parser.add_argument("--in-team", type=int, metavar="BATCH", help="what torchrun starts")
    parser.add_argument("--seconds", type=float, default=3.0, help="of it")
    given = parser.parse_args(argv)
    if given.in_team:
        in_team(given.in_team, given.seconds)
    else:
        show(benchmark(given), given.output)


if __name__ == "__main__":
    main()
