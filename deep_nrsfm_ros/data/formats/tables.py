# SPDX-License-Identifier: Apache-2.0
"""Tables of keypoints: CSV of DeepLabCut, SLEAP, MediaPipe and others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder, KeypointFileError
from deep_nrsfm_ros.data.formats.cells import Numbers
from deep_nrsfm_ros.data.formats.columns import (
    COORDINATES,
    Columns,
    find_columns,
    find_parts,
    is_time,
    without_unit,
    words,
)
from deep_nrsfm_ros.data.formats.coordinate_columns import read_coordinate_columns
from deep_nrsfm_ros.data.formats.individuals import (
    Column,
    add_individuals,
    find_individuals,
    parts_of,
    used_columns,
    values_of,
)
from deep_nrsfm_ros.data.formats.landmark_rows import read_landmark_rows
from deep_nrsfm_ros.data.formats.table_frames import RowFrames
from deep_nrsfm_ros.data.formats.table_text import Row, is_number, table_rows

_LEVELS = 4  # rows of a header at most
_WIDE = 4  # keypoints with columns of their own, which no table with a keypoint a row has


def read_csv(path: Path, builder: DetectionsBuilder) -> None:
    """Read a table of DeepLabCut, of a landmark a row, or of a column for each coordinate."""
    comments: list[str] = []
    with table_rows(path, comments) as rows:
        if comments:
            builder.notes.append(f"comments are not read, such as {comments[0][:60]!r}")
        start = list(islice(rows, _LEVELS + 1))
        head = [cell.strip() for cell in start[0][1]]
        if levels := _find_levels(start, builder):
            _deeplabcut_rows(levels, chain(start[levels.rows :], rows), builder)
            return
        body = chain(start[1:], rows)
        plain = {without_unit(cell).lower() for cell in head}
        if {"x", "y"} <= plain and sum(part.is_complete for part in find_parts(head)) < _WIDE:
            columns = find_columns(head, (), has_points=True)
            is_id = columns.keypoint is not None and words(head[columns.keypoint]) == ["id"]
            if columns.keypoint is not None and (columns.z is not None or not is_id):
                read_landmark_rows(head, columns, body, builder)
                return
        read_coordinate_columns(head, body, builder)


@dataclass(frozen=True)
class _Levels:
    """Rows of a header of several rows.

    Attributes:
        columns: of the table, without those of the index.
        index: columns that name the frame.
        rows: of the header.
    """

    columns: list[Column]
    index: int
    rows: int


def _find_levels(start: Sequence[Row], builder: DetectionsBuilder) -> _Levels | None:
    """Return the rows of a header as DeepLabCut writes it; None if there is another one.

    Raises:
        KeypointFileError: it begins as one, but lacks a row.
    """
    rows = [[cell.strip() for cell in cells] for _, cells in start]
    marks = [row[0].lower() if row else "" for row in rows]
    is_named = marks[0] in ("scorer", "bodyparts", "individuals")
    last = marks.index("coords") if "coords" in marks else -1
    if is_named and (last < 0 or "bodyparts" not in marks[:last]):
        raise KeypointFileError("a CSV of DeepLabCut needs the rows scorer, bodyparts and coords")
    if is_named:
        levels = dict(zip(marks[: last + 1], rows, strict=False))
        # Labelled data have three columns of the image: folder, video, file.
        index = next((i for i, cell in enumerate(levels["coords"][1:], 1) if cell), 1)
        parts, individuals = levels["bodyparts"], levels.get("individuals")
    else:
        found = next((i for i, row in enumerate(rows[1:], 1) if _are_coordinates(row)), 0)
        if not found:
            return None
        last = found
        index = next(i for i, cell in enumerate(rows[last]) if cell.lower() in COORDINATES)
        parts = _filled(rows[last - 1], index)
        above = [_filled(row, index) for row in rows[: last - 1]]
        individuals = next((row for row in above[::-1] if len(set(row[index:])) > 1), None)
    coordinates = [cell.lower() for cell in rows[last]]
    columns = list(
        zip(individuals or [""] * len(parts), parts, coordinates, strict=False),
    )[index:]
    return _Levels(columns, index, last + 1)


def _are_coordinates(row: Sequence[str]) -> bool:
    """Return whether a row of a header has the coordinates x, y, ... of several keypoints."""
    cells = [cell.lower() for cell in row]
    first = next((i for i, cell in enumerate(cells) if cell in COORDINATES), len(cells))
    rest = [cell for cell in cells[first:] if cell]
    is_sound = all(cell in COORDINATES for cell in rest)
    return is_sound and rest.count("x") > 1 and rest.count("x") == rest.count("y")


def _filled(row: Sequence[str], index: int) -> list[str]:
    """Return a row in which a blank cell, as of cells that were merged, is as the one before."""
    filled = list(row)
    for i in range(index + 1, len(filled)):
        filled[i] = filled[i] or filled[i - 1]
    return filled


def _deeplabcut_rows(levels: _Levels, rows: Iterator[Row], builder: DetectionsBuilder) -> None:
    """Read the rows of a table of DeepLabCut after its header."""
    index, width = levels.index, len(levels.columns)
    first = list(islice(rows, 2))
    name = _name_of_index(first, index)
    rows = chain(first[1:] if name else first, rows)
    has_time = bool(name) and is_time(words(name))
    columns = find_columns([name], (), has_points=False) if has_time else Columns()
    frames = RowFrames(builder, name if has_time else "", columns.unit)
    individuals = find_individuals(parts_of(levels.columns, builder), builder)
    used = used_columns(individuals)
    numbers = Numbers()

    def table() -> Iterator[tuple[int, NDArray[np.float64]]]:
        number = 0
        for line, row in rows:
            if not row:
                continue
            marks = [cell.strip() for cell in row[:index]]
            key = "/".join(cell for cell in marks if cell) or None
            at = frames.of(line, number, None if has_time else key, marks if has_time else ())
            number += 1
            if at >= 0:
                yield at, values_of(row[index:], used, width, numbers, line)

    add_individuals(individuals, table(), builder)
    numbers.say(builder)
    frames.finish()


def _name_of_index(rows: Sequence[Row], index: int) -> str:
    """Return the name of the index, which pandas writes into a row of its own; "" for none."""
    if len(rows) < 2 or index != 1 or any(cell.strip() for cell in rows[0][1][1:]):
        return ""
    (_, first), (_, second) = rows
    is_name = first and second and not is_number(first[0]) and is_number(second[0])
    return first[0].strip() if is_name or (first and is_time(words(first[0]))) else ""
