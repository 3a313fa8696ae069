# SPDX-License-Identifier: Apache-2.0
"""Tables of keypoints: CSV of DeepLabCut, SLEAP, MediaPipe and others."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import (
    DetectionsBuilder,
    KeypointFileError,
    as_identity,
)
from deep_nrsfm_ros.data.formats.cells import Numbers, is_missing
from deep_nrsfm_ros.data.formats.columns import (
    CONFIDENCE,
    COORDINATES,
    Columns,
    Part,
    find_columns,
    find_parts,
    is_time,
    unit_of,
    without_unit,
    words,
)
from deep_nrsfm_ros.data.formats.depth_check import DepthCheck, three_d
from deep_nrsfm_ros.data.formats.table_frames import RowFrames
from deep_nrsfm_ros.data.formats.table_text import Row, is_number, table_rows
from deep_nrsfm_ros.lifting.sanity import Finding

_EXPECTED = (
    "neither of DeepLabCut (rows scorer, bodyparts, coords), nor with a landmark a row (columns "
    "frame, landmark, x, y), nor with a column for each coordinate (nose_x, nose_y, ... or "
    "x_nose, y_nose, ...)"
)
_UNIQUE = "single"  # individual of DeepLabCut that has the unique bodyparts
_SHOWN = 4  # names that a finding lists
_LEVELS = 4  # rows of a header at most
_SAMPLE = 500  # rows that tell what a column holds
_WIDE = 4  # keypoints with columns of their own, which no table with a keypoint a row has
_FEW = 0.01  # fraction of rows that are left out, up to which they are no cause for doubt
_OF_3D = {"error", "ncams"}  # columns of a keypoint that Anipose triangulates
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg")

Column = tuple[str, str, str]
"""Individual ("" where there is one only), keypoint and coordinate of a column."""


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
                _landmark_rows(head, columns, body, builder)
                return
        _coordinate_columns(head, body, builder)


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
    things = find_things(parts_of(levels.columns), builder)
    used = _used(things)
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
                yield at, _values(row[index:], used, width, numbers, line)

    add_things(things, table(), builder)
    numbers.say(builder)
    frames.finish()


def _name_of_index(rows: Sequence[Row], index: int) -> str:
    """Return the name of the index, which pandas writes into a row of its own; "" for none."""
    if len(rows) < 2 or index != 1 or any(cell.strip() for cell in rows[0][1][1:]):
        return ""
    (_, first), (_, second) = rows
    is_name = first and second and not is_number(first[0]) and is_number(second[0])
    return first[0].strip() if is_name or (first and is_time(words(first[0]))) else ""


def parts_of(columns: Sequence[Column]) -> list[Part]:
    """Return the keypoints of the columns of a table with rows of levels."""
    places: dict[tuple[str, str], dict[str, int]] = {}
    for i, (individual, part, coordinate) in enumerate(columns):
        places.setdefault((individual, part), {})[coordinate.lower()] = i
    return [Part(individual, part, at) for (individual, part), at in places.items()]


@dataclass(frozen=True)
class Thing:
    """An individual of a table with columns for each of its keypoints.

    Attributes:
        individual: its name; "" where there is one only.
        kind: its category; None where there is one only.
        xy: columns (q, 2) of x and y.
        confidence: columns (q,) of the confidence, -1 for none.
        depth: columns (q,) of z; None where a keypoint has none.
        names: of the q keypoints.
    """

    individual: str
    kind: int | None
    xy: NDArray[np.int64]
    confidence: NDArray[np.int64]
    depth: NDArray[np.int64] | None
    names: Sequence[str]

    def values(self, row: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return x, y and confidence (q, 3) in the values of a row.

        An object that has places and no confidence at all was labelled by hand: it is sure.
        """
        points = row[self.xy]
        confidence = np.where(self.confidence < 0, 1.0, row[self.confidence])
        if np.isnan(confidence).all() and not np.isnan(points).all():
            confidence[:] = 1.0
        return np.column_stack([points, confidence])


def find_things(
    parts: Sequence[Part], builder: DetectionsBuilder, *, may_be_one: bool = False
) -> list[Thing]:
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
    things = []
    for individual, each in places.items():
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
            names.setdefault(kind, []).append(individual)
            builder.name_category(kind, ", ".join(names[kind]))
        xy = np.array([(at["x"], at["y"]) for at in complete.values()])
        has_depth = all("z" in at for at in complete.values())
        depth = np.array([at["z"] for at in complete.values()]) if has_depth else None
        confidence = _confidence_columns(complete)
        things.append(Thing(individual, kind, xy, confidence, depth, list(complete)))
    if not things:
        raise KeypointFileError(f"no keypoint has columns x and y; it is {_EXPECTED}")
    return things


