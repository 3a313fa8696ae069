# SPDX-License-Identifier: Apache-2.0
"""Compare models with the ground truth of motion capture: the paper's metric and plainer ones."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.commands.program import Parser, program, program_name
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.mocap import HEIGHT_18, TrialSelection, read_split
from deep_nrsfm_ros.lifting.lifter import Lifter, lift_all
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import Model, find_model, load_model
from deep_nrsfm_ros.nrsfm.metrics import ShapeErrors, shape_errors

CONVENTIONS = {
    "shape %": "the paper's: each frame rescaled to the norm of the truth and aligned by O(3), "
    "which forgives a mirrored depth",
    "point cm": "mean distance of the same alignment, the rest skeleton taken as 1.8 m high",
    "proper %": "rescaled, aligned by proper rotations, no reflection frame by frame; a model most "
    "of whose frames are mirrored is reflected as a whole before",
    "mirrored %": "frames that a reflection would fit better than most frames",
    "unscaled %": "as proper, without rescaling",
}
"""What each figure of `figures` means."""
ALONE = LiftingOptions(correction="none", test_time_rotations=1, test_time_mirror=False)
LIFTING = {
    "network alone": ALONE,
    "back-projected": LiftingOptions(
        correction="back_projection", test_time_rotations=1, test_time_mirror=False
    ),
    "without bones": LiftingOptions(correction="learned"),
    "as shipped": LiftingOptions(),
    "as shipped, noise 0": LiftingOptions(noise=0.0),
}
"""Lifting options that are compared: one pass of the network, the same with back-projection, the
default without bones, the default, and the default for keypoints without noise."""


LABEL_FREE = (
    "This measures against the truth of motion capture or of four cameras, so it needs data of "
    "these. Figures without labels, of a model of your own, are in the report of its training "
    "(MODEL.html) and in the list of `models`."
)
"""What the program measures, and where the other figures are."""
_DEFAULTS: dict[str, Any] = {"subjects": ["01"], "split": "train", "stride": 1, "camera_seed": 0}
"""Options that choose trials of CMU."""


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(prog=program_name("evaluate"), description=f"{__doc__} {LABEL_FREE}")
    parser.add_argument("models", nargs="+", help="model files, or names of models")
    parser.add_argument(
        "--models-dir",
        type=Path,
        default=default_models_dir(),
        help="folder of models, searched before those of the package (default: %(default)s, where "
        "trainings write)",
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--cmu", type=Path, help="folder of the CMU database")
    source.add_argument(
        "--pose2sim",
        type=Path,
        help="wheel of pose2sim 0.6.0, with real detections of a person by four cameras: compares "
        "lifting with and without intrinsics, and measures the error of the position",
    )
    cmu = parser.add_argument_group("CMU")
    cmu.add_argument("--subjects", nargs="+", help="subjects (default: 01)")
    cmu.add_argument(
        "--split",
        choices=("train", "held-out", "all"),
        help="the paper's training trials, the last 20 %% of the trials, or all of a subject "
        "(default: train)",
    )
    cmu.add_argument("--stride", type=int, help="take every n-th frame (default: 1)")
    cmu.add_argument("--camera-seed", type=int, help="cameras as in training: 0 (default: 0)")
    return parser


def selection_of(args: argparse.Namespace) -> TrialSelection | None:
    """Return the trials of CMU that the command line chooses; None where it chooses pose2sim.

    Raises:
        ValueError: an option has no effect.
    """
    chosen = {name: getattr(args, name) for name in _DEFAULTS}
    if args.cmu:
        values = {n: _DEFAULTS[n] if v is None else v for n, v in chosen.items()}
        return TrialSelection(args.cmu, **values)
    if unused := ["--" + n.replace("_", "-") for n, v in chosen.items() if v is not None]:
        raise ValueError(
            f"{', '.join(unused)} has no effect on --pose2sim: it chooses trials and cameras of "
            "--cmu; leave it out"
        )
    return None


def find_models(names: Sequence[str], models_dir: Path) -> list[Model]:
    """Return models by name or path.

    Args:
        names: names of models, or paths of model files.
        models_dir: searched before the folders of the package.

    Raises:
        ModelFileError: there is no such model, or its file cannot be used.
    """
    folders = model_folders(models_dir.expanduser())
    return [load_model(find_model(name, folders)) for name in names]


def reconstruct(lifter: Lifter, dataset: Dataset) -> NDArray[np.float32]:
    """Return the shapes (f, p, 3) of every frame, in the units of its points.

    A frame that cannot be lifted comes out as a point, which is an error of 100 %.
    """
    lifted = lift_all(lifter.lift, dataset.points, dataset.visible.astype(np.float32))
    S: NDArray[np.float32] = np.nan_to_num(lifted.shapes * lifted.scale[:, None, None])
    return S


def evaluate(model: Model, dataset: Dataset, options: LiftingOptions) -> ShapeErrors:
    """Lift every frame of a dataset with ground truth and compare."""
    if dataset.shapes is None:
        raise ValueError(f"{dataset.source} has no ground truth to compare with")
    return shape_errors(reconstruct(Lifter(model, options), dataset), dataset.shapes)


def figures(errors: ShapeErrors) -> dict[str, float]:
    """Return the errors (of shapes in metres) as tables show them, by the `CONVENTIONS`."""
    shown = (errors.shape, HEIGHT_18 * errors.point, *errors[2:-1])
    return {name: 100 * value for name, value in zip(CONVENTIONS, shown, strict=True)}


def compare_cameras(args: argparse.Namespace) -> None:
    """Print what a real person's detections come to, with and without intrinsics."""
    try:
        # Here, because motion capture needs no SciPy.
        from deep_nrsfm_ros.commands.four_cameras import CAMERA_CONVENTIONS, camera_table
        from deep_nrsfm_ros.data.pose2sim import read_session
    except ModuleNotFoundError as error:
        print(f"failed: {error}; install deep_nrsfm_ros[benchmarks]", file=sys.stderr)
        sys.exit(2)
    try:
        models = find_models(args.models, args.models_dir)
        session = read_session(args.pose2sim)
        print(camera_table(models, session), flush=True)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    print("", *(f"{name}: {meaning}" for name, meaning in CAMERA_CONVENTIONS.items()), sep="\n")


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Print one row per model and way of lifting; exit code 2 says the input was at fault."""
    parser = arguments()
    args = parser.parse_args(argv)
    if not (args.cmu or args.pose2sim):
        parser.error(f"give --cmu or --pose2sim. {LABEL_FREE}")
    columns = ("model", "lifted", *CONVENTIONS)
    try:
        selection = selection_of(args)
        if selection is None:
            compare_cameras(args)
            return
        models = find_models(args.models, args.models_dir)
        print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
        reflected: dict[str, None] = {}
        for model in models:
            dataset = read_split(selection, model.layout)
            for word, lifting in LIFTING.items():
                errors = evaluate(model, dataset, lifting)
                cells = " | ".join(f"{figure:.2f}" for figure in figures(errors).values())
                print(f"| {model.name} | {word} | {cells} |", flush=True)
                if errors.reflected:
                    reflected[model.name] = None
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    print("", *(f"{name}: {meaning}" for name, meaning in CONVENTIONS.items()), sep="\n")
    for name in reflected:
        print(
            f"warning: model {name!r} is mirrored as a whole: most of its frames are mirror images "
            "of the truth, and the figures without reflection are those of their reflections; a "
            "robot would see front and back exchanged",
            file=sys.stderr,
        )


if __name__ == "__main__":
    main()
