# SPDX-License-Identifier: Apache-2.0
"""Ablation: the default recipe with one part changed, in short trainings."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

from benchmarks.harness import LIFTING_LEGEND, Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.evaluate import CONVENTIONS, LIFTING, evaluate, figures
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.network import PAPER_WIDTHS

SUBJECTS = ("01", "05")
STEPS = 10_000


class Variant(NamedTuple):
    """Changes to the default preset: fields of its architecture and of its recipe."""

    architecture: dict[str, Any] = {}
    recipe: dict[str, Any] = {}


VARIANTS = {
    "default": Variant(),
    "one seed": Variant(recipe={"seeds": 1}),
    "no whitening": Variant({"whitening": 0.0}),
    "whitening of half the exponent": Variant({"whitening": 0.5}),
    "whitening down to 0.1 %": Variant({"whitening_floor": 1e-3}),
    "no cycle loss": Variant(recipe={"cycle": 0.0}),
    "no cycle loss, no whitening": Variant({"whitening": 0.0}, {"cycle": 0.0}),
    "paper's widths": Variant({"widths": PAPER_WIDTHS}),
}
_SHOWN = ("shape %", "proper %", "mirrored %")


def trained(session: Session, subject: str, dataset: Dataset, name: str, seed: int) -> Model:
    """Return the model of the variant `name`, trained for `STEPS` steps.

    No variant is repaired: the repair would hide what each part does against mirrored frames.
    """
    variant = VARIANTS[name]
    recipe = {"steps": session.steps or STEPS, "mirror_repair": "off"} | variant.recipe
    preset = session.preset("default", seed, **recipe)
    architecture = dataclasses.replace(preset.architecture, **variant.architecture)
    return session.trained(
        f"{subject} {name.replace('%', 'percent')} seed {seed}",
        dataset,
        preset._replace(architecture=architecture),
    )


def benchmark(session: Session) -> Table:
    """Train each variant on each subject; return the table of errors on the training frames."""
    table = Table(
        "ablation",
        f"Ablation, {session.steps or STEPS} steps, in-sample",
        ("subject", "recipe", "lifted"),
        _SHOWN,
        {name: CONVENTIONS[name] for name in _SHOWN} | LIFTING_LEGEND,
        bars("shape %", "proper %"),
    )
    for subject in session.subjects:
        dataset = session.mocap([subject], "train")
        for name in VARIANTS:
            for seed in session.seeds:
                model = trained(session, subject, dataset, name, seed)
                for lifting, options in LIFTING.items():
                    shown = figures(evaluate(model, dataset, options))
                    row = {figure: shown[figure] for figure in _SHOWN}
                    table.add((subject, name, lifting), row, seed)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv)


if __name__ == "__main__":
    main()
