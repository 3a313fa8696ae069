# SPDX-License-Identifier: Apache-2.0
"""Tables with a row for each landmark of an object."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder, KeypointFileError, as_identity
from deep_nrsfm_ros.data.formats.cells import Numbers, is_missing
from deep_nrsfm_ros.data.formats.column_findings import say_unused
from deep_nrsfm_ros.data.formats.columns import Columns, words
from deep_nrsfm_ros.data.formats.depth_check import DepthCheck, is_visibility
from deep_nrsfm_ros.data.formats.table_frames import RowFrames
from deep_nrsfm_ros.data.formats.table_text import Row, is_number
from deep_nrsfm_ros.lifting.sanity import Finding

_FEW = 0.01  # fraction of rows that are left out, up to which they are no cause for doubt


def read_landmark_rows(
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
    say_unused(head, columns, [], builder)
    if all(mark.isdecimal() and len(mark) < 5 for mark in order):
        q = max(int(mark) for mark in order) + 1
        at = {mark: int(mark) for mark in order}
    else:
        q = len(order)
        at = {mark: i for i, mark in enumerate(order)}
        builder.name_keypoints(list(order))
    builder.is_mediapipe = True
    name = "" if columns.confidence is None else head[columns.confidence]
    check = DepthCheck(
        list(order), has_confidence=bool(name), has_visibility=is_visibility(words(name))
    )
    for (index, who), landmarks in objects.items():
        values = np.full((q, 4), np.nan)
        for mark, value in landmarks.items():
            values[at[mark]] = value
        if columns.z is not None:
            check.add(values[:, [0, 1, 3]])
        if np.isnan(values[:, 2]).all() and not np.isnan(values[:, :2]).all():
            values[:, 2] = 1.0  # labelled by hand
        builder.add(index, values[:, :3], identity_of(who), scores.get((index, who)))
    check.finish()


def identity_of(cells: Sequence[str]) -> str | None:
    """Return the identity that cells say, the surest one first; None for none."""
    return next((as_identity(cell.strip()) for cell in cells if not is_missing(cell)), None)
