# SPDX-License-Identifier: Apache-2.0
"""Place and size of people by measured depth, against an assumed body height.

Motion capture that `human` was not trained on, before simulated cameras 1.4 m high, with a
detector's noise. The depth is rendered from the truth: capsules around the bones, whose thickness
is drawn for each person and is not that of the lifter, a wall, the noise and the holes of a depth
camera, and an occluder. Smaller people are the same motions at 70 % of their size. On the
pose2sim clip, place and size by the floor.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.data.people_scenes import Track, filmed, held_out_motions, noisy
from benchmarks.real.floor import ASSUMED, SIZES, errors
from benchmarks.real.people import SYSTEMS, lift_track
from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.body.depth import (
    AGREEMENT,
    MIN_KEYPOINTS,
    DepthFit,
    DepthScale,
    surface_radii,
)
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter
from deep_nrsfm_ros.messages.depth_messages import window, window_depth
from deep_nrsfm_ros.model_files.model_file import load_model

Floats = NDArray[Any]
Masks = NDArray[np.bool_]

WALL = 2.0  # m behind the person's middle
NOISE = 0.00285  # m / m^2: standard deviation of a depth over the square of the depth
HOLES, WINDOW_HOLES = 0.1, 0.05  # share of pixels and of keypoints without a depth
FLESH = (0.7, 1.4)  # thickness of a person's capsules, relative to `BONES`
BONES = (
    *((f"{side}_shoulder", f"{side}_elbow", 0.045) for side in ("left", "right")),
    *((f"{side}_elbow", f"{side}_wrist", 0.035) for side in ("left", "right")),
    *((f"{side}_hip", f"{side}_knee", 0.075) for side in ("left", "right")),
    *((f"{side}_knee", f"{side}_ankle", 0.05) for side in ("left", "right")),
    *((f"{side}_shoulder", f"{side}_hip", 0.1) for side in ("left", "right")),
    ("left_shoulder", "right_shoulder", 0.07),
    ("left_hip", "right_hip", 0.1),
    ("neck", "mid_hip", 0.11),
    ("neck", "head", 0.09),
)
"""Ends and radius in metres of the capsules of an adult."""


@dataclass(frozen=True)
class Case:
    """How the depth is measured.

    Attributes:
        hidden: share of the person's height that a board hides from below, 0 = no board.
        delay: frames by which the depth is behind the keypoints.
        shift: pixels by which the depth image is beside the image.
        factor: measured over true depth.
        dropout: share of the frames without any depth, in bursts of 1 s.
    """

    hidden: float = 0.0
    delay: int = 0
    shift: float = 0.0
    factor: float = 1.0
    dropout: float = 0.0


CASES = {
    "depth": Case(),
    "depth in half of the time": Case(dropout=0.5),
    "depth, legs hidden by a board": Case(hidden=0.45),
    "depth, all but head and shoulders hidden": Case(hidden=0.8),
    "depth, 0.1 s late": Case(delay=3),
    "depth, not registered: 20 pixels beside": Case(shift=20.0),
    "depth, 5 % too far": Case(factor=1.05),
}
FIGURES = {
    "place mm": "distance of the centroids in the camera's frame, median",
    "place %": "of the distance to the camera, median",
    "size %": "error of the person's size, median",
    "points mm": "mean distance of the 12 limb joints in the camera's frame, median",
    "agree": "mean number of keypoints that agree, of 17",
    "found %": "share of the keypoints behind the board that are called occluded",
    "false %": "share of the other keypoints that are called occluded",
}


class Scene:
    """A person's capsules, a wall and a board before a camera."""

    def __init__(self, truth: Floats, size: float, case: Case, rng: np.random.Generator) -> None:
        """Build the scene.

        Args:
            truth: (f, 12, 3) `JOINTS` in m in the camera's axes.
            size: of the person, 1 = adult.
            case: how the depth is measured.
            rng: draws the thickness.
        """
        points = dict(zip(JOINTS, truth.swapaxes(0, 1), strict=True))
        for middle, part in (("neck", "shoulder"), ("mid_hip", "hip")):
            points[middle] = (points[f"left_{part}"] + points[f"right_{part}"]) / 2
        points["head"] = points["neck"] + 0.35 * (points["neck"] - points["mid_hip"])
        flesh = size * rng.uniform(*FLESH)
        self._starts = np.stack([points[a] for a, _, _ in BONES], 1)
        self._ends = np.stack([points[b] for _, b, _ in BONES], 1)
        self._radii = flesh * np.array([radius for _, _, radius in BONES])
        self._wall = truth[..., 2].mean() + WALL
        top, bottom = truth[..., 1].min(1), truth[..., 1].max(1)
        # The board hangs 0.7 m before the nearest point, wide enough to hide the person.
        self._board = truth[..., 2].min(1) - 0.7
        self._edge = (bottom - case.hidden * (bottom - top)) / truth[..., 2].mean(1)
        self._hides = case.hidden > 0

    def depth(self, rays: Floats) -> Floats:
        """Return the depth (f, k) of the first surface on rays (f, k, 2) of the plane z = 1."""
        depth = np.full(rays.shape[:2], self._wall)
        d = np.concatenate([rays, np.ones_like(rays[..., :1])], -1)
        for bone, radius in enumerate(self._radii.tolist()):
            start, end = self._starts[:, None, bone], self._ends[:, None, bone]
            depth = np.fmin(depth, capsule_depth(d, start, end, radius))
        if self._hides:
            depth = np.where(self.behind_board(rays), self._board[:, None], depth)
        return depth

    def behind_board(self, rays: Floats) -> Masks:
        """Return which rays (f, k, 2) meet the board."""
        hidden: Masks = (rays[..., 1] > self._edge[:, None]) & self._hides
        return hidden


