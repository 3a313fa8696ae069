# SPDX-License-Identifier: Apache-2.0
"""Place and size of people by the camera's height above the floor, against an assumed body height.

Motion capture that `human` was not trained on, before simulated cameras 1.4 m high with a
detector's noise; smaller people are the same motions at 70 % of their size.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.data.people_scenes import HEIGHT, Track, filmed, held_out_motions, noisy
from benchmarks.real.people import SYSTEMS, lift_track
from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.body.floor import FloorScale
from deep_nrsfm_ros.data.pose2sim import JOINTS
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
    known = np.isfinite(shapes).all((1, 2))
    S, T = 1000 * shapes[known].astype(float), track.truth[known]
    apart = np.linalg.norm(S.mean(1) - T.mean(1), axis=1)
    spread = [np.sqrt(np.square(X - X.mean(1, keepdims=True)).sum((1, 2))) for X in (S, T)]
    distance = np.linalg.norm(T.mean(1), axis=1)
    return apart, 100 * apart / distance, 100 * np.abs(spread[0] / spread[1] - 1)


def benchmark(lifter: Lifter, data: Path, stride: int) -> Table:
    """Return the table of errors by size of the people and by method."""
    table = Table(
        *("floor", "Place and size of people by the floor", ("people", "metres from")),
        *(tuple(FIGURES), FIGURES, bars("place mm")),
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
                floor = FloorScale(HEIGHT + abs(wrong))
                scales = [
                    floor(("person",), shapes[i : i + 1], track.up, second)
                    for i, second in enumerate(track.seconds.tolist())
                ]
                scaled = np.concatenate(scales)[:, None, None] * shapes
                found.setdefault(name, []).append(errors(track, scaled[:, limbs]))
        for name, parts in found.items():
            medians = [float(np.median(np.concatenate(p))) for p in zip(*parts, strict=True)]
            table.add((people, name), dict(zip(FIGURES, medians, strict=True)))
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", nargs="?", default="human", help="name or file of a model")
    parser.add_argument("--data", type=Path, required=True, help="folder with cmu/")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument("--stride", type=int, default=1, help="use every n-th trial")
    args = parser.parse_args(argv)
    print_tables(
        lambda: [benchmark(Lifter(load_model(args.model)), args.data, args.stride)], args.output
    )


if __name__ == "__main__":
    main()
