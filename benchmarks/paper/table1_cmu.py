# SPDX-License-Identifier: Apache-2.0
"""Table 1 of the paper, NRSfM on CMU: errors on the training frames, 80 % of the trials."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial

from benchmarks.baselines.batches import LEGEND as BASELINE_LEGEND
from benchmarks.baselines.batches import SPENT, chosen, complete_legend, solve
from benchmarks.harness import LIFTING_LEGEND, Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.evaluate import ALONE, CONVENTIONS, LIFTING, evaluate, figures
from deep_nrsfm_ros.data.mocap import HEIGHT_18
from deep_nrsfm_ros.lifting.options import LiftingOptions

SUBJECTS = ("01", "05", "127")
# Kong and Lucey, "Deep Interpretable Non-Rigid Structure from Motion", arXiv 1902.10840, Table 1.
_PRINTED = ["01", "05", "18", "23", "64", "70", "102", "106", "123", "127"]
_SHAPE = {
    "Deep NRSfM": "10.74 13.40 4.73 3.24 4.38 2.17 7.32 6.83 2.23 6.00",
    "Simple": "16.45 14.07 13.85 20.03 18.13 18.91 18.78 18.63 19.32 23.70",
    "Sparse": "71.23 66.30 46.72 52.44 70.83 39.42 74.12 47.00 44.46 73.85",
    "EM-SfM": "110.23 119.97 111.05 110.94 114.04 127.11 111.60 113.81 107.67 108.07",
}
_POINT = {
    "Deep NRSfM": "5.0638 6.6717 2.2664 1.5138 2.2909 0.9622 3.0240 2.9130 0.9844 2.6820",
    "Simple": "7.9905 6.9406 6.6340 9.5139 8.1784 8.4294 8.0171 8.1782 8.6922 10.9473",
    "Sparse": "35.0283 35.3014 22.6930 25.3302 32.4681 17.7433 30.8274 21.2735 20.3565 32.4896",
    "EM-SfM": "53.1818 60.5971 53.0413 52.2671 50.3960 56.3713 48.5891 50.3306 47.7355 50.8183",
}
PAPER = {
    method: {
        subject: {"shape %": float(shape), "point cm": float(point)}
        for subject, shape, point in zip(
            _PRINTED, _SHAPE[method].split(), _POINT[method].split(), strict=True
        )
    }
    for method in _SHAPE
}
"""Printed figures: method -> subject -> figure."""
OURS: dict[str, tuple[str, dict[str, LiftingOptions]]] = {
    "paper": ("paper's network, ours", {"network alone": ALONE}),
    "default": ("default recipe", LIFTING),
}
"""Our trainings: preset -> name of the rows, and how the model lifts."""


def benchmark(session: Session, recipes: Sequence[str] = tuple(OURS)) -> Table:
    """Train and solve each subject; return the table of errors on its training frames.

    Args:
        session: data, subjects and seeds.
        recipes: the presets to train, keys of `OURS`.
    """
    printed = f"as printed; the ratio of its cm and % fits skeletons 1 / {HEIGHT_18:.3f} as high"
    table = Table(
        "table1_cmu",
        "NRSfM on CMU motion capture, in-sample",
        ("subject", "method"),
        (*CONVENTIONS, *SPENT),
        CONVENTIONS | SPENT | {"paper": printed} | LIFTING_LEGEND | BASELINE_LEGEND,
        bars("shape %", "proper %"),
    )
    table.digits["frames"] = 0
    for subject in session.subjects:
        for method, by_subject in PAPER.items():
            if subject in by_subject:
                table.add((subject, f"paper: {method}"), by_subject[subject])
        dataset = session.mocap([subject], "train")
        for preset in recipes:
            method, liftings = OURS[preset]
            for seed in session.seeds:
                title = f"{subject} {preset} seed {seed}"
                model = session.trained(title, dataset, session.preset(preset, seed))
                spent = {"CPU min": model.provenance["cpu_seconds"] / 60}
                for lifting, options in liftings.items():
                    shown = figures(evaluate(model, dataset, options)) | spent
                    shown["frames"] = len(dataset)
                    table.add((subject, f"{method}, {lifting}"), shown, seed)
        for name in chosen(session):
            solved = solve(session, name, dataset)
            table.add((subject, solved.label), solved.figures)
    complete_legend(table)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(
        "--recipes",
        nargs="+",
        choices=tuple(OURS),
        default=tuple(OURS),
        help="these trainings alone: that of the paper takes the most time",
    )
    known, others = parser.parse_known_args(argv)
    make = partial(benchmark, recipes=known.recipes)
    run_program(make, __doc__, SUBJECTS, others, own=parser)


if __name__ == "__main__":
    main()
