# SPDX-License-Identifier: Apache-2.0
"""Tables of keypoints: CSV of DeepLabCut and MediaPipe, H5 of DeepLabCut, TRC of Sports2D."""

from __future__ import annotations

import csv
import io
import pickle
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import (
    TIMES,
    DetectionsBuilder,
    KeypointFileError,
    as_identity,
)
from deep_nrsfm_ros.extras import require_extra
from deep_nrsfm_ros.lifting.sanity import Finding

_CONFIDENCE = ("likelihood", "visibility", "score", "confidence", "conf", "presence", "v", "c", "s")
_COORDINATES = ("x", "y", "z", *_CONFIDENCE)
_FRAME = (
    *("frame", "frame_id", "frame_number", "frame_index", "frame_idx", "image", "image_id"),
    *("image_name", "file_name", "filename", "file"),
)
_OBJECT = ("person", "person_id", "pose", "pose_id", "track_id", "object", "object_id", "instance")
_KEYPOINT = (
    *("landmark", "landmark_id", "landmark_index", "landmark_name", "keypoint", "keypoint_id"),
    *("keypoint_name", "joint", "joint_id", "joint_name", "bodypart", "part", "name", "index"),
)
_EXPECTED = (
    "neither of DeepLabCut (rows scorer, bodyparts, coords), nor with a landmark a row (columns "
    "frame, landmark, x, y), nor with a column for each coordinate (nose_x, nose_y, ... or "
    "x_nose, y_nose, ...)"
)
_UNIQUE = "single"  # individual of DeepLabCut that has the unique bodyparts
_DECIMAL_COMMA = re.compile(r"^(\s*[-+]?\d+),(\d+)")
_SHOWN = 4  # keypoints that a finding names
_METRES = 50.0  # a larger coordinate of a TRC is in pixels: no one is filmed on 50 m

Column = tuple[str, str, str]
"""Individual ("" where there is one only), keypoint and coordinate of a column."""


