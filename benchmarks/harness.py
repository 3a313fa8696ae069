# SPDX-License-Identifier: Apache-2.0
"""Command line, motion capture and kept trainings of the benchmarks that train on CMU."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.table import Table, print_tables
from deep_nrsfm_ros import __version__
from deep_nrsfm_ros.commands.evaluate import evaluate, figures
from deep_nrsfm_ros.data.dataset import Dataset, concatenate
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split, read_trials, selected_trials
from deep_nrsfm_ros.layouts.presets import CMU31
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.model_file import MODEL_SUFFIX, Model, load_model, save_model
from deep_nrsfm_ros.nrsfm.geometry import random_cameras
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Preset
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.limb_exchange import LimbExchange
from deep_nrsfm_ros.training.loop import Callbacks, Checkpointing, train
from deep_nrsfm_ros.training.progress import Progress
from deep_nrsfm_ros.training.setup import Setup
from deep_nrsfm_ros.training.steps import with_steps
from deep_nrsfm_ros.training.trainer import Trainer

SNAPSHOTS = 10
"""Snapshots kept of each training, evenly spaced; the last is its result."""
CHECKPOINT_SECONDS = 30.0
"""Seconds between checkpoints."""
WITHOUT_EFFECT = {"optimiser": "adam", "error_scale": 1.0}
"""Options whose off value is not zero: with these values a training is what it was without them."""
LIFTING_LEGEND = {
    "network alone": "one pass of the network",
    "back-projected": "one pass, then moved onto the keypoints within the image plane",
    "without bones": f"mean over {LiftingOptions().test_time_rotations} in-plane rotations, then "
    "corrected by the model's error covariance",
    "as shipped": "the same, corrected by the bone lengths of the model as well",
    "as shipped, noise 0": "the same with the option noise = 0, as the keypoints here are exact",
}


@dataclass(frozen=True)
class Session:
    """The options of a benchmark."""

    data: Path  # holds cmu/NN/NN.asf and NN_MM.amc
    output: Path
    subjects: tuple[str, ...]
    seeds: tuple[int, ...]
    steps: int | None  # instead of those of the program or the preset
    stride: int  # every n-th frame
    batches: int = 2  # of 500 frames, on which the baselines are solved; 0: all
    one_camera: bool = False  # for all frames of a trial, not one for each frame
    baselines: tuple[str, ...] | None = None  # words, of which a baseline's name has one; None: all
    error_scale: float | None = None  # instead of that of the presets
    few_frames: int | None = None  # instead of that of the presets; 0: without factorisations
    limb_exchange: float = 0.0  # share of the known shapes in which limbs are exchanged

    def mocap(self, subjects: Sequence[str], split: str) -> Dataset:
        """Return the dataset of the trials "train", "held-out" or "all" of CMU subjects."""
        selection = TrialSelection(self.data / "cmu", tuple(subjects), split, self.stride)
        return _mocap(selection, self.one_camera)

    def preset(self, name: str, seed: int, **recipe: Any) -> Preset:
        """Return the preset `name` with the seed and other fields of the recipe replaced."""
        recipe["start_share"] = 0.0  # without effect, as no training starts from a model
        if self.steps:
            recipe["steps"] = self.steps
        if self.error_scale:
            recipe["error_scale"] = self.error_scale
        if self.few_frames is not None:
            recipe["few_frames"] = self.few_frames
        recipe["limb_exchange"] = self.limb_exchange
        base = PRESETS[name]
        changed = dataclasses.replace(base.recipe, seed=seed, **recipe)
        return base._replace(recipe=with_steps(changed, 0, None))

    def trained(self, title: str, dataset: Dataset, preset: Preset) -> Model:
        """Return the trained model, from the output folder if it exists."""
        return self.snapshots(title, dataset, preset)[-1]

    def snapshots(self, title: str, dataset: Dataset, preset: Preset) -> list[Model]:
        """Return the snapshots of a training, the result last, from the output folder if there.

        An interrupted training continues from its checkpoint. The name of the folder is `title` and
        a hash of frames, preset and version.
        """
        folder = self.output / "models" / f"{title.replace(' ', '-')}-{_hash(dataset, preset)}"
        folder.mkdir(parents=True, exist_ok=True)
        steps = preset.recipe.steps
        snapshot_steps = sorted({-(-steps * i // SNAPSHOTS) for i in range(1, SNAPSHOTS + 1)})
        paths = {step: folder / f"{step:07}{MODEL_SUFFIX}" for step in snapshot_steps}
        if not all(path.exists() for path in paths.values()):
            self._train(title, dataset, preset, paths, folder / "checkpoint")
        return [load_model(path) for path in paths.values()]

    def kept(self, name: str, data: bytes, compute: Callable[[], Any]) -> Any:
        """Return the result of `compute` as JSON gives it back, from the output folder if there.

        Args:
            name: of method and settings.
            data: that the result depends on.
            compute: returns what JSON can hold.
        """
        digest = hashlib.sha256(f"{__version__} {name}".encode() + data).hexdigest()[:10]
        path = self.output / "baselines" / f"{digest}.json"
        if not path.exists():
            result = json.dumps({"name": name, "result": compute()})
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(result)
        return json.loads(path.read_text())["result"]

    @staticmethod
    def _train(
        title: str, dataset: Dataset, preset: Preset, paths: dict[int, Path], checkpoint: Path
    ) -> None:
        """Train; save the model at each step of `paths`."""

        def keep(trainer: Trainer) -> None:
            if trainer.step in paths:
                model = finish(trainer, title, dataset.layout, dataset.source)
                save_model(paths[trainer.step], model)

        with tqdm(total=preset.recipe.steps, desc=title, dynamic_ncols=True) as bar:

            def show(progress: Progress) -> None:
                loss, cycle = progress.loss, progress.cycle_error
                bar.set_postfix_str(f"loss {loss:.3f}, cycle error {cycle:.3f}", refresh=False)
                bar.update(progress.step - bar.n)

            train(
                dataset.points,
                dataset.visible,
                preset,
                Setup(limb_exchange=LimbExchange.of(dataset.layout)),
                callbacks=Callbacks(on_step=keep, on_progress=show),
                checkpointing=Checkpointing(checkpoint, CHECKPOINT_SECONDS),
            )
        checkpoint.unlink(missing_ok=True)


@cache
def _mocap(selection: TrialSelection, one_camera: bool) -> Dataset:
    with tqdm(desc=f"reading {' '.join(selection.subjects)}", leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        if not one_camera:
            return read_split(selection, CMU31, show)
        paths = selected_trials(selection)
        cameras = random_cameras(len(paths), np.random.default_rng(selection.camera_seed))
        trials = []
        for i, (path, M) in enumerate(zip(paths, cameras, strict=True)):
            trial = read_trials([path], CMU31, stride=selection.stride)
            trials.append(dataclasses.replace(trial, points=trial.shapes @ M))
            show(i + 1, len(paths))
        return concatenate(trials)


def _hash(dataset: Dataset, preset: Preset) -> str:
    """Return a hash of dataset, preset and version, ten digits.

    Options that are off or `WITHOUT_EFFECT` do not enter, so that a new one keeps the trainings
    that are there. Nor does `few_frames` of a dataset with more frames.
    """
    recipe = preset.recipe
    if len(dataset) > recipe.few_frames:
        preset = preset._replace(recipe=dataclasses.replace(recipe, few_frames=0))
    options = [
        f"{type(part).__name__}.{name}={value}"
        for part in preset
        for name, value in dataclasses.asdict(part).items()
        if value and WITHOUT_EFFECT.get(name) != value
    ]
    digest = hashlib.sha256(f"{__version__} {options}".encode())
    digest.update(dataset.points.tobytes())
    digest.update(dataset.visible.tobytes())
    return digest.hexdigest()[:10]


def with_proper(columns: Iterable[str]) -> list[str]:
    """Return the columns of `across`."""
    return [name for column in columns for name in (column, f"{column} proper")]


def errors_by_column(
    tests: Mapping[str, tuple[Model, Dataset]], options: LiftingOptions
) -> dict[str, float]:
    """Return shape error and proper error in % for each column.

    Args:
        tests: column -> model and test dataset.
        options: options of lifting.
    """
    row: dict[str, float] = {}
    for column, (model, dataset) in tests.items():
        errors = figures(evaluate(model, dataset, options))
        row |= {column: errors["shape %"], f"{column} proper": errors["proper %"]}
    return row


def model_parser(description: str | None, data: str) -> argparse.ArgumentParser:
    """Return the command line of a benchmark that lifts trials with one model.

    Args:
        description: of the program.
        data: what the folder of data holds.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("model", nargs="?", default="human", help="name or file of a model")
    parser.add_argument("--data", type=Path, required=True, help=f"folder with {data}")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument("--stride", type=int, default=1, help="use every n-th trial or sequence")
    return parser


