# SPDX-License-Identifier: Apache-2.0
"""Markers in a TRC of Sports2D."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder, KeypointFileError
from deep_nrsfm_ros.data.formats.cells import Numbers

_METRES = 50.0  # a larger coordinate of a TRC is in pixels: no one is filmed on 50 m


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
    numbers = Numbers()
    table = np.full((max(len(rows), 1), width), np.nan)
    for i, cells in enumerate(line[:width] for line in rows):
        table[i, : len(cells)] = numbers.row(cells, i + 6)
    numbers.say(builder)
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