def read_csv(path: Path, builder: DetectionsBuilder) -> None:
    """Read a table of DeepLabCut, of a landmark a row, or of a column for each coordinate."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        first = file.readline()
        delimiter = max(",;\t", key=first.count)
        rows: Iterator[list[str]] = csv.reader(chain([first], file), delimiter=delimiter)
        if delimiter != ",":  # spreadsheets of half of Europe write 1,5 for 1.5
            rows = ([_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in row] for row in rows)
        head = [cell.strip() for cell in next(rows, [])]
        if not any(head):
            raise KeypointFileError("the file is empty, or its first line is")
        if head[0].lower() == "scorer":
            _deeplabcut_rows(head, rows, builder)
            return
        names = [re.sub(r"[^a-z0-9]+", "_", cell.lower()).strip("_") for cell in head]
        if "x" in names and "y" in names and any(name in names for name in _KEYPOINT):
            _landmark_rows(names, rows, builder)
        else:
            _coordinate_columns(head, rows, builder)


def _deeplabcut_rows(
    head: list[str], rows: Iterator[list[str]], builder: DetectionsBuilder
) -> None:
    """Read the rest of a CSV of DeepLabCut after its first row."""
    levels = {head[0].lower(): head}
    index = 1
    for row in rows:
        levels[row[0].strip().lower()] = [cell.strip() for cell in row]
        if row[0].strip().lower() == "coords":
            # Labelled data have three columns of the image: folder, video, file.
            index = next((i for i, cell in enumerate(row[1:], 1) if cell.strip()), 1)
            break
    if "bodyparts" not in levels or "coords" not in levels:
        raise KeypointFileError("a CSV of DeepLabCut needs the rows scorer, bodyparts and coords")
    parts, coordinates = levels["bodyparts"], levels["coords"]
    individuals = levels.get("individuals", [""] * len(parts))
    columns = list(zip(individuals, parts, coordinates, strict=False))[index:]
    table = ((_key(row[:index]), _numbers(row[index:], len(columns))) for row in rows if row)
    add_table(columns, table, builder)


def read_h5(path: Path, builder: DetectionsBuilder) -> None:
    """Read a table that DeepLabCut wrote with pandas, of the format "table" or "fixed".

    Names of columns in the format "table" are pickled. They are read by an unpickler that makes
    lists, tuples, numbers and texts only.
    """
    require_extra("hdf5", "reading .h5 (or give the .csv that DeepLabCut writes beside it)")
    import h5py  # imported here because it is an extra

    try:
        with h5py.File(path, "r") as file:
            groups = [group for group in file.values() if "pandas_type" in group.attrs]
            if not groups:
                raise KeypointFileError(
                    f"no table of DeepLabCut; it holds {', '.join(map(str, file)) or 'nothing'}"
                )
            group = groups[0]
            if "table" in group:
                columns, index, values = _pandas_table(group)
            else:
                columns, index, values = _pandas_fixed(group)
    except OSError as error:
        raise KeypointFileError(f"damaged or no HDF5: {error}") from None
    except (KeyError, pickle.UnpicklingError, AttributeError) as error:
        raise KeypointFileError(f"no table as DeepLabCut writes it: {error}") from None
    add_table([_column(c) for c in columns], zip(index, values, strict=False), builder)


def _pandas_table(group: Any) -> tuple[list[Any], list[Any], NDArray[np.float64]]:
    """Return columns, index and values of a DataFrame in the format "table"."""
    axes = _Unpickler(io.BytesIO(bytes(group.attrs["non_index_axes"]))).load()
    table = group["table"][:]
    blocks = [name for name in table.dtype.names if name.startswith("values_block")]
    if len(blocks) != 1:
        raise KeypointFileError("its columns are of several types; DeepLabCut writes numbers only")
    index = [_text(value) for value in table["index"].tolist()]
    return list(axes[0][1]), index, np.asarray(table[blocks[0]], np.float64)


def _pandas_fixed(group: Any) -> tuple[list[Any], list[Any], NDArray[np.float64]]:
    """Return columns, index and values of a DataFrame in the format "fixed"."""
    index = _axis(group, "axis1")
    # With three levels the last one names the image: folder, video, file.
    index = ["/".join(map(str, key)) if isinstance(key, tuple) else key for key in index]
    return _axis(group, "block0_items"), index, np.asarray(group["block0_values"][:], np.float64)


def _axis(group: Any, name: str) -> list[Any]:
    """Return the labels of an axis, tuples for several levels."""
    if f"{name}_level0" not in group:
        return [_text(value) for value in group[name][:].tolist()]
    levels: list[list[Any]] = []
    while f"{name}_level{len(levels)}" in group:
        values = group[f"{name}_level{len(levels)}"][:].tolist()
        labels = group[f"{name}_label{len(levels)}"][:].tolist()
        levels.append([_text(values[label]) for label in labels])
    return list(zip(*levels, strict=True))


def _text(value: Any) -> Any:
    """Return bytes as text, and anything else as it is."""
    return value.decode(errors="replace") if isinstance(value, bytes) else value


class _Unpickler(pickle.Unpickler):
    """Makes plain values only: it finds no class or function, so it runs no code."""

    def find_class(self, module: str, name: str) -> Any:
        """Raise UnpicklingError."""
        raise pickle.UnpicklingError(f"it holds a Python object {module}.{name}")


def _column(levels: Any) -> Column:
    """Return the column of a label of pandas: scorer, (individual,) keypoint, coordinate."""
    texts = [str(level) for level in levels] if isinstance(levels, (tuple, list)) else []
    if len(texts) not in (3, 4):
        raise KeypointFileError(
            f"its columns are {levels!r:.60}, not scorer, bodypart and coordinate of DeepLabCut"
        )
    return (texts[1] if len(texts) == 4 else "", texts[-2], texts[-1])


def add_table(
    columns: Sequence[Column],
    rows: Iterable[tuple[Any, NDArray[np.float64]]],
    builder: DetectionsBuilder,
) -> None:
    """Add a table with a row for each frame and a column for each coordinate.

    Individuals with other keypoints than the first one are a category of their own. An individual
    without any coordinate in a frame is not there.

    Args:
        columns: of the table.
        rows: (number or name of the frame, values (columns,)).
        builder: gets the objects.
    """
    places: dict[str, dict[str, dict[str, int]]] = {}
    for i, (individual, part, coordinate) in enumerate(columns):
        places.setdefault(individual, {}).setdefault(part, {})[coordinate.lower()] = i
    if _UNIQUE in places and len(places) > 1 and builder.options.category != _UNIQUE:
        for part in places.pop(_UNIQUE):
            builder.leave_out(
                f"are points of the scene, not of an individual (--category {_UNIQUE} reads them)",
                part,
            )
    _find_incomplete({part: at for parts in places.values() for part, at in parts.items()}, builder)
    kinds: dict[tuple[str, ...], int] = {}
    names: dict[int, list[str]] = {}
    plan = []
    for individual, parts in places.items():
        complete = {name: at for name, at in parts.items() if "x" in at and "y" in at}
        if not complete:
            continue
        kind = kinds.setdefault(tuple(complete), len(kinds))
        if kind not in names:
            builder.name_keypoints(list(complete), kind)
        names.setdefault(kind, []).append(individual)
        builder.name_category(kind, ", ".join(names[kind]))
        xy = np.array([(at["x"], at["y"]) for at in complete.values()])
        plan.append((individual, kind, xy, _confidence_columns(complete)))
    if not plan:
        raise KeypointFileError(f"no keypoint has columns x and y; it is {_EXPECTED}")
    for number, (key, values) in enumerate(rows):
        frame = _frame(builder, key, number)
        for individual, kind, xy, likelihood in plan:
            points = values[xy]
            if np.isnan(points).all():
                continue
            confidence = np.where(likelihood < 0, 1.0, values[likelihood])
            identity = as_identity(individual)
            identity = None if identity == _UNIQUE else identity
            builder.add(frame, np.column_stack([points, confidence]), identity, None, kind)


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
    return np.array([next((at[c] for c in _CONFIDENCE if c in at), -1) for at in places.values()])


def _frame(builder: DetectionsBuilder, key: Any, number: int) -> int:
    """Return the index of the frame with a number or name; None is the row's number."""
    if key is None:
        return builder.frame(number)
    if isinstance(key, str) and "/" in key:
        return builder.frame(key, key.rsplit("/", 1)[1])
    return builder.frame(key)


