# SPDX-License-Identifier: Apache-2.0
"""Tables: the figures that come out are those that went in, by hand-made cases."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from benchmarks.table import Table, bars, lines


@pytest.fixture
def table() -> Table:
    table = Table("t", "Errors", ("who", "how"), ("a %", "b"), {"a %": "what"}, bars("a %", "b"))
    table.add(("paper", "printed"), {"a %": 10.74})
    table.add(("ours", "alone"), {"a %": 8.0, "b": 1.5}, seed=0)
    table.add(("ours", "alone"), {"a %": 9.0, "b": 0.5}, seed=1)
    return table


def test_markdown_shows_mean_and_half_the_range_of_the_seeds(table: Table) -> None:
    assert table.markdown().splitlines() == [
        *("## Errors", ""),
        *("| who | how | a % | b |", "|---|---|---|---|"),
        "| paper | printed | 10.74 |  |",
        "| ours | alone | 8.50 ± 0.50 | 1.00 ± 0.50 |",
        *("", "- a %: what", "- ±: half the range of 2 seeds"),
    ]


def test_figures_have_the_decimals_that_the_table_says(table: Table) -> None:
    table.digits["b"] = 3
    assert "| ours | alone | 8.50 ± 0.50 | 1.000 ± 0.500 |" in table.markdown()


def test_a_count_that_all_seeds_have_shows_no_range(table: Table) -> None:
    for seed in (0, 1):
        table.add(("ours", "counted"), {"a %": 7 + seed, "b": 410}, seed=seed)
    table.digits["b"] = 0
    assert "| ours | counted | 7.50 ± 0.50 | 410 |" in table.markdown()
    assert "| ours | alone | 8.50 ± 0.50 | 1 ± 0 |" in table.markdown()


def test_csv_has_every_seed(table: Table, tmp_path: Path) -> None:
    table.write(tmp_path)
    assert list(csv.reader((tmp_path / "t.csv").open())) == [
        ["who", "how", "seed", "a %", "b"],
        ["paper", "printed", "", "10.74", ""],
        ["ours", "alone", "0", "8.0", "1.5"],
        ["ours", "alone", "1", "9.0", "0.5"],
    ]
    assert (tmp_path / "t.md").read_text() == table.markdown()


@pytest.mark.parametrize("draw", [bars("a %", "b"), lines(["a %", "b"], "figure", "error")])
def test_draws_a_picture(table: Table, tmp_path: Path, draw: object) -> None:
    table.draw = draw  # type: ignore[assignment]
    table.write(tmp_path)
    assert (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("labels", "figures"), [(("ours",), {}), (("ours", "alone"), {"c": 1.0})])
def test_refuses_a_row_that_does_not_fit(
    table: Table, labels: tuple[str, ...], figures: dict[str, float]
) -> None:
    with pytest.raises(ValueError, match="none of"):
        table.add(labels, figures)