def add_things(
    things: Sequence[Thing],
    rows: Iterable[tuple[int, NDArray[np.float64]]],
    builder: DetectionsBuilder,
) -> None:
    """Add a table with a row for each frame.

    An individual without any coordinate in a frame is not there.

    Args:
        things: the individuals.
        rows: (index of the frame, values of all columns).
        builder: gets the objects.

    Raises:
        KeypointFileError: the table is 3D.
    """
    checks = _depth_checks(things)
    for frame, row in rows:
        for thing, check in zip(things, checks, strict=True):
            values = thing.values(row)
            if np.isnan(values[:, :2]).all():
                continue
            if check and thing.depth is not None:
                check.add(np.column_stack([values[:, :2], row[thing.depth]]))
            identity = as_identity(thing.individual)
            identity = None if identity == _UNIQUE else identity
            builder.add(frame, values, identity, None, thing.kind)
    _finish_checks(checks)


def _depth_checks(things: Sequence[Thing]) -> list[DepthCheck | None]:
    """Return what tells 3D places from MediaPipe's z, for each individual with z."""
    return [
        None
        if thing.depth is None
        else DepthCheck(thing.names, has_confidence=bool((thing.confidence >= 0).all()))
        for thing in things
    ]


def _finish_checks(checks: Sequence[DepthCheck | None]) -> None:
    """Raise KeypointFileError if a table is 3D."""
    for check in checks:
        if check:
            check.finish()


def _used(things: Sequence[Thing]) -> list[int]:
    """Return the columns that hold numbers of keypoints, in ascending order."""
    columns = [
        np.concatenate(
            [t.xy.ravel(), t.confidence, t.depth if t.depth is not None else t.confidence]
        )
        for t in things
    ]
    return [int(i) for i in np.unique(np.concatenate(columns)) if i >= 0]


def _values(
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


def _landmark_rows(
    head: Sequence[str], columns: Columns, rows: Iterator[Row], builder: DetectionsBuilder
) -> None:
    """Read a table with a row for each landmark of an object."""
    assert columns.x is not None and columns.y is not None and columns.keypoint is not None
    time = head[columns.time[0]] if columns.time else ""
    frames, numbers = RowFrames(builder, time, columns.unit), Numbers()
    has_frames = columns.frame is not None or bool(columns.time)
    objects: dict[tuple[int, tuple[str, ...]], dict[str, tuple[float, ...]]] = {}
    scores: dict[tuple[int, tuple[str, ...]], float] = {}
    order: dict[str, None] = {}
    counts: Counter[tuple[str, ...]] = Counter()
    repeated = total = 0
    places = [i for i in (columns.x, columns.y, columns.confidence, columns.z) if i is not None]
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) < len(head):
            builder.leave_out("are rows with too few cells", f"line {line}")
            continue
        total += 1
        mark = row[columns.keypoint].strip()
        who = tuple(row[i].strip() for i in columns.identities)
        number = 0 if has_frames else counts[who]
        frame = None if columns.frame is None else row[columns.frame]
        times = [row[i] for i in columns.time]
        index = frames.of(line, number, frame, times)
        if index < 0:
            continue
        order[mark] = None
        if columns.video is not None:
            frames.video(row[columns.video].strip())
        if mark in objects.get((index, who), {}):
            if not has_frames:  # the next frame of this object
                counts[who] += 1
                index = frames.of(line, counts[who], None, ())
            else:
                repeated += 1
                builder.leave_out(
                    "are rows before another one of the same landmark and frame (people need a "
                    "column such as person_id)",
                    f"before line {line}",
                )
        values = numbers.row([row[i] for i in places], line).tolist()
        x, y = values[:2]
        c = 1.0 if columns.confidence is None else values[2]
        z = np.nan if columns.z is None else values[-1]
        objects.setdefault((index, who), {})[mark] = (x, y, c, z)
        if columns.score is not None and is_number(row[columns.score]):
            scores[index, who] = float(row[columns.score])
    if not order:
        raise KeypointFileError("it has no row with a landmark")
    if repeated > _FEW * total:
        builder.find(
            Finding(
                "repeated",
                f"{repeated} of {total} rows are of a landmark that another row of their frame has "
                "too, and are not read: name the column that tells the people or animals of a "
                "frame apart track_id",
            )
        )
    numbers.say(builder)
    frames.finish()
    _say_unused(head, columns, [], builder)
    if all(mark.isdecimal() and len(mark) < 5 for mark in order):
        q = max(int(mark) for mark in order) + 1
        at = {mark: int(mark) for mark in order}
    else:
        q = len(order)
        at = {mark: i for i, mark in enumerate(order)}
        builder.name_keypoints(list(order))
    builder.is_mediapipe = True
    check = DepthCheck(list(order), has_confidence=columns.confidence is not None)
    for (index, who), landmarks in objects.items():
        values = np.full((q, 4), np.nan)
        for mark, value in landmarks.items():
            values[at[mark]] = value
        if columns.z is not None:
            check.add(values[:, [0, 1, 3]])
        if np.isnan(values[:, 2]).all() and not np.isnan(values[:, :2]).all():
            values[:, 2] = 1.0  # labelled by hand
        builder.add(index, values[:, :3], _identity(who), scores.get((index, who)))
    check.finish()