def _key(cells: Sequence[str]) -> int | str | None:
    """Return the number or name of a frame in the cells of its index."""
    text = "/".join(cell.strip() for cell in cells if cell.strip())
    try:
        return int(float(text))
    except (ValueError, OverflowError):
        return text or None


def _numbers(cells: Sequence[str], count: int) -> NDArray[np.float64]:
    """Return cells as numbers (count,), NaN for what is none or absent."""
    return np.array([_number(cell) for cell in cells[:count]] + [np.nan] * (count - len(cells)))


def _number(cell: str) -> float:
    """Return a cell as a number, NaN for what is none."""
    try:
        return float(cell)
    except ValueError:
        return np.nan


def _landmark_rows(names: list[str], rows: Iterator[list[str]], builder: DetectionsBuilder) -> None:
    """Read a table with a row for each landmark of an object."""
    x, y = names.index("x"), names.index("y")
    confidence = next((names.index(c) for c in _CONFIDENCE if c in names), None)
    keypoint = next(names.index(c) for c in _KEYPOINT if c in names)
    frame = next((names.index(c) for c in _FRAME if c in names), None)
    person = next((names.index(c) for c in _OBJECT if c in names), None)
    objects: dict[tuple[Any, str], dict[str, tuple[float, float, float]]] = {}
    order: dict[str, None] = {}
    counts: Counter[str] = Counter()
    for line, row in enumerate(rows, 2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) < len(names):
            builder.leave_out("are rows with too few cells", f"line {line}")
            continue
        mark = row[keypoint].strip()
        order[mark] = None
        who = "" if person is None else row[person]
        key = (counts[who] if frame is None else _key([row[frame]]), who)
        if mark in objects.get(key, {}):
            if frame is None:  # the next frame of this object
                counts[who] += 1
                key = (counts[who], who)
            else:
                builder.leave_out(
                    "are rows before another one of the same landmark and frame (people need a "
                    "column such as person_id)",
                    f"before line {line}",
                )
        c = 1.0 if confidence is None else _number(row[confidence])
        objects.setdefault(key, {})[mark] = (_number(row[x]), _number(row[y]), c)
    if not order:
        raise KeypointFileError("it has no row with a landmark")
    if all(mark.isdecimal() and len(mark) < 5 for mark in order):
        q = max(int(mark) for mark in order) + 1
        places = {mark: int(mark) for mark in order}
    else:
        q = len(order)
        places = {mark: i for i, mark in enumerate(order)}
        builder.name_keypoints(list(order))
    builder.is_mediapipe = True
    for (name, individual), landmarks in objects.items():
        values = np.full((q, 3), np.nan)
        for mark, value in landmarks.items():
            values[places[mark]] = value
        index = builder.frame(0 if name in ("", None) else name)
        builder.add(index, values, as_identity(individual.strip()))


