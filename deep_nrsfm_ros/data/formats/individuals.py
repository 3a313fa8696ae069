# SPDX-License-Identifier: Apache-2.0
"""Individuals of a table that has columns for each of their keypoints."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder, KeypointFileError, as_identity
from deep_nrsfm_ros.data.formats.cells import Numbers
from deep_nrsfm_ros.data.formats.columns import CONFIDENCE, COORDINATES, Part
from deep_nrsfm_ros.data.formats.depth_check import DepthCheck, is_visibility
from deep_nrsfm_ros.lifting.sanity import Finding

EXPECTED = (
    "neither of DeepLabCut (rows scorer, bodyparts, coords), nor with a landmark a row (columns "
    "frame, landmark, x, y), nor with a column for each coordinate (nose_x, nose_y, ... or "
    "x_nose, y_nose, ...)"
)
"""What a table is not, if no keypoint is found in it."""
_UNIQUE = "single"  # individual of DeepLabCut that has the unique bodyparts
_SHOWN = 4  # names that a finding lists

Column = tuple[str, str, str]
"""Individual ("" where there is one only), keypoint and coordinate of a column."""


def parts_of(columns: Sequence[Column], builder: DetectionsBuilder) -> list[Part]:
    """Return the keypoints of the columns of a table with rows of levels.

    Args:
        columns: of the table.
        builder: gets a finding if their confidence may have another name.
    """
    places: dict[tuple[str, str], dict[str, int]] = {}
    for i, (individual, part, coordinate) in enumerate(columns):
        places.setdefault((individual, part), {})[coordinate.lower()] = i
    whole = [at for at in places.values() if "x" in at and "y" in at]
    if whole and not any(set(CONFIDENCE) & set(at) for at in whole):
        others = set.intersection(*(set(at) for at in whole)) - set(COORDINATES)
        if others:
            find_confidence(min(others), "likelihood", builder)
    return [Part(individual, part, at) for (individual, part), at in places.items()]


@dataclass(frozen=True)
class Individual:
    """An individual of a table with columns for each of its keypoints.

    Attributes:
        name: of the individual; "" where there is one only.
        kind: its category; None where there is one only.
        xy: columns (q, 2) of x and y.
        confidence: columns (q,) of the confidence, -1 for none.
        depth: columns (q,) of z; None where a keypoint has none.
        keypoints: names of the q keypoints.
        has_visibility: the confidence has the name that MediaPipe gives it.
    """

    name: str
    kind: int | None
    xy: NDArray[np.int64]
    confidence: NDArray[np.int64]
    depth: NDArray[np.int64] | None
    keypoints: Sequence[str]
    has_visibility: bool = False

    def values(self, row: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return x, y and confidence (q, 3) in the values of a row.

        An object that has places and no confidence at all was labelled by hand: it is sure.
        """
        points = row[self.xy]
        confidence = np.where(self.confidence < 0, 1.0, row[self.confidence])
        if np.isnan(confidence).all() and not np.isnan(points).all():
            confidence[:] = 1.0
        return np.column_stack([points, confidence])


def find_individuals(
    parts: Sequence[Part], builder: DetectionsBuilder, *, may_be_one: bool = False
) -> list[Individual]:
    """Return the individuals of a table, and name their keypoints.

    Individuals with other keypoints than the first one are a category of their own.

    Args:
        parts: the keypoints of all individuals.
        builder: gets names of keypoints and categories, and what looks wrong.
        may_be_one: a single individual is of no category, and keypoints may be numbers.

    Raises:
        KeypointFileError: no keypoint has x and y.
    """
    places: dict[str, dict[str, Mapping[str, int]]] = defaultdict(dict)
    for part in parts:
        places[part.individual][part.name] = part.at
    if _UNIQUE in places and len(places) > 1 and builder.options.category != _UNIQUE:
        for name in places.pop(_UNIQUE):
            builder.leave_out(
                f"are points of the scene, not of an individual (--category {_UNIQUE} reads them)",
                name,
            )
    _find_incomplete({name: at for each in places.values() for name, at in each.items()}, builder)
    kinds: dict[tuple[str, ...], int] = {}
    names: dict[int, list[str]] = {}
    individuals = []
    for who, each in places.items():
        complete = {name: at for name, at in each.items() if "x" in at and "y" in at}
        if not complete:
            continue
        kind = None
        if may_be_one and len(places) == 1:
            if not all(name.isdecimal() for name in complete):
                builder.name_keypoints(list(complete))
        else:
            kind = kinds.setdefault(tuple(complete), len(kinds))
            if kind not in names:
                builder.name_keypoints(list(complete), kind)
            names.setdefault(kind, []).append(who)
            builder.name_category(kind, ", ".join(names[kind]))
        xy = np.array([(at["x"], at["y"]) for at in complete.values()])
        has_depth = all("z" in at for at in complete.values())
        depth = np.array([at["z"] for at in complete.values()]) if has_depth else None
        confidence = _confidence_columns(complete)
        is_visible = all(is_visibility(at) for at in complete.values())
        individuals.append(Individual(who, kind, xy, confidence, depth, list(complete), is_visible))
    if not individuals:
        raise KeypointFileError(f"no keypoint has columns x and y; it is {EXPECTED}")
    return individuals


