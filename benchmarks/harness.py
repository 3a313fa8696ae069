"""What the benchmarks share: their command line, the motion capture, and trainings kept."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from benchmarks.table import Table
from deep_nrsfm_ros import __version__
from deep_nrsfm_ros.commands.evaluate import evaluate, figures, read_split
from deep_nrsfm_ros.nrsfm.keypoints import CMU31
from deep_nrsfm_ros.nrsfm.lifting import LiftingOptions
from deep_nrsfm_ros.nrsfm.model_file import MODEL_SUFFIX, Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Preset
from deep_nrsfm_ros.nrsfm.training import finish, read_checkpoint, train
from deep_nrsfm_ros.observations.ensemble import Ensemble

SNAPSHOTS = 10
"""Models kept of each training, evenly spaced; the last is its result."""
LIFTING_LEGEND = {
    "network alone": "one pass of the network, nothing after it",
    "back-projected": "one pass, then moved within the image plane onto the keypoints",
    "as shipped": f"averaged over {LiftingOptions().turns} turns of the image, back-projected",
}


@dataclass(frozen=True)
class Session:
    """What a benchmark was asked for."""

    data: Path  # holds cmu/NN/NN.asf and NN_MM.amc
    output: Path
    subjects: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int | None  # instead of the presets'
    stride: int  # every n-th frame

    def mocap(self, subjects: Sequence[str], split: str) -> Ensemble:
        """Return the trials "train", "held-out" or "all" of CMU subjects, with ground truth."""
        return _mocap(self.data / "cmu", tuple(subjects), split, self.stride)

    def preset(self, name: str, seed: int, **recipe: Any) -> Preset:
        """Return a preset with its seed and other fields of its recipe set."""
        if self.steps:
            recipe["steps"] = self.steps
        base = PRESETS[name]
        return base._replace(recipe=dataclasses.replace(base.recipe, seed=seed, **recipe))

    def trained(self, title: str, ensemble: Ensemble, preset: Preset) -> Model:
        """Return the trained model, from the output folder if it is there."""
        return self.snapshots(title, ensemble, preset)[-1]

    def snapshots(self, title: str, ensemble: Ensemble, preset: Preset) -> list[Model]:
        """Return the model along its training, its result last; what is there is not trained again.

        An interrupted training goes on from its checkpoint. The folder's name tells everything
        that shapes the model: `title` for people, a hash of frames, preset and version.
        """
        folder = self.output / "models" / f"{title.replace(' ', '-')}-{_hash(ensemble, preset)}"
        folder.mkdir(parents=True, exist_ok=True)
        steps, models = preset.recipe.steps, list[Model]()
        # Seeds are screened in one go: a training that stops for a snapshot would choose early.
        pieces = SNAPSHOTS if preset.recipe.seeds == 1 else 1
        with tqdm(total=steps, desc=title, dynamic_ncols=True) as bar:
            for step in sorted({-(-steps * i // pieces) for i in range(1, pieces + 1)}):
                path = folder / f"{step:07}{MODEL_SUFFIX}"
                if not path.exists():
                    model = _train_on(title, ensemble, preset, step, folder / "checkpoint", bar)
                    save_model(path, model)
                models.append(load_model(path))
                bar.update(step - bar.n)
        (folder / "checkpoint").unlink(missing_ok=True)
        return models


@cache
def _mocap(folder: Path, subjects: tuple[str, ...], split: str, stride: int) -> Ensemble:
    with tqdm(desc=f"reading {' '.join(subjects)}", leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return read_split(folder, subjects, split, CMU31, stride=stride, on_progress=show)


def _hash(ensemble: Ensemble, preset: Preset) -> str:
    """Return what tells a training from all others, in ten digits."""
    digest = hashlib.sha256(f"{__version__} {preset}".encode())
    digest.update(ensemble.points.tobytes())
    digest.update(ensemble.visible.tobytes())
    return digest.hexdigest()[:10]


def _train_on(
    title: str, ensemble: Ensemble, preset: Preset, step: int, checkpoint: Path, bar: tqdm[Any]
) -> Model:
    """Return the model at `step`, trained on from `checkpoint`."""
    start = int(read_checkpoint(checkpoint)["step"]) if checkpoint.exists() else 0
    last = step == preset.recipe.steps
    # `train` asks once a step.
    asked = repeat(False) if last else chain(repeat(False, step - start), repeat(True))
    trainer = train(
        ensemble.points,
        ensemble.visible,
        preset,
        on_progress=lambda progress: _show(bar, progress.step, progress.loss, progress.cycle_error),
        should_stop=asked.__next__,
        checkpoint=checkpoint,
    )
    return finish(trainer, title, ensemble.layout, ensemble.source)


def _show(bar: tqdm[Any], step: int, loss: float, cycle: float) -> None:
    bar.set_postfix_str(f"loss {loss:.3f}, cycle error {cycle:.3f}", refresh=False)
    bar.update(step - bar.n)


def in_pairs(columns: Iterable[str]) -> list[str]:
    """Return the columns of `across`."""
    return [name for column in columns for name in (column, f"{column} proper")]


def across(
    tests: Mapping[str, tuple[Model, Ensemble]], options: LiftingOptions
) -> dict[str, float]:
    """Return shape error and proper error (%) of a model on a test for each column."""
    row: dict[str, float] = {}
    for column, (model, ensemble) in tests.items():
        found = figures(evaluate(model, ensemble, options))
        row |= {column: found["shape %"], f"{column} proper": found["proper %"]}
    return row


def command(
    benchmark: Callable[[Session], Table],
    description: str | None,
    subjects: Sequence[str],
    argv: Sequence[str] | None = None,
) -> None:
    """Run a benchmark as a program: options in, its table out; exit code 2 for bad input."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds cmu/")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument("--subjects", nargs="+", default=list(subjects), help="CMU subjects")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--steps", type=int, help="train for so many steps only: a quick look")
    parser.add_argument("--stride", type=int, default=1, help="take every n-th frame only")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    given = parser.parse_args(argv)
    torch.set_num_threads(given.threads)
    session = Session(
        *(given.data, given.output, tuple(given.subjects), tuple(given.seeds)),
        *(given.steps, given.stride),
    )
    try:
        table = benchmark(session)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    print(table.markdown())
    table.write(session.output)