def _coordinate_columns(
    head: list[str], rows: Iterator[list[str]], builder: DetectionsBuilder
) -> None:
    """Read a table with a row for each object and a column for each coordinate: nose_x, ..."""
    columns: list[Column] = []
    frame = person = time = None
    for i, cell in enumerate(head):
        name = cell.lower().replace(" ", "_")
        if name in _FRAME and frame is None:
            frame = i
        elif name in _OBJECT and person is None:
            person = i
        elif name in TIMES and time is None:
            time = i
        after = re.fullmatch(r"(.+)[_. -]([A-Za-z]+)", cell)
        before = re.fullmatch(r"([xyzvcs])_?(\d+)", name)
        prefix = re.fullmatch(r"([A-Za-z]+)[_. -](.+)", cell)
        if after and after[2].lower() in _COORDINATES:
            columns.append(("", after[1], after[2].lower()))
        elif before:
            columns.append(("", before[2], before[1]))
        elif prefix and prefix[1].lower() in _COORDINATES:
            columns.append(("", prefix[2], prefix[1].lower()))
        else:
            columns.append(("", "", ""))
    places: dict[str, dict[str, int]] = {}
    for i, (_, part, coordinate) in enumerate(columns):
        if coordinate:
            places.setdefault(part, {})[coordinate] = i
    complete = {part: at for part, at in places.items() if "x" in at and "y" in at}
    if not complete:
        shown = ", ".join(head[:6])
        raise KeypointFileError(f"it is {_EXPECTED}; its columns are {shown}")
    _find_incomplete(places, builder)
    if not all(part.isdecimal() for part in complete):
        builder.name_keypoints(list(complete))
    builder.is_mediapipe = True
    xy = np.array([(at["x"], at["y"]) for at in complete.values()])
    marks = _confidence_columns(complete)
    for number, row in enumerate(rows):
        if not any(cell.strip() for cell in row):
            continue
        values = _numbers(row, len(head))
        key: Any = None if frame is None else _key([row[frame]])
        if key is None and time is not None:
            key = float(values[time])
        index = _frame(builder, key, number)
        if time is not None and not np.isnan(values[time]):
            builder.time(index, float(values[time]), TIMES[head[time].lower().replace(" ", "_")])
        confidence = np.where(marks < 0, 1.0, values[marks])
        identity = None if person is None else as_identity(row[person].strip())
        builder.add(index, np.column_stack([values[xy], confidence]), identity)


def read_trc(path: Path, builder: DetectionsBuilder) -> None:
    """Read a TRC of Sports2D: 2D coordinates in pixels, or in metres with y up."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    if len(lines) < 5 or not lines[3].lower().startswith("frame"):
        raise KeypointFileError("no TRC: its fourth line must begin with Frame#")
    fields = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    names = [name.strip() for name in lines[3].split("\t")[2:] if name.strip()]
    if not names:
        raise KeypointFileError("it names no marker")
    rows = [line.split("\t") for line in lines[5:] if line.strip()]
    width = 2 + 3 * len(names)
    table = np.stack([_numbers(row, width) for row in rows] or [np.full(width, np.nan)])
    xyz = table[:, 2:].reshape(-1, len(names), 3)
    if (np.nanmax(xyz[..., 2], 0, initial=-np.inf) - np.nanmin(xyz[..., 2], 0, initial=np.inf)).max(
        initial=0
    ) > 1e-6:
        raise KeypointFileError(
            "its markers are 3D (Z changes): lift needs the 2D keypoints that they come from"
        )
    units = fields.get("Units", "").strip().lower()
    # Sports2D writes "m" into files of pixels, too, and says the unit in their names.
    largest = float(np.nanmax(np.abs(xyz[..., :2]), initial=0))
    is_metres = not (units.startswith("p") or "_px" in path.name.lower() or largest > _METRES)
    if is_metres:
        xyz[..., 1] *= -1
        builder.warnings.append(
            f"its coordinates are taken for metres with y up (largest: {largest:g}): shapes are as "
            "of pixels, but the place before a camera is not; the _px file of Sports2D has pixels"
        )
    builder.name_keypoints(names)
    for row, points in zip(table, xyz[..., :2], strict=True):
        if np.isnan(row[0]):
            builder.leave_out("are rows without a number of the frame", f"time {row[1]:g}")
            continue
        stamp = None if np.isnan(row[1]) else round(row[1] * 1e9)
        index = builder.frame(int(row[0]), number=int(row[0]), stamp=stamp)
        if not np.isnan(points).all():
            builder.add(index, np.column_stack([points, np.ones(len(points))]))
