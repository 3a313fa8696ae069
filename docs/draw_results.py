# SPDX-License-Identifier: Apache-2.0
"""Draw the figures of the results from the tables of docs/results.md.

    python -m docs.draw_results     # after a table has changed

The tables stay the one place of the numbers: each figure reads its rows from the page.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

FOLDER = Path(__file__).parent
PATH = FOLDER / "pictures" / "results.png"
_COLOURS = {"paper": "#9aa2aa", "network": "#6baed6", "shipped": "#08519c", "other": "#d9a441"}


def table(text: str, heading: str) -> list[dict[str, str]]:
    """Return the rows of the first table below a heading, by column.

    Raises:
        ValueError: there is no such heading.
    """
    lines = text[text.index(f"\n## {heading}") :].splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("|"))
    names, _, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in lines[start : next(i for i in range(start, len(lines)) if not lines[i])]
    ]
    return [dict(zip(names, row, strict=True)) for row in rows]


def number(cell: str) -> float:
    """Return the mean of a cell such as "6.04 ± 0.01"."""
    return float(cell.split("±")[0])


def errors_by_method(axes: Any, text: str) -> None:
    """Draw shape errors of three subjects, by method."""
    rows = table(text, "NRSfM on CMU (Table 1)")
    methods = {
        "paper: Deep NRSfM": ("printed in the paper", _COLOURS["paper"]),
        "default recipe, network alone": ("ours, network alone", _COLOURS["network"]),
        "default recipe, as shipped": ("ours, as shipped", _COLOURS["shipped"]),
    }
    subjects = list(dict.fromkeys(row["subject"] for row in rows))[:3]
    for k, (method, (label, colour)) in enumerate(methods.items()):
        values = [
            number(row["shape %"])
            for subject in subjects
            for row in rows
            if row["subject"] == subject and row["method"] == method
        ]
        places = [i + 0.27 * (k - 1) for i in range(len(values))]
        bars = axes.bar(places, values, 0.25, label=label, color=colour)
        axes.bar_label(bars, fmt="%.1f", fontsize=8)
    axes.set_xticks(range(len(subjects)), [f"subject {subject}" for subject in subjects])
    axes.set_title("CMU, in-sample")


def error_curves(
    axes: Any, rows: list[dict[str, str]], columns: tuple[str, ...], label: str
) -> None:
    """Draw shape errors over columns, one line for each row that is complete."""
    own = list(rows[0])[:2]
    for row in rows:
        if all(row[column] for column in columns):
            values = [number(row[column]) for column in columns]
            words = ", ".join(row[name] for name in own)
            axes.plot(range(len(columns)), values, marker="o", markersize=4, label=words)
    axes.set_xticks(range(len(columns)), columns)
    axes.set_xlabel(label)


def main() -> None:
    """Write the figure."""
    text = (FOLDER / "results.md").read_text(encoding="utf-8")
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 5.4))
    errors_by_method(left, text)
    noise = table(text, "Noise")
    error_curves(middle, noise, ("0 %", "5 %", "10 %", "15 %", "20 %"), "noise")
    middle.set_title("subject 01, noise")
    missing = table(text, "Missing keypoints")
    columns = ("0", "1", "3", "6", "9", "arm", "leg")
    error_curves(right, missing, columns, "missing keypoints, or a limb")
    right.set_title("subject 01, missing keypoints")
    for axes in (left, middle, right):
        axes.set_ylim(0)
        axes.set_ylabel("shape error %")
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.2), frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(PATH, dpi=90)
    print(f"{PATH}: {PATH.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
