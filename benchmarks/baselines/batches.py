# SPDX-License-Identifier: Apache-2.0
"""The baselines on whole subjects, as in the paper: shuffled batches, mean of the errors."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.baselines.methods import BASELINES, BATCH, Setting, shuffled_batches
from benchmarks.harness import LIFTING_LEGEND, Session
from benchmarks.table import Table
from deep_nrsfm_ros.commands.evaluate import figures
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.nrsfm.metrics import ShapeErrors, shape_errors

Floats = NDArray[Any]

POOL = 16_000
"""Frames at most, chosen at random, among which like ones are looked for."""
QUERIES = 60
"""Frames that are solved with those like them."""
LEGEND = {
    "Simple, EM-SfM, Sparse, SfC": f"shuffled batches of {BATCH} frames, each with its own "
    "reflection; settings have the lowest error against the ground truth on the first batch, "
    "which favours them",
} | {name: baseline.legend for name, baseline in BASELINES.items() if baseline.legend}
SPENT = {
    "CPU min": "CPU time on this machine of the training's steps, without the factorisations that "
    "teach a training of up to 2000 frames; or of the baseline on the frames of the row with the "
    "search for its settings",
    "frames": "that the row is measured on; of baselines a random sample, see --batches",
    "ms": "CPU time of a frame in ms, without the search for the settings",
}


class Solved(NamedTuple):
    """The result of a baseline on a dataset.

    Attributes:
        name: of the baseline.
        errors: means over frames; `proper` and `mirrored` mean nothing where each frame has a
            reflection of its own.
        setting: the chosen one.
        frames: that were solved.
        cpu_seconds: without the search for the setting.
        search_seconds: CPU time of that search.
        by_neighbours: each frame was solved with frames like it.
    """

    name: str
    errors: ShapeErrors
    setting: Setting
    frames: int
    cpu_seconds: float
    search_seconds: float
    by_neighbours: bool

    @property
    def label(self) -> str:
        """The row's name: the method and its setting."""
        settings = self.setting.items()
        words = [k if v is True else f"{k} = {v}" for k, v in settings if v is not False]
        return ", ".join([self.name, *words])

    @property
    def figures(self) -> dict[str, float]:
        """Errors, frames and time as tables show them."""
        shown = figures(self.errors)
        if self.by_neighbours:
            # Each frame has a reflection of its own.
            shown = {name: shown[name] for name in ("shape %", "point cm")}
        return shown | {
            "CPU min": (self.cpu_seconds + self.search_seconds) / 60,
            "frames": self.frames,
            "ms": 1000 * self.cpu_seconds / self.frames,
        }


def chosen(session: Session) -> list[str]:
    """Return the names of the baselines that the session asks for."""
    words = session.baselines
    return [name for name in BASELINES if words is None or any(word in name for word in words)]


def complete_legend(table: Table) -> None:
    """Leave notes of rows that the table has not out of its legend; add the baselines' CPU time."""
    rows = [label for row in table.rows for label in row.labels if label[:7] != "paper: "]
    known = {*LIFTING_LEGEND, *BASELINES}

    def is_of_a_row(name: str) -> bool:
        words = [name] if name in known else name.split(", ")
        return any(word in row for word in words for row in rows)

    table.legend = {
        name: text
        for name, text in table.legend.items()
        if name not in LIFTING_LEGEND | LEGEND or is_of_a_row(name)
    }
    minutes = [row.figures["CPU min"] for row in table.rows if "ms" in row.figures]
    if minutes:
        table.legend = {
            **table.legend,
            "all baselines of this table together": f"{sum(minutes):.1f} CPU min on this machine",
        }


def solve(session: Session, name: str, dataset: Dataset, known: Dataset | None = None) -> Solved:
    """Return a baseline's errors on a dataset with ground truth, kept in the output folder.

    Args:
        session: data, output folder and sizes of the samples.
        name: of the baseline.
        dataset: to be solved.
        known: frames in which like ones are looked for; None: the dataset itself.
    """
    baseline = BASELINES[name]
    settings = f"{baseline.settings} {session.batches} {BATCH} {QUERIES} {POOL}"
    data = dataset.points.tobytes() + (b"" if known is None else known.points.tobytes())
    result = session.kept(
        f"{name} {settings} {Solved._fields}",
        data,
        lambda: _solve(name, dataset, known, session.batches),
    )
    _, errors, *others = result
    return Solved(name, ShapeErrors(*errors), *others)


def _solve(name: str, dataset: Dataset, known: Dataset | None, count: int) -> Solved:
    baseline, truth, rng = BASELINES[name], true_shapes(dataset), np.random.default_rng(0)
    parts: list[NDArray[np.int64]]
    extra: tuple[Floats, ...] = ()
    if baseline.whole:
        parts = [np.arange(len(dataset))]
    elif baseline.by_neighbours:
        order = rng.permutation(len(dataset))
        parts = [np.array([frame]) for frame in order[:QUERIES]]
        if known is None:
            extra = (dataset.points[order[:POOL]],)
        else:
            extra = (known.points[rng.permutation(len(known))[:POOL]],)
    else:
        parts = shuffled_batches(len(dataset), rng)[: count or None]

    def run(frames: NDArray[np.int64], setting: Setting) -> ShapeErrors:
        S = baseline.method(dataset.points[frames], *extra, **setting)
        return lowest_errors(S, truth[frames])

    first = parts[: QUERIES // 4] if baseline.by_neighbours else parts[:1]
    setting, began = baseline.settings[0], time.process_time()
    if len(baseline.settings) > 1:
        found = {
            i: _mean((frames, run(frames, setting)) for frames in first).shape
            for i, setting in enumerate(tqdm(baseline.settings, f"{name}, settings", leave=False))
        }
        setting = baseline.settings[min(found, key=found.__getitem__)]
    searched = time.process_time()
    errors = _mean((frames, run(frames, setting)) for frames in tqdm(parts, name))
    spent = time.process_time() - searched
    return Solved(
        name,
        errors,
        setting,
        sum(map(len, parts)),
        spent,
        searched - began,
        baseline.by_neighbours,
    )


def lowest_errors(S: Floats, truth: Floats) -> ShapeErrors:
    """Return the errors of S (f, p, 3), or the lowest of results (n, f, p, 3)."""
    results = S if S.ndim == 4 else S[None]
    return min((shape_errors(result, truth) for result in results), key=lambda e: e.shape)


def _mean(parts: Iterable[tuple[Sequence[int] | NDArray[np.int64], ShapeErrors]]) -> ShapeErrors:
    """Return the mean of errors over frames; each part is its frames and their errors."""
    sizes, errors = zip(*((len(frames), errors) for frames, errors in parts), strict=True)
    return ShapeErrors(*np.average(errors, axis=0, weights=sizes).tolist())


def true_shapes(dataset: Dataset) -> Floats:
    """Return the ground truth (f, p, 3); raise ValueError if there is none."""
    if dataset.shapes is None:
        raise ValueError(f"{dataset.source} has no ground truth to compare with")
    return dataset.shapes
