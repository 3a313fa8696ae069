# SPDX-License-Identifier: Apache-2.0
"""Place and size of people by measured depth, against an assumed body height.

Motion capture that `human` was not trained on, before simulated cameras 1.4 m high, with a
detector's noise. The depth is rendered from the truth: capsules around the bones, whose thickness
is drawn for each person and is not that of the lifter, a wall, the noise and the holes of a depth
camera, and a board as an occluder. Smaller people are the same motions at 70 % of their size.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.data.people_scenes import Track, filmed, held_out_motions, noisy
from benchmarks.harness import model_parser
from benchmarks.real.floor import ASSUMED, SIZES, errors
from benchmarks.real.people import SYSTEMS, lift_track
from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.body.depth import (
    AGREEMENT,
    MIN_CONFIDENCE,
    Agreement,
    DepthFit,
    DepthScale,
    RangeScale,
    believed_scales,
    surface_radii,
)
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter
from deep_nrsfm_ros.messages.depth_messages import DepthPoints, window, window_depth
from deep_nrsfm_ros.model_files.model_file import load_model

Floats = NDArray[Any]
Masks = NDArray[np.bool_]

WALL = 2.0  # m behind the person's middle
NOISE = 0.0014  # m / m^2: standard deviation of a depth over the square of the depth
LIDAR_NOISE = 0.02  # m
HOLES, WINDOW_HOLES = 0.1, 0.05  # share of pixels and of keypoints without a depth
FLESH = (0.7, 1.4)  # thickness of a person's capsules, relative to `BONES`
MEAN_RADIUS = 0.07  # m, of the next line's
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
        sensor: "image", "cloud" (a lidar of `LINES`) or "range" (one distance on the axis).
        hidden: share of the person's height that a board hides from below, 0 = no board.
        since: seconds from which on the board is there.
        delay: frames by which the depth is behind the keypoints.
        shift: pixels by which the depth image is beside the image.
        factor: measured over true depth.
        dropout: share of the frames without any depth, in bursts of 1 s.
    """

    sensor: str = "image"
    hidden: float = 0.0
    since: float = 0.0
    delay: int = 0
    shift: float = 0.0
    factor: float = 1.0
    dropout: float = 0.0


CASES = {
    "depth": Case(),
    "lidar of 16 lines": Case("cloud"),
    "range": Case("range"),
    "depth in half of the seconds": Case(dropout=0.5),
    "depth, legs behind a board": Case(hidden=0.45),
    "depth, all but head and shoulders behind it": Case(hidden=0.8),
    "the same after 1 s of full view": Case(hidden=0.8, since=1.0),
    "depth, 0.1 s late": Case(delay=3),
    "depth, not registered: 40 pixels beside": Case(shift=40.0),
    "depth, 5 % too far": Case(factor=1.05),
}
BOARD = CASES["depth, legs behind a board"]
MEDIAN, SURFACE = "depth, legs behind it, plain median", "depth, joints on the surface"
"""Rows that show what two parts of the method are worth."""
LINES, COLUMNS = 2.0, 0.4  # degrees between the lines of the lidar, and along one
MARGIN = 50  # pixels around the person within which points of the lidar are computed
BEAM = 0.05  # rad, half of the range finder's
FIGURES = {
    "place mm": "distance of the centroids in the camera's frame, median",
    "place %": "of the distance to the camera, median",
    "size %": "error of the person's size, median",
    "points mm": "mean distance of the 12 limb joints in the camera's frame, median",
    "agree": "mean number of keypoints that agree",
    "found %": "share of the limb joints with something nearer than the person's skin, the board "
    "or the person, that are called occluded",
    "false %": "share of the other limb joints that are called occluded",
}


class Scene:
    """A person's capsules, a wall and a board before a camera."""

    def __init__(self, track: Track, size: float, case: Case, rng: np.random.Generator) -> None:
        """Build the scene.

        Args:
            track: has the truth.
            size: of the person, 1 = adult.
            case: how the depth is measured.
            rng: draws the thickness.
        """
        truth = track.truth / 1000
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
        self._hides = (track.seconds >= case.since)[:, None] & (case.hidden > 0)

    def depth(self, rays: Floats, frames: slice = slice(None)) -> Floats:
        """Return the depth (f, k) of the first surface on rays (f, k, 2) of the plane z = 1.

        Args:
            rays: of each frame.
            frames: the f frames; all if it is left out.
        """
        depth = np.full(rays.shape[:2], self._wall)
        d = np.concatenate([rays, np.ones_like(rays[..., :1])], -1)
        starts, ends = self._starts[frames, None], self._ends[frames, None]
        for bone, radius in enumerate(self._radii.tolist()):
            surface = capsule_depth(d, starts[:, :, bone], ends[:, :, bone], radius)
            depth = np.fmin(depth, surface)
        hidden = (rays[..., 1] > self._edge[frames, None]) & self._hides[frames]
        return np.where(hidden, self._board[frames, None], depth)


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
            s = _first_root((d * d).sum(-1), (d * centre).sum(-1), (centre**2).sum(-1) - radius**2)
            depth = np.fmin(depth, s)
    return depth


