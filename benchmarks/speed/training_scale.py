"""Training as the frames grow: time of curation and an epoch, and memory over the dataset's."""

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

from benchmarks.speed.timing import arguments, show
from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.curation import curate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.nrsfm.recipe import PRESETS

EXPONENT = "exponent"


def table(measured: Sequence[dict[str, float]]) -> Table:
    """Return the table of what `measure` found, and the exponents of what grows."""
    grows = ("curation s", "preparation s", "epoch s")
    result = Table(
        "training_scale",
        "Training as the frames grow, the default recipe, one thread",
        ("frames",),
        (*grows, "dataset MB", "curation / dataset", "training / dataset"),
        {
            "curation s": "from the dataset to one that is fit to be trained on",
            "preparation s": "from there to the first step",
            "epoch s": "as many steps as it takes to draw as many frames as there are",
            "curation / dataset": "the most resident memory while it is curated, the dataset "
            "included, less what there was before that was made, over the size of its arrays",
            "training / dataset": "likewise of the training, which has the curated dataset; a "
            "small training has gone before, so that libraries are not counted",
            EXPONENT: "e of time = c frames^e, least squares of the logarithms: 1 is linear",
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
    """Train for an epoch on f frames in this process."""
    import torch

    from deep_nrsfm_ros.training.loop import Callbacks, train
    from deep_nrsfm_ros.training.trainer import Trainer

    torch.set_num_threads(1)
    base, times = PRESETS["default"], [0.0]

    def epoch(dataset: Dataset) -> None:
        steps = max(2, len(dataset) // base.recipe.batch)
        recipe = dataclasses.replace(base.recipe, steps=steps, seeds=1)

        def note(trainer: Trainer) -> None:
            if trainer.step in (0, steps):
                times.append(time.perf_counter())

        times[:] = [time.perf_counter()]
        preset = base._replace(recipe=recipe)
        train(dataset.points, dataset.visible, preset, callbacks=Callbacks(on_step=note))

    epoch(curate(_ensemble(10 * base.recipe.batch)).dataset)
    before = memory("VmRSS")
    dataset = _ensemble(f)
    size = (dataset.points.nbytes + dataset.visible.nbytes) / 2**20
    forget_peak()
    started = time.perf_counter()
    dataset = curate(dataset).dataset
    curated, curation = time.perf_counter() - started, memory("VmHWM") - before
    forget_peak()
    epoch(dataset)
    began, ready, done = times
    return {
        "frames": f,
        "curation s": curated,
        "preparation s": ready - began,
        "epoch s": done - ready,
        "dataset MB": size,
        "curation / dataset": curation / size,
        "training / dataset": (memory("VmHWM") - before) / size,
    }


def _ensemble(f: int) -> Dataset:
    """Return f frames of no shape in particular."""
    points = np.random.default_rng(0).standard_normal((f, len(CMU31), 2), dtype=np.float32)
    return Dataset(points, np.ones(points.shape[:2], bool), CMU31, "chance")


def memory(what: str) -> float:
    """Return this process's VmRSS (resident) or VmHWM (the most that was) in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(what)) / 1024


def forget_peak() -> None:
    """Let VmHWM begin anew."""
    Path("/proc/self/clear_refs").write_text("5")


def benchmark(given: Namespace) -> Iterator[Table]:
    """Measure each number of frames in a process of its own."""
    counts = [1000, 4000] if given.quick else [10_000, 100_000]
    counts += [1_000_000] * given.long
    found = []
    for count in counts:
        command = [sys.executable, "-m", "benchmarks.speed.training_scale", "--frames", str(count)]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, text=True, check=True
        )
        found.append(json.loads(done.stdout))
    yield table(found)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = arguments(__doc__)
    parser.add_argument("--long", action="store_true", help="a million frames as well: minutes")
    parser.add_argument("--frames", type=int, help="what a process of its own is asked for")
    given = parser.parse_args(argv)
    if given.frames:
        print(json.dumps(measure(given.frames)))
    else:
        show(benchmark(given), given.output)


if __name__ == "__main__":
    main()
