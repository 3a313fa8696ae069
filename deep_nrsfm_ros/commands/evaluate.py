"""Compare models with the ground truth of motion capture: the paper's metric and plainer ones."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deep_nrsfm_ros.nrsfm.lifting import Lifter, LiftingOptions
from deep_nrsfm_ros.nrsfm.metrics import ShapeErrors, shape_errors
from deep_nrsfm_ros.nrsfm.model_file import Model, find_model, load_model
from deep_nrsfm_ros.observations.ensemble import Ensemble
from deep_nrsfm_ros.observations.mocap import HEIGHT_18, protocol_split, read_trials, trials

_HEADER = """\
| model | back-projection | shape error % | point error cm | proper % | mirrored % | unscaled % |
|---|---|---|---|---|---|---|"""
_LEGEND = """
shape error: the paper's (each frame rescaled, aligned by O(3)); point error: the same alignment,
the rest skeleton taken as 1.8 m high; proper: no reflection frame by frame; mirrored: frames that
a reflection would fit better; unscaled: proper, without rescaling."""


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="evaluate", description=__doc__)
    parser.add_argument("models", nargs="+", help="model files, or names in --models-dir")
    parser.add_argument("--models-dir", type=Path, default=Path("models"))
    parser.add_argument("--cmu", type=Path, required=True, help="folder of the CMU database")
    parser.add_argument("--subjects", nargs="+", default=["01"])
    parser.add_argument(
        "--split",
        default="train",
        choices=("train", "held-out", "all"),
        help="the paper's training trials, the last 20 %% of the trials, or all of a subject",
    )
    parser.add_argument("--stride", type=int, default=1, help="take every n-th frame")
    parser.add_argument("--camera-seed", type=int, default=0, help="cameras as in training: 0")
    return parser


def read_split(given: argparse.Namespace, model: Model) -> Ensemble:
    """Return the chosen trials of all subjects in the layout of `model`."""
    paths = []
    for subject in given.subjects:
        found = trials(given.cmu, subject)
        train, held_out = protocol_split(found)
        paths += {"train": train, "held-out": held_out, "all": found}[given.split]
    return read_trials(paths, model.layout, seed=given.camera_seed, stride=given.stride)


def evaluate(model: Model, ensemble: Ensemble, back_projection: float) -> ShapeErrors:
    """Lift every frame of an ensemble with ground truth and compare."""
    if ensemble.shapes is None:
        raise ValueError(f"{ensemble.source} has no ground truth to compare with")
    lifter = Lifter(model, LiftingOptions(back_projection=back_projection))
    chunks = range(0, len(ensemble), 4096)
    parts = (ensemble[slice(i, i + 4096)] for i in chunks)
    lifted = [lifter(part.points, part.visible.astype(np.float32)) for part in parts]
    S = np.concatenate([part.shapes * part.scale[:, None, None] for part in lifted])
    return shape_errors(S, ensemble.shapes)


def main(argv: Sequence[str] | None = None) -> None:
    """Print one row per model and back-projection; exit code 2 says the input was at fault."""
    given = arguments().parse_args(argv)
    print(_HEADER)
    try:
        for name in given.models:
            model = load_model(find_model(name, [given.models_dir]))
            ensemble = read_split(given, model)
            for share in (0.0, 1.0):
                e = evaluate(model, ensemble, share)
                figures = (
                    *(100 * e.shape, 100 * HEIGHT_18 * e.point, 100 * e.proper),
                    *(100 * e.mirrored, 100 * e.unscaled),
                )
                cells = " | ".join(f"{figure:.2f}" for figure in figures)
                print(f"| {model.name} | {'yes' if share else 'no'} | {cells} |", flush=True)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    print(_LEGEND)


if __name__ == "__main__":
    main()