def add_individuals(
    individuals: Sequence[Individual],
    rows: Iterable[tuple[int, NDArray[np.float64]]],
    builder: DetectionsBuilder,
) -> None:
    """Add a table with a row for each frame.

    An individual without any coordinate in a frame is not there.

    Args:
        individuals: the individuals.
        rows: (index of the frame, values of all columns).
        builder: gets the objects.

    Raises:
        KeypointFileError: the table is 3D.
    """
    checks = depth_checks(individuals)
    for frame, row in rows:
        for individual, check in zip(individuals, checks, strict=True):
            values = individual.values(row)
            if np.isnan(values[:, :2]).all():
                continue
            if check and individual.depth is not None:
                check.add(np.column_stack([values[:, :2], row[individual.depth]]))
            identity = as_identity(individual.name)
            identity = None if identity == _UNIQUE else identity
            builder.add(frame, values, identity, None, individual.kind)
    finish_checks(checks)


def depth_checks(individuals: Sequence[Individual]) -> list[DepthCheck | None]:
    """Return what tells 3D places from MediaPipe's z, for each individual with z."""
    checks: list[DepthCheck | None] = []
    for individual in individuals:
        is_sure = bool((individual.confidence >= 0).all())
        check = DepthCheck(
            individual.keypoints,
            has_confidence=is_sure,
            has_visibility=individual.has_visibility,
        )
        checks.append(None if individual.depth is None else check)
    return checks


def finish_checks(checks: Sequence[DepthCheck | None]) -> None:
    """Raise KeypointFileError if a table is 3D."""
    for check in checks:
        if check:
            check.finish()


def used_columns(individuals: Sequence[Individual]) -> list[int]:
    """Return the columns that hold numbers of keypoints, in ascending order."""
    columns: list[NDArray[np.int64]] = []
    for each in individuals:
        columns += [each.xy.ravel(), each.confidence]
        columns += [] if each.depth is None else [each.depth]
    return [int(i) for i in np.unique(np.concatenate(columns)) if i >= 0]


def values_of(
    row: Sequence[str], used: Sequence[int], width: int, numbers: Numbers, line: int
) -> NDArray[np.float64]:
    """Return the numbers (width,) in the used cells of a row, NaN elsewhere."""
    values = np.full(width, np.nan)
    count = len(row)
    if count > used[-1]:
        cells = [row[i] for i in used]
    else:
        cells = [row[i] if i < count else "" for i in used]
    values[used] = numbers.row(cells, line)
    return values


def _find_incomplete(places: Mapping[str, Mapping[str, int]], builder: DetectionsBuilder) -> None:
    """Add a finding if a keypoint has a column of one coordinate only.

    Args:
        places: columns of each keypoint, by coordinate.
        builder: gets the finding.
    """
    halves = [
        f"{part} has {'x but no y' if 'x' in at else 'y but no x'}"
        for part, at in places.items()
        if ("x" in at) != ("y" in at)
    ]
    if halves:
        more = ", ..." * (len(halves) > _SHOWN)
        builder.find(
            Finding(
                "incomplete",
                f"columns are missing: {', '.join(halves[:_SHOWN])}{more}, so that no object has "
                "these keypoints; add the columns, or correct their names",
            )
        )


def _confidence_columns(places: Mapping[str, Mapping[str, int]]) -> NDArray[np.int64]:
    """Return the column (q,) of each keypoint's confidence, -1 for none."""
    return np.array([next((at[c] for c in CONFIDENCE if c in at), -1) for at in places.values()])


def find_confidence(name: str, known: str, builder: DetectionsBuilder) -> None:
    """Add the finding that a further column of all keypoints may be their confidence.

    Args:
        name: of the column, without that of the keypoint.
        known: name under which a confidence is read.
        builder: gets the finding.
    """
    builder.find(
        Finding(
            "unused",
            f"not used: column {name!r} of each keypoint; if it is the confidence, call it "
            f"{known!r}",
        )
    )
