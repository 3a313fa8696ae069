# SPDX-License-Identifier: Apache-2.0
"""Tables with a row for each object and a column for each coordinate: nose_x, nose_y, ..."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice

import numpy as np

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder, KeypointFileError, as_identity
from deep_nrsfm_ros.data.formats.cells import Numbers
from deep_nrsfm_ros.data.formats.column_findings import find_roles, find_units, say_unused
from deep_nrsfm_ros.data.formats.columns import Columns, Part, find_columns, find_parts, words
from deep_nrsfm_ros.data.formats.depth_check import three_d
from deep_nrsfm_ros.data.formats.individuals import (
    EXPECTED,
    depth_checks,
    find_individuals,
    finish_checks,
    used_columns,
    values_of,
)
from deep_nrsfm_ros.data.formats.landmark_rows import identity_of
from deep_nrsfm_ros.data.formats.table_frames import RowFrames
from deep_nrsfm_ros.data.formats.table_text import Row, is_number

_SAMPLE = 500  # rows that tell what a column holds
_LONGEST = 40  # characters of a cell that a message shows
_OF_3D = {"error", "ncams"}  # columns of a keypoint that Anipose triangulates
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg")


def read_coordinate_columns(
    head: Sequence[str], rows: Iterator[Row], builder: DetectionsBuilder
) -> None:
    """Read a table with a row for each object and a column for each coordinate: nose_x, ..."""
    parts = _of_one_camera(find_parts(head))
    sample = list(islice(rows, _SAMPLE))
    if not any(part.is_complete for part in parts):
        shown = ", ".join(head[:6])
        cells = [cell.strip() for _, row in sample[:1] for cell in row]
        if lists := [cell for cell in cells if cell[:1] in ("(", "[", "{")]:
            raise KeypointFileError(
                f"its cells hold several numbers, such as {lists[-1][:_LONGEST]!r}: write a column "
                "for each coordinate (nose_x, nose_y, ...), or JSON"
            )
        if sum(is_number(cell) for cell in head) > len(head) / 2:
            raise KeypointFileError(
                f"its first line has no names of columns but numbers ({shown}): write a line such "
                "as frame,nose_x,nose_y,nose_confidence above it, or save an .npy (objects, q, 3)"
            )
        raise KeypointFileError(f"it is {EXPECTED}; its columns are {shown}")
    taken = {i for part in parts if {"x", "y"} & set(part.at) for i in part.at.values()}
    columns = _without_videos(head, taken, sample)
    columns = _without_row_numbers(head, columns, sample)
    _refuse_3d(head, parts)
    individuals = find_individuals(parts, builder, may_be_one=True)
    find_units(head, individuals, builder)
    builder.is_mediapipe = True
    used, numbers = used_columns(individuals), Numbers()
    checks = depth_checks(individuals)
    time = head[columns.time[0]] if columns.time else ""
    frames = RowFrames(builder, time, columns.unit)
    tracks = {each.name: _column_of(head, each.name, "track") for each in individuals}
    scores = {each.name: _column_of(head, each.name, "score") for each in individuals}
    if len(individuals) == 1 and scores[individuals[0].name] is None:
        scores[individuals[0].name] = columns.score
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
        values = values_of(row, used, len(head), numbers, line)
        for individual, check in zip(individuals, checks, strict=True):
            own = individual.values(values)
            if len(individuals) > 1 and np.isnan(own[:, :2]).all():
                continue
            if check and individual.depth is not None:
                check.add(np.column_stack([own[:, :2], values[individual.depth]]))
            track, place = tracks[individual.name], scores[individual.name]
            if len(individuals) > 1 or track is not None:
                identity = as_identity(individual.name if track is None else row[track].strip())
            else:
                identity = identity_of([row[i] for i in columns.identities])
            score = float(row[place]) if place is not None and is_number(row[place]) else None
            score = None if score is None or np.isnan(score) else score
            builder.add(index, own, identity, score, individual.kind)
    finish_checks(checks)
    numbers.say(builder)
    frames.finish()
    own_columns = {i for i in (*tracks.values(), *scores.values()) if i is not None}
    unused = tuple(i for i in columns.unused if i not in own_columns)
    say_unused(head, columns, individuals, builder, unused)
    find_roles(head, columns, [row for _, row in sample if row], builder)


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
