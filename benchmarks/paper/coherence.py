# SPDX-License-Identifier: Apache-2.0
"""Label-free model selection: correlation of coherence and other figures with the error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from benchmarks.harness import Session, run_program
from benchmarks.paper.ablation import STEPS, trained
from benchmarks.table import Table
from deep_nrsfm_ros.commands.evaluate import ALONE, CONVENTIONS, evaluate
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.model_files.model_file import Model

SUBJECTS = ("01", "05", "127")
GUIDES = ("coherence", "combined", "reprojection_error", "cycle_error")
PRESETS = ("default", "paper")
VARIANTS = ("no cycle loss", "no whitening", "no cycle loss, no whitening", "paper's widths")
"""Variants of the ablation, for models of different quality."""
LEGEND = {
    "figures": "Spearman's rank correlation of the guide with the error: +1 if the guide falls "
    "exactly when the error falls; the network alone",
    "coherence": "largest |cos| between two atoms of the final dictionary, the paper's guide",
    "combined": "sqrt(reprojection error^2 + cycle error^2)",
    "along": "snapshots at each tenth of one training",
    "across": f"the results of all trainings of a subject: {', '.join(PRESETS)}, and the default "
    f"of {STEPS} steps with {'; '.join(VARIANTS)}",
    "chosen by": "error of the snapshot (or model) with the lowest coherence or the lowest "
    "combined measure; best: with the lowest error, which needs the truth",
    "shape %": CONVENTIONS["shape %"],
    "proper %": CONVENTIONS["proper %"],
}
CHOSEN = ("chosen by coherence", "chosen by combined", "best")


class Point(NamedTuple):
    """One model in the scatter plot: its label-free quality and its errors in %."""

    quality: Mapping[str, float]
    error: Mapping[str, float]


def benchmark(session: Session) -> Table:
    """Return the table of correlations along trainings and across models."""
    clouds: dict[str, dict[str, list[Point]]] = {}
    table = Table(
        "coherence",
        "Label-free model selection",
        ("subject", "models", "error"),
        (*GUIDES, *CHOSEN),
        LEGEND,
        lambda _, figure: scatter(clouds, figure),
    )
    for subject in session.subjects:
        dataset = session.mocap([subject], "train")
        cloud = clouds.setdefault(subject, {})
        results: list[Point] = []
        for seed in session.seeds:
            for preset in PRESETS:
                title = f"{subject} {preset} seed {seed}"
                models = session.snapshots(title, dataset, session.preset(preset, seed))
                points = [measure(model, dataset) for model in models]
                _correlate(table, (subject, f"along, {preset}"), points, seed)
                cloud.setdefault(f"along, {preset}", []).extend(points)
                results.append(points[-1])
            models = [trained(session, subject, dataset, name, seed) for name in VARIANTS]
            results += [measure(model, dataset) for model in models]
        _correlate(table, (subject, "across"), results, None)
        cloud["across"] = results
    return table


def measure(model: Model, dataset: Dataset, every: int = 10) -> Point:
    """Return the label-free figures of a model and its errors on every `every`-th frame."""
    step = max(1, min(every, len(dataset) // 100))
    errors = evaluate(model, dataset[slice(None, None, step)], ALONE)
    return Point(model.quality, {"shape %": 100 * errors.shape, "proper %": 100 * errors.proper})


def _correlate(
    table: Table, labels: tuple[str, str], points: Sequence[Point], seed: int | None
) -> None:
    """Add the correlations with both errors, and the error of the model that each chooses."""
    for error in ("shape %", "proper %"):
        errors = [point.error[error] for point in points]
        row = {}
        for guide in GUIDES:
            row[guide] = float(spearmanr([p.quality[guide] for p in points], errors).statistic)
        for guide in ("coherence", "combined"):
            lowest = int(np.argmin([point.quality[guide] for point in points]))
            row[f"chosen by {guide}"] = errors[lowest]
        table.add((*labels, error), row | {"best": min(errors)}, seed)


def scatter(clouds: Mapping[str, Mapping[str, Sequence[Point]]], figure: Figure) -> None:
    """Plot the error against coherence and the combined measure, one row per subject."""
    guides = ("coherence", "combined")
    figure.set_size_inches(9, 3.5 * len(clouds))
    axes = figure.subplots(len(clouds), len(guides), squeeze=False)
    for row, (subject, cloud) in zip(axes, clouds.items(), strict=True):
        for panel, guide in zip(row, guides, strict=True):
            for name, points in cloud.items():
                x = [point.quality[guide] for point in points]
                panel.scatter(x, [point.error["shape %"] for point in points], s=12, label=name)
            panel.set(xlabel=guide, ylabel=f"{subject}: shape error %")
    axes[0, 0].legend(fontsize="small")


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv)


if __name__ == "__main__":
    main()
