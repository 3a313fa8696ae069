# SPDX-License-Identifier: Apache-2.0
"""Time and memory of curation and one epoch against the number of frames."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.speed.timing import print_and_write, process_memory, speed_parser
from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.curation import curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.nrsfm.recipe import PRESETS

EXPONENT = "exponent"


def table(measured: Sequence[dict[str, float]]) -> Table:
    """Return the table of the results of `measure`, with the exponents of the times."""
    grows = ("curation s", "preparation s", "epoch s")
    result = Table(
        "training_scale",
        "Training against the number of frames, default recipe, one thread",
        ("frames",),
        (*grows, "dataset MB", "curation / dataset", "training / dataset"),
        {
            "curation s": "from the raw to the curated dataset",
            "preparation s": "from the curated dataset to the first step",
            "epoch s": "steps that draw as many frames as the dataset has",
            "curation / dataset": "peak resident memory of curation, the dataset included, less "
            "the memory before the dataset was made, over the size of its arrays",
            "training / dataset": "the same of the training on the curated dataset; a small "
            "training runs first, so that libraries are not counted",
            EXPONENT: "e in time = c frames^e, least squares of the logarithms; 1 is linear",
        },
        bars("training / dataset"),
    )
    for row in measured:
        figures = {name: value for name, value in row.items() if name != "frames"}
        result.add((f"{row['frames']:.0f}",), figures)
    if len(measured) > 1:
        frames = np.log([row["frames"] for row in measured])
        exponents = {
            name: float(np.polyfit(frames, np.log([row[name] for row in measured]), 1)[0])
            for name in grows
        }
        result.add((EXPONENT,), exponents)
    return result


def measure(f: int) -> dict[str, float]:
    """Curate and train for one epoch on f random frames; return the figures."""
    import torch

    from deep_nrsfm_ros.training.loop import Callbacks, train
    from deep_nrsfm_ros.training.trainer import Trainer

    torch.set_num_threads(1)
    base, times = PRESETS["default"], [0.0]

    def epoch(dataset: Dataset) -> None:
        steps = max(2, len(dataset) // base.recipe.batch)
        recipe = dataclasses.replace(base.recipe, steps=steps, seeds=1)

        def store_time(trainer: Trainer) -> None:
            if trainer.step in (0, steps):
                times.append(time.perf_counter())

        times[:] = [time.perf_counter()]
        preset = base._replace(recipe=recipe)
        train(dataset.points, dataset.visible, preset, callbacks=Callbacks(on_step=store_time))

    epoch(curate(_random_dataset(10 * base.recipe.batch)).dataset)
    before = process_memory()
    dataset = _random_dataset(f)
    size = (dataset.points.nbytes + dataset.visible.nbytes) / 2**20
    reset_peak_memory()
    started = time.perf_counter()
    dataset = curate(dataset).dataset
    curated, curation = time.perf_counter() - started, process_memory(field="VmHWM") - before
    reset_peak_memory()
    epoch(dataset)
    started_at, first_step_at, ended_at = times
    return {
        "frames": f,
        "curation s": curated,
        "preparation s": first_step_at - started_at,
        "epoch s": ended_at - first_step_at,
        "dataset MB": size,
        "curation / dataset": curation / size,
        "training / dataset": (process_memory(field="VmHWM") - before) / size,
    }


def _random_dataset(f: int) -> Dataset:
    """Return f random frames."""
    points = np.random.default_rng(0).standard_normal((f, len(CMU31), 2), dtype=np.float32)
    return Dataset(points, np.ones(points.shape[:2], bool), CMU31, "random")


def reset_peak_memory() -> None:
    """Reset VmHWM, the peak resident memory, of this process."""
    Path("/proc/self/clear_refs").write_text("5")


def benchmark(args: Namespace) -> Iterator[Table]:
    """Measure each number of frames in a process of its own; yield the table."""
    counts = [1000, 4000] if args.quick else [10_000, 100_000]
    counts += [1_000_000] * args.long
    measurements = []
    for count in counts:
        command = [sys.executable, "-m", "benchmarks.speed.training_scale", "--frames", str(count)]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        ended_at = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, text=True, check=True
        )
        measurements.append(json.loads(ended_at.stdout))
    yield table(measurements)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = speed_parser(__doc__)
    parser.add_argument(
        "--long", action="store_true", help="a million frames as well: about two minutes more"
    )
    parser.add_argument("--frames", type=int, help="internal: measure this number of frames")
    args = parser.parse_args(argv)
    if args.frames:
        print(json.dumps(measure(args.frames)))
    else:
        print_and_write(benchmark(args), args.output)


if __name__ == "__main__":
    main()