def run_program(
    benchmark: Callable[[Session], Table],
    description: str | None,
    subjects: Sequence[str],
    argv: Sequence[str] | None = None,
    seeds: Sequence[int] = (0, 1),
    own: argparse.ArgumentParser | None = None,
    content: tuple[str, str] = ("cmu/", "CMU subjects"),
) -> None:
    """Run a benchmark as a program: parse options, print and write its table.

    Exit code 2 for bad input.

    Args:
        benchmark: returns the table of a session.
        description: of the program.
        subjects: default of --subjects.
        argv: the command line without the options of `own`; None: that of the process.
        seeds: default of --seeds.
        own: options of this benchmark alone, which --help lists too.
        content: what --data holds, and what --subjects names.
    """
    holds, named = content
    parser = argparse.ArgumentParser(description=description, parents=[own] if own else [])
    parser.add_argument("--data", type=Path, required=True, help=f"folder that holds {holds}")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument("--subjects", nargs="+", default=list(subjects), help=named)
    parser.add_argument(
        "--seeds", nargs="*", type=int, default=list(seeds), help="none: without trainings"
    )
    parser.add_argument("--steps", type=int, help="steps of each training, to shorten a run")
    parser.add_argument("--stride", type=int, default=1, help="use every n-th frame")
    parser.add_argument(
        "--batches",
        type=int,
        default=2,
        help="random batches of 500 frames of each subject, on which the baselines are solved "
        "(default: 2; 0: all)",
    )
    parser.add_argument(
        "--baselines",
        nargs="*",
        metavar="WORD",
        help="only those whose name has one of these words, e.g. rigid Simple; none: none",
    )
    parser.add_argument(
        "--error-scale", type=float, help="of each training (default: the preset's)"
    )
    parser.add_argument(
        "--few-frames",
        type=int,
        help="frames up to which factorisations teach a training (default: the preset's; 0: none)",
    )
    parser.add_argument(
        "--limb-exchange",
        type=float,
        default=0.0,
        help="share of the known shapes in which limbs are exchanged, of each training",
    )
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    args = parser.parse_args(argv)
    torch.set_num_threads(args.threads)
    session = Session(
        *(args.data, args.output, tuple(args.subjects), tuple(args.seeds)),
        *(args.steps, args.stride, args.batches),
        baselines=None if args.baselines is None else tuple(args.baselines),
        error_scale=args.error_scale,
        few_frames=args.few_frames,
        limb_exchange=args.limb_exchange,
    )
    print_tables(lambda: [shortened(benchmark(session), session)], session.output)


def shortened(table: Table, session: Session) -> Table:
    """Return the table; its title says what a session of fewer steps or frames has left out."""
    said = [f"{session.steps} steps a training (--steps)"] * bool(session.steps)
    said += [f"each frame of {session.stride} (--stride)"] * (session.stride > 1)
    if said:
        table.title += f"; shortened: {', '.join(said)}"
    return table
