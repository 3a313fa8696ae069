# SPDX-License-Identifier: Apache-2.0
"""Tables of figures: Markdown, CSV and a plot."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.figure import Figure


class Row(NamedTuple):
    """One run: labels, seed (None: not random) and figures."""

    labels: tuple[str, ...]
    seed: int | None
    figures: Mapping[str, float]


class Table:
    """Rows of figures; rows with equal labels are the seeds of one method.

    Markdown and plot show the mean +- half the range of the seeds; the CSV has one row per seed.

    Attributes:
        name: file name without suffix.
        title: heading.
        labels: names of the label columns.
        figures: names of the figure columns.
        legend: meaning of labels and figures.
        draw: draws the plot.
        rows: the runs.
        digits: decimals of a figure, where they are not two.
    """

    def __init__(
        self,
        name: str,
        title: str,
        labels: Sequence[str],
        figures: Sequence[str],
        legend: Mapping[str, str],
        draw: Callable[[Table, Figure], None],
    ) -> None:
        """Create an empty table."""
        self.name, self.title, self.legend, self.draw = name, title, legend, draw
        self.labels, self.figures = tuple(labels), tuple(figures)
        self.rows: list[Row] = []
        self.digits: dict[str, int] = {}

    def add(
        self, labels: Sequence[str], figures: Mapping[str, float], seed: int | None = None
    ) -> None:
        """Add a run; missing figures stay empty.

        Raises:
            ValueError: unknown figures or a wrong number of labels.
        """
        if len(labels) != len(self.labels) or not set(figures) <= set(self.figures):
            raise ValueError(
                f"row {labels} {list(figures)} is none of {self.labels} {self.figures}"
            )
        self.rows.append(Row(tuple(labels), seed, figures))

    def values(self) -> dict[tuple[str, ...], dict[str, list[float]]]:
        """Return labels -> figure -> values of the seeds, in order of appearance."""
        merged: dict[tuple[str, ...], dict[str, list[float]]] = {}
        for row in self.rows:
            for name, value in row.figures.items():
                merged.setdefault(row.labels, {}).setdefault(name, []).append(value)
        return merged

    def markdown(self) -> str:
        """Return title, table and legend."""
        columns = (*self.labels, *self.figures)
        lines = [f"## {self.title}", "", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
        for labels, figures in self.values().items():
            cells = (
                _cell(figures.get(name, []), self.digits.get(name, 2)) for name in self.figures
            )
            lines.append(f"| {' | '.join((*labels, *cells))} |")
        seeds = max(len(v) for figures in self.values().values() for v in figures.values())
        legend = dict(self.legend)
        if seeds > 1:
            legend["±"] = f"half the range of {seeds} seeds"
        return "\n".join([*lines, "", *(f"- {name}: {text}" for name, text in legend.items()), ""])

    def write(self, folder: Path) -> None:
        """Write `name`.md, .csv and .png."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{self.name}.md").write_text(self.markdown())
        with (folder / f"{self.name}.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow((*self.labels, "seed", *self.figures))
            for row in self.rows:
                figures = (row.figures.get(name, "") for name in self.figures)
                writer.writerow((*row.labels, "" if row.seed is None else row.seed, *figures))
        figure = pyplot.figure(
            figsize=(9, max(4.5, 0.3 * len(self.values()))), layout="constrained"
        )
        figure.suptitle(self.title)
        self.draw(self, figure)
        figure.savefig(folder / f"{self.name}.png", dpi=120)
        pyplot.close(figure)


def _cell(values: Sequence[float], digits: int) -> str:
    """Return the mean of the seeds, with half the range if there are several.

    A whole number that all seeds have, as the number of frames, has no range.
    """
    if not values:
        return ""
    mean = f"{np.mean(values):.{digits}f}"
    if len(values) == 1 or (digits == 0 and np.ptp(values) == 0):
        return mean
    return f"{mean} ± {np.ptp(values) / 2:.{digits}f}"


def bars(*names: str) -> Callable[[Table, Figure], None]:
    """Return a function that plots the figures `names` as one group of bars per row."""

    def draw(table: Table, figure: Figure) -> None:
        axes = figure.subplots()
        values = table.values()
        places = np.arange(len(values))
        width = 0.8 / len(names)
        for i, name in enumerate(names):
            seeds = [figures.get(name, [np.nan]) for figures in values.values()]
            mean, spread = [np.mean(s) for s in seeds], [np.ptp(s) / 2 for s in seeds]
            axes.barh(places + i * width, mean, width, xerr=spread, label=name)
        axes.set_yticks(places + 0.4 - width / 2, [", ".join(row) for row in values])
        axes.invert_yaxis()
        axes.legend()

    return draw


def lines(names: Sequence[str], across: str, up: str) -> Callable[[Table, Figure], None]:
    """Return a function that plots the columns `names` as one line per row."""

    def draw(table: Table, figure: Figure) -> None:
        axes = figure.subplots()
        for labels, figures in table.values().items():
            seeds = [figures.get(name, [np.nan]) for name in names]
            mean, spread = [np.mean(s) for s in seeds], [np.ptp(s) / 2 for s in seeds]
            axes.errorbar(range(len(names)), mean, spread, marker="o", label=", ".join(labels))
        axes.set_xticks(range(len(names)), names)
        axes.set(xlabel=across, ylabel=up, ylim=(0, None))
        axes.legend(fontsize="small")

    return draw


def print_tables(make: Callable[[], Sequence[Table]], output: Path) -> None:
    """Print and write tables.

    Args:
        make: returns them; its ValueError or OSError, as of data that are not there, ends the
            program with one sentence and code 2.
        output: folder of the files.
    """
    try:
        tables = make()
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    for table in tables:
        print(table.markdown())
        table.write(output)
