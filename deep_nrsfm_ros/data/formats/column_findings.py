# SPDX-License-Identifier: Apache-2.0
"""What looks wrong in the columns of a table, and what is not used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder
from deep_nrsfm_ros.data.formats.columns import Columns, unit_of, words
from deep_nrsfm_ros.data.formats.individuals import Individual, find_confidence
from deep_nrsfm_ros.lifting.sanity import Finding


def say_unused(
    head: Sequence[str],
    columns: Columns,
    individuals: Sequence[Individual],
    builder: DetectionsBuilder,
    unused: tuple[int, ...] | None = None,
) -> None:
    """Say which columns are not used, and find those that seem to be missing."""
    remedies = {}
    if columns.frame is None:
        remedies["the frame"] = "frame"
    if not columns.time:
        remedies["the time"] = "timestamp"
    if not columns.identities and len(individuals) < 2:
        remedies["an identity"] = "track_id"
    known = [(individual.confidence >= 0) for individual in individuals]
    if columns.confidence is None and not (known and all(each.all() for each in known)):
        name = individuals[0].keypoints[0] if individuals else ""
        remedies["a confidence"] = f"{name}_confidence" if name else "confidence"
    names = [head[i] for i in (columns.unused if unused is None else unused)]
    builder.not_used("columns", names, remedies)
    if known and not any(each.any() for each in known):
        _find_endings(names, individuals, builder)


def _find_endings(
    names: Sequence[str], individuals: Sequence[Individual], builder: DetectionsBuilder
) -> None:
    """Add a finding if all keypoints have a further column, which may be their confidence."""
    endings: Counter[str] = Counter()
    for keypoint in individuals[0].keypoints:
        for name in names:
            if name.startswith(keypoint) and len(name) > len(keypoint):
                endings[name[len(keypoint) :].strip("_. -")] += 1
    whole = [ending for ending, count in endings.items() if count == len(individuals[0].keypoints)]
    if whole:
        find_confidence(whole[0], f"{individuals[0].keypoints[0]}_confidence", builder)


def find_roles(
    head: Sequence[str],
    columns: Columns,
    rows: Sequence[Sequence[str]],
    builder: DetectionsBuilder,
) -> None:
    """Add findings about what rows show and names of columns do not say.

    Args:
        head: names of the columns.
        columns: what they mean.
        rows: the first ones.
        builder: gets the findings.
    """
    rows = [row for row in rows if len(row) >= len(head)]
    key = columns.frame if columns.frame is not None else next(iter(columns.time), None)
    if key is None:
        _find_frame(head, columns, rows, builder)
        return
    frames: dict[str, list[Sequence[str]]] = {}
    for row in rows:
        frames.setdefault(row[key], []).append(row)
    several = [each for each in frames.values() if len(each) > 1]
    if len(several) < 2 or columns.identities:
        return
    for i in columns.unused:
        of_each = [[row[i].strip() for row in each] for each in several]
        counts = Counter(value for values in of_each for value in values)
        if all(len(set(values)) == len(values) for values in of_each) and min(counts.values()) > 1:
            builder.find(
                Finding(
                    "identity",
                    f"column {head[i]!r} tells the objects of a frame apart, and is not used: if "
                    "it is the identity, call it 'track_id'",
                )
            )
            return


def _find_frame(
    head: Sequence[str],
    columns: Columns,
    rows: Sequence[Sequence[str]],
    builder: DetectionsBuilder,
) -> None:
    """Add a finding if rows of a table without frames seem to have some."""
    if columns.identities:
        who = [row[columns.identities[0]] for row in rows]
        changes = [one for one, other in pairwise([*who, None]) if one != other]
        if len(changes) > len(set(who)):  # one comes again after another one
            builder.find(
                Finding(
                    "frame",
                    "it has no column of the frame, so that each row is one, and "
                    f"{len(set(who))} identities ({head[columns.identities[0]]}): add a column "
                    "'frame'",
                )
            )
            return
    if not head or words(head[0]) not in ([], ["unnamed", "0"], ["index"]):
        return
    try:
        steps = np.diff([float(row[0]) for row in rows])
    except ValueError:
        return
    if len(steps) and (steps != 1).any():
        builder.find(
            Finding(
                "frame",
                "its first column has no name and does not count the rows: if it is the frame, "
                "call it 'frame'",
            )
        )


def find_units(
    head: Sequence[str], individuals: Sequence[Individual], builder: DetectionsBuilder
) -> None:
    """Add a finding if the names of columns say that coordinates are no pixels."""
    names = [head[int(i)] for individual in individuals for i in individual.xy.ravel()]
    units = sorted({unit_of(name) for name in names} - {""})
    if units:
        builder.find(
            Finding(
                "units",
                f"its coordinates are in {', '.join(units)} by the names of its columns, such as "
                f"{names[0]}: pixels of the image are needed",
            )
        )
