# SPDX-License-Identifier: Apache-2.0
"""Share of frames with mirrored depth, by seed: one seed, repaired or not, and the paper's network.

One seed alone, without rivals and without the reference shapes, shows what the method does by
itself; `repair` is the default of the recipe. The paper's network is trained as its authors did,
and then repaired: a tenth of its steps with the cycle loss on reference shapes.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

from benchmarks.harness import LIFTING_LEGEND, Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.commands.evaluate import CONVENTIONS, LIFTING, evaluate, figures
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.nrsfm.recipe import PRESETS, Preset, Recipe
from deep_nrsfm_ros.training.finish import finish
from deep_nrsfm_ros.training.frames import FrameStore
from deep_nrsfm_ros.training.loop import train
from deep_nrsfm_ros.training.mirror import MirrorCheck
from deep_nrsfm_ros.training.setup import Setup

SUBJECTS = ("01", "05", "127")
SEEDS = (0, 1, 2, 3, 4)
_SPLITS = {"train": "first 80 %, in-sample", "held-out": "last 20 %"}
_LIFTED = ("network alone", "as shipped")
_SHOWN = ("shape %", "proper %", "mirrored %")
_FOUND = "found without labels %"
_RECIPES: dict[str, dict[str, Any]] = {
    "one seed": {"seeds": 1, "mirror_repair": "off"},
    "one seed, repaired": {"seeds": 1, "mirror_repair": "if_found"},
    "default": {},
    "default, reference always": {"mirror_repair": "always"},
    "fast": {},
}
_PAPER = "paper"  # with its repair
_REPAIR_SHARE = 0.1  # of the steps of the paper's network
_LEGEND = {
    _FOUND: "share of mirrored training frames by the mirror test, which sees no 3D label",
    "one seed": "the default recipe with --seeds 1 --mirror-repair off",
    "one seed, repaired": "the default recipe with --seeds 1",
    "default": "the default recipe: up to 3 seeds, the first that mirrors no frame",
    "default, reference always": "the default recipe with --mirror-repair always",
    "fast": "--preset fast",
    "paper": "the paper's network and schedule",
    "paper, repaired": "the same, then a tenth of its steps with --cycle 2 --mirror-repair always",
}


def benchmark(session: Session, recipes: Sequence[str] = (*_RECIPES, _PAPER)) -> Table:
    """Train with each seed; return the table of mirrored frames with one row per seed."""
    table = Table(
        "mirrored_frames",
        "Mirrored frames, seed by seed",
        ("subject", "recipe", "tested on", "lifted", "run"),
        (*_SHOWN, _FOUND),
        _LEGEND
        | {name: CONVENTIONS[name] for name in _SHOWN}
        | {name: LIFTING_LEGEND[name] for name in _LIFTED},
        bars("shape %", "proper %"),
    )
    for subject in session.subjects:
        dataset = session.mocap([subject], "train")
        frames = FrameStore.of(dataset.points, dataset.visible)
        check = MirrorCheck(frames, session.preset("default", 0).normaliser)
        for seed in session.seeds:
            for name in filter(_RECIPES.__contains__, recipes):
                base = name if name in PRESETS else "default"
                preset = session.preset(base, seed, **_RECIPES[name])
                model = session.trained(f"{subject} {name} seed {seed}", dataset, preset)
                _add(table, session, (subject, name), model, (seed, check))
        if _PAPER not in recipes:
            continue
        check = MirrorCheck(frames, session.preset("paper", 0).normaliser)
        for name, model in _of_the_paper(session, subject, dataset).items():
            _add(table, session, (subject, name), model, (0, check))
    return table


def _of_the_paper(session: Session, subject: str, dataset: Dataset) -> dict[str, Model]:
    """Return the paper's network of seed 0, and its repair."""
    preset = session.preset("paper", 0)
    model = session.trained(f"{subject} paper seed 0", dataset, preset)
    return {"paper": model, "paper, repaired": repaired(model, dataset, preset.recipe)}


def repaired(model: Model, dataset: Dataset, recipe: Recipe) -> Model:
    """Return a model after a tenth of its steps with the cycle loss on reference shapes."""
    steps = max(int(recipe.steps * _REPAIR_SHARE), 1)
    recipe = dataclasses.replace(recipe, steps=steps, cycle=2.0, mirror_repair="always")
    preset = Preset(model.network.architecture, model.normaliser, recipe)
    trainer = train(dataset.points, dataset.visible, preset, Setup(model.network))
    return finish(trainer, model.name, dataset.layout, dataset.source)


def _add(
    table: Table,
    session: Session,
    labels: tuple[str, str],
    model: Model,
    run: tuple[int, MirrorCheck],
) -> None:
    """Add the rows of a model: both splits, lifted both ways.

    Args:
        table: gets the rows.
        session: gives the data.
        labels: subject and recipe.
        model: to evaluate.
        run: seed, and the mirror test of the subject's training frames.
    """
    seed, check = run
    for split, tested_on in _SPLITS.items():
        test = session.mocap([labels[0]], split)
        for lifted in _LIFTED:
            errors = figures(evaluate(model, test, LIFTING[lifted]))
            shown = {name: errors[name] for name in _SHOWN}
            if split == "train" and lifted == "network alone":
                share = check.share(model.network)
                shown |= {} if math.isnan(share) else {_FOUND: 100 * share}
            table.add((*labels, tested_on, lifted, f"seed {seed}"), shown, seed)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(add_help=False)
    recipes = (*_RECIPES, _PAPER)
    parser.add_argument(
        "--recipes", nargs="+", choices=recipes, default=recipes, help="these alone"
    )
    chosen, others = parser.parse_known_args(argv)
    make = partial(benchmark, recipes=chosen.recipes)
    run_program(make, __doc__, SUBJECTS, others, seeds=SEEDS, own=parser)


if __name__ == "__main__":
    main()