def _identity(cells: Sequence[str]) -> str | None:
    """Return the identity that cells say, the surest one first; None for none."""
    return next((as_identity(cell.strip()) for cell in cells if not is_missing(cell)), None)


def _coordinate_columns(
    head: Sequence[str], rows: Iterator[Row], builder: DetectionsBuilder
) -> None:
    """Read a table with a row for each object and a column for each coordinate: nose_x, ..."""
    parts = _of_one_camera(find_parts(head))
    if not any(part.is_complete for part in parts):
        shown = ", ".join(head[:6])
        if sum(is_number(cell) for cell in head) > len(head) / 2:
            raise KeypointFileError(
                f"its first line has no names of columns but numbers ({shown}): write a line such "
                "as frame,nose_x,nose_y,nose_confidence above it, or save an .npy (objects, q, 3)"
            )
        raise KeypointFileError(f"it is {_EXPECTED}; its columns are {shown}")
    taken = {i for part in parts if {"x", "y"} & set(part.at) for i in part.at.values()}
    sample = list(islice(rows, _SAMPLE))
    columns = _without_videos(head, taken, sample)
    columns = _without_row_numbers(head, columns, sample)
    _refuse_3d(head, parts)
    things = find_things(parts, builder, may_be_one=True)
    _find_units(head, things, builder)
    builder.is_mediapipe = True
    used, numbers = _used(things), Numbers()
    checks = _depth_checks(things)
    time = head[columns.time[0]] if columns.time else ""
    frames = RowFrames(builder, time, columns.unit)
    tracks = {t.individual: _column_of(head, t.individual, "track") for t in things}
    grades = {t.individual: _column_of(head, t.individual, "score") for t in things}
    if len(things) == 1 and grades[things[0].individual] is None:
        grades[things[0].individual] = columns.score

    for number, (line, row) in enumerate(chain(sample, rows)):
        if not any(cell.strip() for cell in row):
            continue
        row = row + [""] * (len(head) - len(row))
        frame = None if columns.frame is None else row[columns.frame]
        index = frames.of(line, number, frame, [row[i] for i in columns.time])
        if index < 0:
            continue
        if columns.video is not None:
            frames.video(row[columns.video].strip())
        values = _values(row, used, len(head), numbers, line)
        for thing, check in zip(things, checks, strict=True):
            own = thing.values(values)
            if len(things) > 1 and np.isnan(own[:, :2]).all():
                continue
            if check and thing.depth is not None:
                check.add(np.column_stack([own[:, :2], values[thing.depth]]))
            track, grade = tracks[thing.individual], grades[thing.individual]
            if len(things) > 1 or track is not None:
                identity = as_identity(thing.individual if track is None else row[track].strip())
            else:
                identity = _identity([row[i] for i in columns.identities])
            score = float(row[grade]) if grade is not None and is_number(row[grade]) else None
            score = None if score is None or np.isnan(score) else score
            builder.add(index, own, identity, score, thing.kind)
    _finish_checks(checks)
    numbers.say(builder)
    frames.finish()
    own_columns = {i for i in (*tracks.values(), *grades.values()) if i is not None}
    unused = tuple(i for i in columns.unused if i not in own_columns)
    _say_unused(head, columns, things, builder, unused)
    _find_roles(head, columns, [row for _, row in sample if row], builder)


def _column_of(head: Sequence[str], individual: str, name: str) -> int | None:
    """Return the column such as inst0.track of an individual; None if there is none."""
    found = [i for i, cell in enumerate(head) if individual and cell == f"{individual}.{name}"]
    return found[0] if found else None