def capsule_depth(d: Floats, start: Floats, end: Floats, radius: float) -> Floats:
    """Return the depth (f, k) at which rays from the origin enter a capsule; NaN: they miss it.

    Args:
        d: (f, k, 3) directions with z = 1.
        start: (f, 1, 3) one end of the axis.
        end: (f, 1, 3) the other end.
        radius: of the capsule.
    """
    axis = end - start
    length = np.square(axis).sum(-1)
    along, at = (d * axis).sum(-1) / length, (start * axis).sum(-1) / length
    # The ray's and the start's components across the axis: |t u - w| = radius.
    u, w = d - along[..., None] * axis, start - at[..., None] * axis
    with np.errstate(invalid="ignore", divide="ignore"):
        t = _first_root((u * u).sum(-1), (u * w).sum(-1), (w * w).sum(-1) - radius**2)
        on_axis = t * along - at
        depth = np.where((on_axis >= 0) & (on_axis <= 1), t, np.nan)
        for centre in (start, end):
            s = _first_root(
                *((d * d).sum(-1), (d * centre).sum(-1), (centre**2).sum(-1) - radius**2)
            )
            depth = np.fmin(depth, s)
    return depth


def _first_root(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the smaller t of a t^2 - 2 b t + c = 0, NaN if there is none above 0."""
    root = (b - np.sqrt(b * b - a * c)) / a
    first: Floats = np.where(root > 0, root, np.nan)
    return first


def measured_depth(
    scene: Scene, intrinsics: Intrinsics, pixels: Floats, case: Case, rng: np.random.Generator
) -> Floats:
    """Return the depth (f, p) that a depth camera measures in windows around pixels (f, p, 2)."""
    f, p = pixels.shape[:2]
    at = window(np.nan_to_num(pixels) + [case.shift, 0])
    rays = intrinsics.rays(at.reshape(f, -1, 2).astype(float))
    depth = case.factor * scene.depth(rays)
    depth += NOISE / 2 * depth**2 * rng.standard_normal(depth.shape)
    depth = depth.reshape(f, p, -1)
    # Half of the variance is common to the pixels of a window, as of a matched patch.
    depth += NOISE / 2 * depth**2 * rng.standard_normal((f, p, 1))
    depth[rng.random(depth.shape) < HOLES] = np.nan
    depth[rng.random((f, p)) < WINDOW_HOLES] = np.nan
    found = window_depth(depth)
    found = np.concatenate([np.full((case.delay, p), np.nan), found[: f - case.delay]])
    second = np.arange(f) // 30
    silent = rng.random(second[-1] + 1 if f else 0) < case.dropout
    found[silent[second]] = np.nan
    return np.where(np.isfinite(pixels).all(-1), found, np.nan)


def by_depth(
    lifter: Lifter, track: Track, lifted: Lifted, measured: Floats
) -> tuple[Floats, DepthFit]:
    """Return the shapes (f, p, 3) with measured depth, frame after frame, and the fits."""
    length = lifter.options.length_for(lifter.model.layout)
    scale = DepthScale(surface_radii(lifter.model.layout, length), AGREEMENT, MIN_KEYPOINTS)
    scales, fits = [], []
    for i, second in enumerate(track.seconds.tolist()):
        row = slice(i, i + 1)
        found, fit = scale(
            ("person",), lifted.shapes[row], lifted.confidence[row], measured[row], second
        )
        scales.append(found)
        fits.append(fit)
    factors = np.concatenate(scales)
    shapes = np.where(np.isnan(factors), 1, factors)[:, None, None] * lifted.shapes
    return shapes, DepthFit(*map(np.concatenate, zip(*fits, strict=True)))


def pixels_of(lifted: Lifted, intrinsics: Intrinsics) -> Floats:
    """Return the pixels (f, p, 2) of lifted points."""
    with np.errstate(invalid="ignore"):
        return intrinsics.pixels(lifted.shapes[..., :2] / lifted.shapes[..., 2:])


def points_error(track: Track, shapes: Floats) -> Floats:
    """Return the mean distance (f,) in mm of the limbs (f, 12, 3) in m from the truth."""
    known = np.isfinite(shapes).all((1, 2))
    error: Floats = np.linalg.norm(1000 * shapes[known] - track.truth[known], axis=-1).mean(1)
    return error


def benchmark(lifter: Lifter, data: Path, stride: int, cases: dict[str, Case]) -> Table:
    """Return the table of errors by size of the people and by case."""
    table = Table(
        *("depth", "Place and size of people by measured depth", ("people", "metres from")),
        *(tuple(FIGURES), FIGURES, bars("place mm", "points mm")),
    )
    limbs = [lifter.model.layout.index(joint) for joint in JOINTS]
    motions = list(held_out_motions(data / "cmu"))[::stride]
    for people, size in SIZES.items():
        found: dict[str, list[Any]] = {}
        for seed, motion in enumerate(motions):
            track = noisy(filmed(size * motion, 120.0 * (seed % 3), seed), seed)
            lifted = lift_track(lifter, track, SYSTEMS["in time"], intrinsics=True)
            shapes = lifted.shapes[:, limbs]
            none = np.full(len(shapes), np.nan)
            plain = (*errors(track, shapes), points_error(track, shapes), none, none, none)
            found.setdefault(ASSUMED, []).append(plain)
            pixels = pixels_of(lifted, track.intrinsics)
            for name, case in cases.items():
                rng = np.random.default_rng(seed)
                scene = Scene(track.truth / 1000, size, case, rng)
                measured = measured_depth(scene, track.intrinsics, pixels, case, rng)
                shapes, fit = by_depth(lifter, track, lifted, measured)
                shapes = shapes[:, limbs]
                rays = track.truth[..., :2] / track.truth[..., 2:]
                behind = scene.behind_board(rays)
                occluded = fit.occluded[:, limbs].astype(float)
                known = np.isfinite(measured[:, limbs])
                row = (
                    *errors(track, shapes),
                    points_error(track, shapes),
                    fit.agree.sum(1),
                    occluded[behind & known],
                    occluded[~behind & known],
                )
                found.setdefault(name, []).append(row)
        for name, parts in found.items():
            columns = [np.concatenate(p) for p in zip(*parts, strict=True)]
            figures = [float(np.median(column)) for column in columns[:4]]
            figures += [float(columns[4].mean())]
            figures += [
                100 * float(column.mean()) if len(column) else np.nan for column in columns[5:]
            ]
            table.add(
                (people, name),
                {k: v for k, v in zip(FIGURES, figures, strict=True) if np.isfinite(v)},
            )
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
        lambda: [benchmark(Lifter(load_model(args.model)), args.data, args.stride, CASES)],
        args.output,
    )


if __name__ == "__main__":
    main()
