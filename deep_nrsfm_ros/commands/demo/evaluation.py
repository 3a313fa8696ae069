# SPDX-License-Identifier: Apache-2.0
"""Compare the points in a recorded bag with the ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from deep_nrsfm_ros.commands.demo.client import NO_LATENCY, Played
from deep_nrsfm_ros.data.pose2sim import Session
from deep_nrsfm_ros.nrsfm.metrics import camera_errors

Floats = NDArray[Any]

_COLUMNS = {
    "frames": ".0f",
    "lifted": ".0f",
    "Hz": ".1f",
    "p50 ms": ".2f",
    "p99 ms": ".2f",
    "reprojection": ".3f",
    "PA mm": ".1f",
    "camera mm": ".1f",
    "rotation deg": ".1f",
    "mirrored %": ".0f",
}


def read_points(bag: Path, topic: str = "/lifter/points") -> dict[int, Floats]:
    """Return the points (p, 3) of the first object of each message, by stamp in ns."""
    store = get_typestore(Stores.ROS2_JAZZY)
    points: dict[int, Floats] = {}
    with Reader(bag) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, _, raw in reader.messages(connections):
            message: Any = store.deserialize_cdr(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            values = message.data.view("<f4").reshape(message.height, message.width, -1)
            points[stamp] = values[0, :, :3]
    return points


def table(
    session: Session, played: Sequence[Played], points: Mapping[int, Floats], limbs: Sequence[int]
) -> str:
    """Return a table of rate, latency and errors for each camera, and their means, as text.

    Args:
        session: ground truth of each camera.
        played: how the lifter responded to each camera.
        points: lifted points (p, 3) by stamp.
        limbs: indices of the ground truth's joints in the lifted points.
    """
    rows = []
    for view, run in zip(session.views, played, strict=True):
        frames = [i for i, stamp in enumerate(run.stamps) if stamp in points]
        shapes = np.stack([points[run.stamps[i]][limbs] for i in frames])
        error = camera_errors(shapes, view.truth[frames])
        rows.append(
            [
                len(run.stamps),
                len(frames),
                run.rate,
                run.latency(50),
                run.latency(99),
                run.error,
                error.aligned,
                error.in_camera,
                error.rotation,
                100 * error.mirrored,
            ]
        )
    names = [*(view.camera.name for view in session.views), "mean"]
    lines = [["camera", *_COLUMNS]]
    for name, row in zip(names, [*rows, np.mean(rows, 0)], strict=True):
        formats = zip(_COLUMNS.values(), row, strict=True)
        cells = ("-" if np.isnan(value) else f"{value:{form}}" for form, value in formats)
        lines.append([name, *cells])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = [
        "  ".join(word.rjust(width) for word, width in zip(line, widths, strict=True))
        for line in lines
    ]
    if any(np.isnan(run.latency(50)) for run in played):
        text.append(f"-: {NO_LATENCY}")
    return "\n".join(text)