def _of_one_camera(parts: list[Part]) -> list[Part]:
    """Return keypoints without the camera in their names: pt1 of pt1_cam1 (DLTdv).

    Raises:
        KeypointFileError: they are of several cameras.
    """
    found = [re.fullmatch(r"(.+)[_. -](cam(?:era)?[_ ]?\d+)", part.name, re.I) for part in parts]
    cameras = sorted({match[2] for match in found if match})
    if None in found or not cameras:
        return parts
    if len(cameras) > 1:
        raise KeypointFileError(
            f"its columns are of several cameras ({', '.join(cameras)}): write a table for each"
        )
    return [
        Part(part.individual, match[1], part.at)
        for part, match in zip(parts, found, strict=True)
        if match
    ]


def _refuse_3d(head: Sequence[str], parts: Sequence[Part]) -> None:
    """Raise KeypointFileError if columns of a keypoint are those of a triangulated one."""
    endings = {words(cell)[-1] for cell in head if words(cell)}
    for part in parts:
        if part.is_complete and "z" in part.at and endings >= _OF_3D:
            raise KeypointFileError(three_d(f"{part.name} has z, error and ncams"))


def _find_units(head: Sequence[str], things: Sequence[Thing], builder: DetectionsBuilder) -> None:
    """Add a finding if the names of columns say that coordinates are no pixels."""
    names = [head[int(i)] for thing in things for i in thing.xy.ravel()]
    units = sorted({unit_of(name) for name in names} - {""})
    if units:
        builder.find(
            Finding(
                "units",
                f"its coordinates are in {', '.join(units)} by the names of its columns, such as "
                f"{names[0]}: pixels of the image are needed",
            )
        )


def _without_videos(head: Sequence[str], taken: set[int], sample: Sequence[Row]) -> Columns:
    """Return what columns mean; one that names the file of a video is no column of the frame."""
    columns = find_columns(head, taken, has_points=False)
    for i in (columns.frame, *columns.unused):
        if i is None or columns.video is not None:
            continue
        names = {row[i].strip().lower() for _, row in sample if len(row) > i}
        if names and all(name.endswith(_VIDEOS) for name in names):
            return replace(find_columns(head, {*taken, i}, has_points=False), video=i)
    return columns


def _without_row_numbers(head: Sequence[str], columns: Columns, sample: Sequence[Row]) -> Columns:
    """Return what columns mean; an `id` that is another one in each row is that of the row."""
    if not columns.identities or words(head[columns.identities[0]]) != ["id"]:
        return columns
    cells = [row[columns.identities[0]] for _, row in sample if len(row) >= len(head)]
    is_of_row = len(cells) > 1 and len(set(cells)) == len(cells)
    return replace(columns, identities=()) if is_of_row else columns


def _say_unused(
    head: Sequence[str],
    columns: Columns,
    things: Sequence[Thing],
    builder: DetectionsBuilder,
    unused: tuple[int, ...] | None = None,
) -> None:
    """Say which columns are not used, and find those that seem to be missing."""
    remedies = {}
    if columns.frame is None:
        remedies["the frame"] = "frame"
    if not columns.time:
        remedies["the time"] = "timestamp"
    if not columns.identities and len(things) < 2:
        remedies["an identity"] = "track_id"
    has_confidence = columns.confidence is not None or any(
        (thing.confidence >= 0).any() for thing in things
    )
    if not has_confidence:
        name = things[0].names[0] if things else ""
        remedies["a confidence"] = f"{name}_confidence" if name else "confidence"
    names = [head[i] for i in (columns.unused if unused is None else unused)]
    builder.not_used("columns", names, remedies)
    if things and not has_confidence:
        _find_endings(names, things, builder)


def _find_endings(
    names: Sequence[str], things: Sequence[Thing], builder: DetectionsBuilder
) -> None:
    """Add a finding if all keypoints have a further column, which may be their confidence."""
    endings: Counter[str] = Counter()
    for keypoint in things[0].names:
        for name in names:
            if name.startswith(keypoint) and len(name) > len(keypoint):
                endings[name[len(keypoint) :].strip("_. -")] += 1
    whole = [ending for ending, count in endings.items() if count == len(things[0].names)]
    if whole:
        builder.find(
            Finding(
                "unused",
                f"not used: column {whole[0]!r} of each keypoint; if it is the confidence, call it "
                f"'{things[0].names[0]}_confidence', ...",
            )
        )


def _find_roles(
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
        who = {row[columns.identities[0]] for row in rows}
        if 1 < len(who) < len(rows):
            builder.find(
                Finding(
                    "frame",
                    f"it has no column of the frame, so that each row is one, and "
                    f"{len(who)} identities ({head[columns.identities[0]]}): add a column 'frame'",
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
