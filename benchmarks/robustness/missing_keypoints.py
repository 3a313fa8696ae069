# SPDX-License-Identifier: Apache-2.0
"""Error against missing keypoints: some of 31 at random, and whole limbs."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Session, errors_by_column, run_program, with_proper
from benchmarks.table import Table, lines
from deep_nrsfm_ros.commands.evaluate import CONVENTIONS, figures
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.metrics import shape_errors
from deep_nrsfm_ros.nrsfm.network import reconstruct

SUBJECTS = ("01",)
COUNTS = (0, 1, 3, 6, 9)
TEST_STRIDE = 5
"""Models are trained on all frames and tested on every n-th."""
LIMBS = {
    "arm": ("humerus", "radius", "wrist", "hand", "fingers", "thumb"),
    "leg": ("femur", "tibia", "foot", "toes"),
}
ZERO_FILL = "zero-fill"
LIFTING = {
    "expected": LiftingOptions(refill=0),
    "expected, refilled (shipped)": LiftingOptions(),
}
TRAINED = {"default recipe": {}, "masked": {"mask": 0.3}}
LEGEND = {
    "0 ... 9": "keypoints hidden in each frame, drawn at random",
    "arm, leg": "; ".join(f"{limb}: {' '.join(parts)}" for limb, parts in LIMBS.items())
    + " of one side, drawn for each frame",
    "masked": f"default recipe, up to {TRAINED['masked']['mask']:.0%} of the points hidden at each "
    "training step",
    ZERO_FILL: "missing keypoints are zero in the network's input; network alone",
    "expected": "missing keypoints get their conditional mean under the second moment of the "
    "keypoints; the lifted shape is corrected by the visible ones",
    "refilled": f"missing keypoints then follow the lifted shape, {LiftingOptions().refill} rounds",
    "figures": f"shape error in % of every {TEST_STRIDE}th frame, over all points: "
    f"{CONVENTIONS['shape %']}",
    "proper": CONVENTIONS["proper %"],
}


def benchmark(session: Session, trainings: Sequence[str] = tuple(TRAINED)) -> Table:
    """Return the table of errors with hidden keypoints of the training frames.

    Args:
        session: data, subjects and seeds.
        trainings: the trainings to compare, keys of `TRAINED`.
    """
    columns = [*map(str, COUNTS), *LIMBS]
    table = Table(
        "missing_keypoints",
        "Missing keypoints",
        ("subject", "trained", "lifting"),
        with_proper(columns),
        LEGEND,
        lines(columns, "missing keypoints", "shape error %"),
    )
    for subject in session.subjects:
        dataset = session.mocap([subject], "train")
        encoded = dataset[slice(None, None, TEST_STRIDE)]
        tests = {column: hide(encoded, column) for column in columns}
        for trained in trainings:
            recipe = TRAINED[trained]
            for seed in session.seeds:
                preset = session.preset("default", seed, **recipe)
                name = "masked" if recipe else "default"
                model = session.trained(f"{subject} {name} seed {seed}", dataset, preset)
                row = zero_fill_errors(model, tests)
                table.add((subject, trained, ZERO_FILL), row, seed)
                for lifting, options in LIFTING.items():
                    row = errors_by_column({c: (model, test) for c, test in tests.items()}, options)
                    table.add((subject, trained, lifting), row, seed)
    return table


def zero_fill_errors(model: Model, tests: Mapping[str, Dataset]) -> dict[str, float]:
    """Return the errors in % of the network alone with zeros for missing keypoints."""
    row: dict[str, float] = {}
    for column, test in tests.items():
        encoded = model.normaliser.encode(test.points, test.visible[..., None].astype(np.float32))
        S, _ = reconstruct(model.network, encoded.W * encoded.gain)
        assert test.shapes is not None
        errors = figures(shape_errors(S, test.shapes))
        row |= {column: errors["shape %"], f"{column} proper": errors["proper %"]}
    return row


def hide(dataset: Dataset, column: str, seed: int = 0) -> Dataset:
    """Return the dataset with hidden keypoints: a number per frame, or a limb of `LIMBS`."""
    rng = np.random.default_rng(seed)
    f, p = dataset.visible.shape
    visible: NDArray[np.bool_] = np.ones((f, p), bool)
    if column in LIMBS:
        sides = [[dataset.layout.index(side + part) for part in LIMBS[column]] for side in "lr"]
        hidden = np.array(sides)[rng.integers(2, size=f)]
    else:
        hidden = rng.random((f, p)).argsort(1)[:, : int(column)]
    np.put_along_axis(visible, hidden, False, 1)
    points = np.where(visible[..., None], dataset.points, np.float32(0))
    return dataclasses.replace(dataset, points=points, visible=visible)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    names = tuple(TRAINED)
    parser.add_argument(
        "--trained", nargs="+", choices=names, default=names, help="these trainings alone"
    )
    known, others = parser.parse_known_args(argv)
    make = partial(benchmark, trainings=known.trained)
    run_program(make, __doc__, SUBJECTS, others, own=parser)


if __name__ == "__main__":
    main()