def _first_root(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the smaller t of a t^2 - 2 b t + c = 0, NaN if there is none above 0."""
    root = (b - np.sqrt(b * b - a * c)) / a
    first: Floats = np.where(root > 0, root, np.nan)
    return first


def noisy_depth(depth: Floats, rng: np.random.Generator) -> Floats:
    """Return depths (f, p, w) of windows with the noise and the holes of a depth camera."""
    # Half of the variance is common to the pixels of a window, as of a matched patch.
    own, common = rng.standard_normal(depth.shape), rng.standard_normal((*depth.shape[:2], 1))
    measured: Floats = depth + NOISE * depth**2 * np.sqrt(0.5) * (own + common)
    measured[rng.random(depth.shape) < HOLES] = np.nan
    measured[rng.random(depth.shape[:2]) < WINDOW_HOLES] = np.nan
    return measured


def measured_depth(
    scene: Scene, track: Track, pixels: Floats, case: Case, rng: np.random.Generator
) -> Floats:
    """Return the depth (f, p) that is measured at pixels (f, p, 2); NaN where there is none."""
    f, p = pixels.shape[:2]
    shifted = np.nan_to_num(pixels) + [case.shift, 0]
    if case.sensor == "cloud":
        found = cloud_depth(scene, track, shifted, rng)
    else:
        rays = track.intrinsics.rays(window(shifted).reshape(f, -1, 2).astype(float))
        found = window_depth(noisy_depth(case.factor * scene.depth(rays).reshape(f, p, -1), rng))
    found = np.concatenate([np.full((case.delay, p), np.nan), found[: f - case.delay]])
    second = track.seconds.astype(int)
    silent = rng.random(second[-1] + 1) < case.dropout
    silent[0] = False
    found[silent[second]] = np.nan
    return np.where(np.isfinite(pixels).all(-1), found, np.nan)


def cloud_depth(scene: Scene, track: Track, pixels: Floats, rng: np.random.Generator) -> Floats:
    """Return the depth (f, p) at pixels (f, p, 2) from the points of a lidar at the camera."""
    up, across = np.arange(-15.0, 15.1, LINES), np.arange(-35.0, 35.1, COLUMNS)
    rays = np.tan(np.radians(np.stack(np.meshgrid(across, up), -1).reshape(1, -1, 2)))
    at = track.intrinsics.pixels(rays[0])
    found = []
    for i, row in enumerate(pixels):
        near = ((at > row.min(0) - MARGIN) & (at < row.max(0) + MARGIN)).all(1)
        depth = scene.depth(rays[:, near], slice(i, i + 1))[0]
        depth = depth + LIDAR_NOISE * rng.standard_normal(depth.shape)
        points = np.concatenate([rays[0, near], np.ones((len(depth), 1))], 1) * depth[:, None]
        found.append(DepthPoints(points, track.intrinsics).at(row))
    return np.array(found)


def measured_range(scene: Scene, track: Track, rng: np.random.Generator) -> Floats:
    """Return the distance (f,) to the first surface in the beam of a range finder."""
    radius = np.sqrt(np.linspace(0, 1, 60)) * np.tan(BEAM)
    angle = 2.4 * np.arange(60)  # a spiral with even density
    rays = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)[None]
    rays = np.repeat(rays, len(track.seconds), 0)
    far = scene.depth(rays) * np.sqrt(1 + np.square(rays).sum(-1))
    nearest: Floats = far.min(1) + LIDAR_NOISE * rng.standard_normal(len(far))
    return nearest


def by_range(lifter: Lifter, track: Track, lifted: Lifted, distance: Floats) -> Floats:
    """Return the shapes (f, p, 3) with a measured distance, frame after frame."""
    layout = lifter.model.layout
    edges = [(a, b) for a, b in layout.edge_indices()]
    scale = RangeScale(radii(lifter), edges, agreement(lifter).scales)
    scales = [
        scale(("person",), lifted.shapes[i : i + 1], float(distance[i]), BEAM, second)[0]
        for i, second in enumerate(track.seconds.tolist())
    ]
    return scaled(lifted, np.concatenate(scales))


def by_depth(
    track: Track, lifted: Lifted, measured: Floats, scale: DepthScale
) -> tuple[Floats, DepthFit]:
    """Return the shapes (f, p, 3) with measured depth, frame after frame, and the fits."""
    scales, fits = [], []
    for i, second in enumerate(track.seconds.tolist()):
        row = slice(i, i + 1)
        found, fit = scale(
            ("person",), lifted.shapes[row], lifted.confidence[row], measured[row], second
        )
        scales.append(found)
        fits.append(fit)
    fit = DepthFit(*map(np.concatenate, zip(*fits, strict=True)))
    return scaled(lifted, np.concatenate(scales)), fit


def by_median(lifted: Lifted, measured: Floats, radii: Floats) -> Floats:
    """Return the shapes (f, p, 3) with the median factor of the confident keypoints."""
    ratios = measured / (lifted.shapes[..., 2] - radii)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # frames without depth
        factors = np.nanmedian(np.where(lifted.confidence >= MIN_CONFIDENCE, ratios, np.nan), 1)
    return scaled(lifted, factors)


def radii(lifter: Lifter) -> Floats:
    """Return the lifter's distances (p,) of keypoints from the surface."""
    layout = lifter.model.layout
    return surface_radii(layout, lifter.options.length_for(layout))


def agreement(lifter: Lifter) -> Agreement:
    """Return when measured and lifted depth agree, as in the node."""
    layout = lifter.model.layout
    return Agreement(scales=believed_scales(layout, lifter.options.length_for(layout)))


def scaled(lifted: Lifted, factors: Floats) -> Floats:
    """Return shapes (f, p, 3) times factors (f,), of which NaN is 1."""
    shapes: Floats = np.where(np.isnan(factors), 1, factors)[:, None, None] * lifted.shapes
    return shapes


def pixels_of(lifted: Lifted, intrinsics: Intrinsics) -> Floats:
    """Return the pixels (f, p, 2) of lifted points."""
    with np.errstate(invalid="ignore"):
        return intrinsics.pixels(lifted.shapes[..., :2] / lifted.shapes[..., 2:])


def points_error(track: Track, shapes: Floats) -> Floats:
    """Return the mean distance (f,) in mm of the limbs (f, 12, 3) in m from the truth."""
    known = np.isfinite(shapes).all((1, 2))
    error: Floats = np.linalg.norm(1000 * shapes[known] - track.truth[known], axis=-1).mean(1)
    return error


def occlusion(scene: Scene, track: Track, size: float) -> Masks:
    """Return the limb joints (f, 12) in front of which something is nearer than their skin."""
    truth = track.truth / 1000
    surface = scene.depth(truth[..., :2] / truth[..., 2:])
    hidden: Masks = truth[..., 2] - surface > AGREEMENT + size * MEAN_RADIUS
    return hidden


def person_rows(lifter: Lifter, track: Track, size: float, seed: int) -> Iterator[tuple[str, Any]]:
    """Yield the name of each row and the errors of one track for it, in the order of `FIGURES`."""
    limbs = [lifter.model.layout.index(joint) for joint in JOINTS]
    lifted = lift_track(lifter, track, SYSTEMS["in time"], intrinsics=True)
    pixels = pixels_of(lifted, track.intrinsics)
    nothing = (np.zeros(0),) * 3

    def row(shapes: Floats) -> tuple[Floats, ...]:
        return (*errors(track, shapes[:, limbs]), points_error(track, shapes[:, limbs]))

    yield ASSUMED, (*row(lifted.shapes), *nothing)
    for name, case in CASES.items():
        rng = np.random.default_rng(seed)
        scene = Scene(track, size, case, rng)
        if case.sensor == "range":
            distance = measured_range(scene, track, rng)
            yield name, (*row(by_range(lifter, track, lifted, distance)), *nothing)
            continue
        measured = measured_depth(scene, track, pixels, case, rng)
        shapes, fit = by_depth(
            track, lifted, measured, DepthScale(radii(lifter), agreement(lifter))
        )
        hidden = occlusion(scene, track, size)
        known = np.isfinite(measured[:, limbs]) & np.isfinite(fit.scales)[:, None]
        called = fit.occluded[:, limbs].astype(float)
        counts = (fit.agree.sum(1).astype(float), called[hidden & known], called[~hidden & known])
        yield name, (*row(shapes), *counts)
        if case == BOARD:
            yield MEDIAN, (*row(by_median(lifted, measured, radii(lifter))), *nothing)
        elif case == Case():
            on_surface = DepthScale(0 * radii(lifter), agreement(lifter))
            shapes, _ = by_depth(track, lifted, measured, on_surface)
            yield SURFACE, (*row(shapes), *nothing)


def summary(columns: Mapping[str, Floats]) -> dict[str, float]:
    """Return the figures of errors by name: medians, a mean number, shares in %."""
    result = {}
    for name, values in columns.items():
        if len(values):
            mean = float(values.mean())
            is_share, is_mean = name in ("found %", "false %"), name == "agree"
            middle = mean if is_mean else float(np.median(values))
            result[name] = 100 * mean if is_share else middle
    return result


def benchmark(lifter: Lifter, data: Path, stride: int) -> Table:
    """Return the table of errors by size of the people and by case."""
    table = Table(
        "depth",
        "Place and size of people by measured depth",
        ("people", "metres from"),
        tuple(FIGURES),
        FIGURES,
        bars("place mm", "points mm"),
    )
    motions = list(held_out_motions(data / "cmu"))[::stride]
    for people, size in SIZES.items():
        found: dict[str, list[Any]] = {}
        for seed, motion in enumerate(motions):
            track = noisy(filmed(size * motion, 120.0 * (seed % 3), seed), seed)
            for name, row in person_rows(lifter, track, size, seed):
                found.setdefault(name, []).append(row)
        for name, parts in found.items():
            columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
            table.add((people, name), summary(dict(zip(FIGURES, columns, strict=True))))
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    args = model_parser(__doc__, "cmu/").parse_args(argv)
    print_tables(
        lambda: [benchmark(Lifter(load_model(args.model)), args.data, args.stride)], args.output
    )


if __name__ == "__main__":
    main()
