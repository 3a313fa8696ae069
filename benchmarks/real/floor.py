# SPDX-License-Identifier: Apache-2.0
"""Place and size of people by the camera's height above the floor, against an assumed body height.

Motion capture that `human` was not trained on, before simulated cameras 1.4 m high with a
detector's noise; smaller people are the same motions at 70 % of their size. A real person in the
pose2sim clip, before four calibrated cameras.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.data.people_scenes import (
    HEIGHT,
    Track,
    filmed,
    held_out_motions,
    noisy,
    view_track,
)
from benchmarks.data.pose2sim_scenes import CACHE, UP
from benchmarks.harness import model_parser
from benchmarks.real.people import SYSTEMS, lift_track
from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.body.floor import FloorScale
from deep_nrsfm_ros.data.pose2sim import JOINTS, fetch_wheel, read_session
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.model_files.model_file import load_model

Floats = NDArray[Any]

SIZES = {"adults": 1.0, "children": 0.7}
ASSUMED = "0.5 m from neck to mid-hip"
ROWS = {"floor": 0.0, "floor, height 0.1 m too large": 0.1, "floor, a step of 0.2 m": -0.2}
"""Name of a row -> error of the camera's height in metres; on a step people are 0.2 m nearer."""
FIGURES = {
    "place mm": "distance of the centroids in the camera's frame, median",
    "place %": "of the distance to the camera, median",
    "size %": "error of the person's size, median",
}


def errors(track: Track, shapes: Floats) -> tuple[Floats, Floats, Floats]:
    """Return errors of place in mm, and of place and size in %, of the limbs (f, 12, 3) in m."""
    known = np.isfinite(shapes).all((1, 2)) & np.isfinite(track.truth).all((1, 2))
    S, T = 1000 * shapes[known].astype(float), track.truth[known]
    apart = np.linalg.norm(S.mean(1) - T.mean(1), axis=1)
    spread = [np.sqrt(np.square(X - X.mean(1, keepdims=True)).sum((1, 2))) for X in (S, T)]
    distance = np.linalg.norm(T.mean(1), axis=1)
    return apart, 100 * apart / distance, 100 * np.abs(spread[0] / spread[1] - 1)


def benchmark(lifter: Lifter, data: Path, stride: int) -> Table:
    """Return the table of errors by size of the people and by method."""
    table = Table(
        "floor",
        "Place and size of people by the floor",
        ("people", "metres from"),
        tuple(FIGURES),
        FIGURES,
        bars("place mm"),
    )
    limbs = [lifter.model.layout.index(joint) for joint in JOINTS]
    motions = list(held_out_motions(data / "cmu"))[::stride]
    for people, size in SIZES.items():
        found: dict[str, list[Any]] = {}
        for seed, motion in enumerate(motions):
            track = noisy(filmed(size * motion, 120.0 * (seed % 3), seed), seed)
            shapes = lift_track(lifter, track, SYSTEMS["in time"], intrinsics=True).shapes
            found.setdefault(ASSUMED, []).append(errors(track, shapes[:, limbs]))
            for name, wrong in ROWS.items():
                # A step of 0.2 m: the camera is taken to be 0.2 m too high above the feet.
                scaled = on_floor(track, shapes, HEIGHT + abs(wrong))
                found.setdefault(name, []).append(errors(track, scaled[:, limbs]))
        for name, parts in found.items():
            table.add((people, name), medians(parts))
    return table


def on_floor(track: Track, shapes: Floats, height: float) -> Floats:
    """Return shapes (f, p, 3) at the size with which they stand on the floor, frame after frame.

    Args:
        track: has their times and the direction of gravity.
        shapes: at their positions before the camera.
        height: of the camera in metres.
    """
    floor = FloorScale(height)
    scales = [
        floor(("person",), shapes[i : i + 1], track.up, second)
        for i, second in enumerate(track.seconds.tolist())
    ]
    scaled: Floats = np.concatenate(scales)[:, None, None] * shapes
    return scaled


def medians(parts: Sequence[tuple[Floats, ...]]) -> dict[str, float]:
    """Return the `FIGURES` of the errors of several tracks."""
    columns = (float(np.median(np.concatenate(part))) for part in zip(*parts, strict=True))
    return dict(zip(FIGURES, columns, strict=True))


def clip_table(lifter: Lifter) -> Table:
    """Return the table of errors on the pose2sim clip, whose calibration has cameras' heights.

    Raises:
        OSError: the clip is not there and cannot be fetched.
    """
    table = Table(
        "floor_clip",
        "Place and size of the person of the pose2sim clip",
        ("camera", "metres"),
        (*FIGURES, "height m"),
        FIGURES | {"height m": "of the camera"},
        bars("place mm"),
    )
    limbs = [lifter.model.layout.index(joint) for joint in JOINTS]
    found: dict[str, list[Any]] = {}
    for view in read_session(fetch_wheel(CACHE)).views:
        track, camera = view_track(view), view.camera
        shapes = lift_track(lifter, track, SYSTEMS["in time"], intrinsics=True).shapes
        height = float(UP @ -(camera.rotation.T @ camera.translation)) / 1000
        scaled = on_floor(track, shapes, height)
        for name, S in ((ASSUMED, shapes), ("floor", scaled)):
            row = errors(track, S[:, limbs])
            table.add((camera.name, name), medians([row]) | {"height m": height})
            found.setdefault(name, []).append(row)
    for name, parts in found.items():
        table.add(("all", name), medians(parts))
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    args = model_parser(__doc__, "cmu/").parse_args(argv)

    def tables() -> list[Table]:
        lifter = Lifter(load_model(args.model))
        simulated = benchmark(lifter, args.data, args.stride)
        try:
            return [simulated, clip_table(lifter)]
        except OSError as error:
            print(f"no rows of the pose2sim clip: {error}", file=sys.stderr)
            return [simulated]

    print_tables(tables, args.output)


if __name__ == "__main__":
    main()
