# SPDX-License-Identifier: Apache-2.0
"""Wall time until the shape error on subject 01 is that of the paper, by both presets.

`--limit-minutes` ends a long training; its time and the ratio are then lower bounds.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from tqdm import tqdm

from benchmarks.paper.table1_cmu import PAPER
from benchmarks.speed.timing import print_and_write, speed_parser
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.evaluate import ALONE, CONVENTIONS, evaluate, figures
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Preset
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.loop import Callbacks, train
from deep_nrsfm_ros.training.steps import with_steps
from deep_nrsfm_ros.training.trainer import Trainer

METRIC = "shape %"
TARGET = PAPER["Deep NRSfM"]["01"][METRIC]


class Contender(NamedTuple):
    """A preset, and the lifting options with which its error is measured."""

    preset: str
    lifting: LiftingOptions
    interval: int  # steps between measurements of the error


CONTENDERS = {
    "paper": Contender("paper", ALONE, 2000),
    "default, network alone": Contender("default", ALONE, 250),
    "default, as shipped": Contender("default", LiftingOptions(), 250),
}


class TimedTraining:
    """One training whose error is measured until it is low enough.

    Attributes:
        best: lowest error so far in %.
        steps: step of the last measurement.
        reached: whether the target was reached.
        seconds: wall time of training, without measuring the error.
    """

    def __init__(self, contender: Contender, dataset: Dataset, stride: int, limit: float) -> None:
        """Measure on every `stride`-th frame; stop after `limit` seconds of training."""
        self.contender, self.dataset, self.limit = contender, dataset, limit
        self.measured_frames = dataset[::stride]
        self.best, self.steps, self.reached = math.inf, 0, False
        self.seconds = 0.0
        self._measuring, self._started = 0.0, time.perf_counter()

    def run(self, preset: Preset, target: float) -> None:
        """Train until the error is at most `target`, or until the limit or the last step."""
        self._started = time.perf_counter()
        with tqdm(total=preset.recipe.steps, desc=self.contender.preset) as bar:

            def measure_error(trainer: Trainer) -> None:
                if not trainer.step or trainer.step % self.contender.interval:
                    return
                self.seconds = time.perf_counter() - self._started - self._measuring
                model = finish(trainer, self.contender.preset, CMU31, self.dataset.source)
                error = figures(evaluate(model, self.measured_frames, self.contender.lifting))[
                    METRIC
                ]
                self.best, self.steps = min(self.best, error), trainer.step
                self.reached = error <= target
                self._measuring = time.perf_counter() - self._started - self.seconds
                bar.set_postfix_str(f"{error:.2f} %, {self.seconds:.0f} s")
                bar.update(trainer.step - bar.n)

            train(
                self.dataset.points,
                self.dataset.visible,
                preset,
                callbacks=Callbacks(
                    on_step=measure_error,
                    should_stop=lambda: self.reached or self._training_seconds() > self.limit,
                ),
            )
        if not self.reached:
            self.seconds = self._training_seconds()

    def _training_seconds(self) -> float:
        """Return the seconds of training so far."""
        return time.perf_counter() - self._started - self._measuring


def tabulate(trainings: dict[str, TimedTraining], target: float, threads: int) -> Table:
    """Return the table of trainings; ratios are to the training `paper`."""
    table = Table(
        "time_to_error",
        f"Wall time to the paper's {target:.2f} % on subject 01, {threads} thread(s)",
        ("recipe", "reached"),
        ("wall s", "steps", f"best {METRIC}", "paper / this"),
        {
            "reached": "no: the time limit or the last step came first; time and ratios "
            "to it are lower bounds",
            "wall s": "training, the screening of seeds included, without measuring the error",
            "steps": "at the last measurement; steps of screened seeds are not counted",
            METRIC: CONVENTIONS[METRIC],
            "paper / this": "ratio of wall times; empty where the error was not reached",
            "default, network alone": "one pass of the network, as for the paper's",
        },
        bars("wall s"),
    )
    for name, training in trainings.items():
        row = {
            "wall s": training.seconds,
            "steps": float(training.steps),
            f"best {METRIC}": training.best,
        }
        if training.reached:
            row["paper / this"] = trainings["paper"].seconds / training.seconds
        table.add((name, "yes" if training.reached else "no"), row)
    return table


def benchmark(args: Namespace) -> Iterator[Table]:
    """Run all trainings, the short ones first; yield the table."""
    torch.set_num_threads(args.threads)
    stride = 50 if args.quick else 1
    dataset = read_split(TrialSelection(args.data / "cmu", ("01",), stride=stride), CMU31)
    trainings: dict[str, TimedTraining] = {}
    for name, contender in reversed(CONTENDERS.items()):
        base = PRESETS[contender.preset]
        steps = 10 if args.quick else None
        if args.steps and contender.preset == "default":
            steps = args.steps
        contender = contender._replace(interval=5) if args.quick else contender
        training = TimedTraining(contender, dataset, args.stride, 60 * args.limit_minutes)
        recipe = dataclasses.replace(base.recipe, steps=steps) if steps else base.recipe
        recipe = with_steps(recipe, len(dataset), None)
        training.run(base._replace(recipe=recipe), args.error)
        trainings[name] = training
    yield tabulate(trainings, args.error, args.threads)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command; exit code 2 for bad input."""
    parser = speed_parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds cmu/")
    parser.add_argument("--error", type=float, default=TARGET, help="shape error to reach, %%")
    parser.add_argument(
        "--stride", type=int, default=20, help="measure the error on every n-th frame"
    )
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument(
        "--limit-minutes",
        type=float,
        default=math.inf,
        help="limit of the wall time of each training",
    )
    parser.add_argument(
        "--steps", type=int, help="length of the default recipe, for a shorter schedule"
    )
    args = parser.parse_args(argv)
    try:
        print_and_write(benchmark(args), args.output)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
