# SPDX-License-Identifier: Apache-2.0
"""Real people before calibrated cameras, frame by frame and in time, beside a mean shape.

Real detections (Shelf, the pose2sim clip) and motion capture with simulated detections (HumanEva,
CMU). People without truth are lifted too, for plausibility figures and pictures. The rows of the
clip need MediaPipe, which `make demo-live` installs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import pyplot
from numpy.typing import NDArray

from benchmarks.data.people_scenes import Track, displaced, people_scenes
from benchmarks.real import plausibility
from benchmarks.real.mediapipe_comparison import mean_person
from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.configuration import add_arguments, override
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.over_time import BOTH, CAUSAL, NONE, OverTime, Stream, lift_stream
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, HUMAN17, MEDIAPIPE33, MPII16
from deep_nrsfm_ros.lifting.history import Context
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.lifting.observation import to_observation, without_border
from deep_nrsfm_ros.lifting.options import HistoryOptions, LiftingOptions
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.lifting.smoothing import Smoother, SmoothingOptions
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import find_model, load_model
from deep_nrsfm_ros.nrsfm.geometry import align, centre, rotation_vector
from deep_nrsfm_ros.nrsfm.metrics import procrustes_distances, rotation_angles

Floats = NDArray[Any]
Masks = NDArray[np.bool_]

FRAME_BY_FRAME = "frame by frame"


class System(NamedTuple):
    """How a track is lifted.

    Attributes:
        history: what is remembered; None: each frame by itself.
        gravity: whether the direction of gravity is given.
        filter: after the correction; None: no filter.
        ahead: whether later frames are used as well.
    """

    history: HistoryOptions | None = None
    gravity: bool = False
    filter: SmoothingOptions | None = None
    ahead: bool = False


_ONE_EURO = SmoothingOptions(enabled=True)
SYSTEMS = {
    FRAME_BY_FRAME: System(),
    "filter after": System(filter=_ONE_EURO),
    "smoothing before": System(HistoryOptions(bones_time=0, depth_cutoff=0)),
    "own bones": System(
        HistoryOptions(shape_time=0, hidden_time=0, rotation_time=0, depth_cutoff=0)
    ),
    "steady depth": System(
        HistoryOptions(shape_time=0, hidden_time=0, rotation_time=0, bones_time=0)
    ),
    "gravity": System(gravity=True),
    "in time": System(HistoryOptions()),
    "in time, filter after": System(HistoryOptions(), filter=_ONE_EURO),
    "in time, gravity": System(HistoryOptions(), gravity=True),
    "looking ahead": System(HistoryOptions(), ahead=True),
}
"""The rows of a scene: the parts of lifting over time, alone and together."""
PARTS = {"face": ("nose", "eye", "ear"), "feet": ("toe", "heel")}
"""Keypoints that some detectors lack, by the ends of their names."""
MEDIAPIPE, MEAN_SHAPE = "MediaPipe", "mean shape"
FIGURES = {
    "PA mm": "mean distance after the best similarity with a proper rotation, frame by frame",
    "camera mm": "the same after the best scale and translation only: in the camera's axes",
    "rotation deg": "angle between the two alignments, median",
    "p90 deg": "90th percentile of that angle",
    "mirrored %": "frames that a reflection would fit better",
    "pitch deg": "mean rotation error about the camera's x axis; above 0: the head is too far from "
    "the camera",
    "place mm": "mean distance of the centroids in the camera's frame, the reference length being "
    "the person's own",
    "missing mm": "camera mm of the joints that the detector lacks",
    "jitter deg": "change of the rotation error from one frame to the next, median",
    "jitter mm": "change of the points' errors from one frame to the next, median",
    "lag ms": "delay of the truth at which it fits the lifted motion best",
    "image lag ms": "the same of x and y alone",
    "frames": "people in frames whose 12 joints have truth, in all views",
}
LEGEND = {
    "figures": "12 limb joints, missing ones included; means of the views",
    "shelf_dev": "OpenPose BODY_25, 5 cameras, 2 or 3 people who hide each other, 25 Hz by "
    "hearsay; the truth is triangulated",
    "humaneva_s1": "motion capture of subject 1 of HumanEva before 3 cameras, 60 Hz; keypoints by "
    "projection",
    "noise": "like that of shelf_dev: 3.2 % of the size, of which little is new in each frame, 9 % "
    "of the joints missing for 0.4 s, 1 % wrong by 25 % of the size",
    "clip": "pose2sim, 4 cameras, 60 Hz. Balancing: OpenPose BODY_25B, triangulated truth. "
    "Standing: MediaPipe's keypoints and truth triangulated from them",
    "CMU 03, 131": "motion capture that `human` was not trained on, before 3 simulated cameras 4 m "
    "away at 1.4 m, 30 Hz, noise as above; light noise: 2 % of the person's size, new in each "
    "frame, 5 % missing; still: poses held for 1.5 s",
    FRAME_BY_FRAME: "each frame by itself",
    "filter after": "the One-Euro filter of the corrected shapes, smoothing.enabled",
    "smoothing before": "the network's shape and rotation, smoothed before the correction",
    "own bones": "the person's bones, learned so far",
    "gravity": "the camera's direction of gravity is given",
    "steady depth": "the depths, filtered over time after the correction, each point on its ray",
    "in time": "smoothing before, own bones and steady depth: the default of node and lift; one "
    "person a stream, causal",
    "looking ahead": "lift --smooth both",
    "intrinsics": "whether the lifter is given the camera's intrinsics; a number: a camera without "
    "distortion whose focal length is so many times the true one",
    MEDIAPIPE: "its own 3D (world landmarks) from the images, trained with 3D labels, smoothed",
    MEAN_SHAPE: "the mean of the motion capture that `human` was trained on, with the rotation and "
    "scale that fit the truth of each frame best",
    **FIGURES,
}
_DELAYS = np.arange(-0.1, 0.301, 0.02)  # s; the best is found between them
_LEAST_MOTION = 10.0  # mm, RMS, of people whose lag can be measured
_PICTURED = 10  # people of a picture


class Choice(NamedTuple):
    """Which people are lifted, by which keypoints and cameras.

    Attributes:
        stride: every n-th trial or sequence only.
        scenes: names of the scenes; empty: all.
        without: names of `PARTS` that the detectors lack.
        focal_errors: factors of the true focal length, for rows of cameras that are known roughly.
        wrong: share of the keypoints that are moved to wrong places.
    """

    stride: int
    scenes: Sequence[str]
    without: Sequence[str]
    focal_errors: Sequence[float] = ()
    wrong: float = 0.0


class Errors(NamedTuple):
    """Errors of n lifted frames of one view; NaN where a figure does not apply."""

    aligned: Floats  # (n, 12) mm
    in_camera: Floats  # (n, 12) mm
    rotation: Floats  # (n,) degrees
    pitch: Floats  # (n,) degrees, the head too far from the camera
    mirrored: Masks  # (n,)
    place: Floats  # (n,) mm
    missing: Masks  # (n, 12) joints that the detector lacks
    jitter: Floats  # (n, 2) degrees and mm since the frame before
    delayed: Floats  # (n, 2, d) squared error of all axes and of x and y at each of d delays


def benchmark(
    lifters: Mapping[str, Lifter],
    systems: Mapping[str, System],
    data: Path,
    output: Path,
    choice: Choice,
) -> Table:
    """Return the table of errors of each scene and system.

    Args:
        lifters: name of a model -> its lifter.
        systems: name -> how the tracks are lifted.
        data: folder that holds cmu/ and scenes/.
        output: folder of results.
        choice: of the scenes, their keypoints and cameras.
    """
    table = Table(
        "people",
        "People before calibrated cameras",
        ("scene", "system", "intrinsics"),
        tuple(FIGURES),
        LEGEND,
        bars("PA mm", "camera mm"),
    )
    mean = mean_person(data / "cmu")
    for scene, complete in people_scenes(data, output, choice.stride, choice.scenes):
        tracks = [without(track, choice.without) for track in complete]
        if choice.wrong:
            tracks = [displaced(track, choice.wrong, seed) for seed, track in enumerate(tracks)]
        rough = {f"{x:g}": [rough_camera(t, x) for t in tracks] for x in choice.focal_errors}
        for label, filmed in {"yes": tracks, **rough, "no": tracks}.items():
            for model, lifter in lifters.items():
                for name, system in systems.items():
                    errors = [
                        (t.view, lifting_errors(lifter, t, system, intrinsics=label != "no"))
                        for t in filmed
                    ]
                    title = name if len(lifters) == 1 else f"{model}, {name}"
                    table.add((scene, title, label), figures(errors))
        own = [(t, t.world_landmarks) for t in tracks if t.world_landmarks is not None]
        if own:
            errors = [(t.view, shape_errors(t, shapes, None)) for t, shapes in own]
            table.add((scene, MEDIAPIPE, "no"), figures(errors))
        rigid = [
            (t.view, shape_errors(t, np.broadcast_to(mean, t.truth.shape), None)) for t in tracks
        ]
        table.add((scene, MEAN_SHAPE, ""), {"PA mm": figures(rigid)["PA mm"]})
        print(scene, "done", file=sys.stderr)
    return table


def without(track: Track, parts: Sequence[str]) -> Track:
    """Return a track as a detector that lacks the keypoints of some `PARTS` sees it."""
    words = tuple(word for part in parts for word in PARTS[part])
    names = [name for name in track.layout.keypoints if not name.endswith(words)]
    if not words or len(names) == len(track.layout):
        return track
    at = [track.layout.index(name) for name in names]
    layout = KeypointLayout(f"{track.layout.name}_part", tuple(names))
    points, confidence = track.points[:, at], track.confidence[:, at]
    return track._replace(layout=layout, points=points, confidence=confidence)


def rough_camera(track: Track, factor: float) -> Track:
    """Return a track whose camera has no distortion and `factor` times its focal length."""
    fx, fy = track.intrinsics.focal
    camera = track.intrinsics.without_lens()
    return track._replace(intrinsics=replace(camera, focal=(factor * fx, factor * fy)))


def lift_track(lifter: Lifter, track: Track, system: System, *, intrinsics: bool) -> Lifted:
    """Lift a track as the node does, one frame after the other; return its f objects.

    Args:
        lifter: a model with its options; its layout may differ from the track's.
        track: one person.
        system: how it is lifted.
        intrinsics: whether the lifter is given the camera's intrinsics.
    """
    values = np.concatenate([track.points, track.confidence[..., None]], -1)
    seen = to_observation(values, InputOptions().min_confidence)
    to_model = KeypointMap(track.layout, lifter.model.layout)

    lifter = Lifter(lifter.model, lifter.options, layout=track.layout, history=system.history)
    f = len(track.points)
    starts, names = np.arange(f + 1), ["person"] * f

    def lift(points: Floats, confidence: Floats, context: Context | None = None) -> Lifted:
        if intrinsics:
            return lift_perspective(lifter, track.intrinsics, points, confidence, context)
        return lifter.lift(points, confidence, context=context)

    if system.history or system.gravity:
        stream = Stream(seen.points, seen.confidence, to_model, starts, track.seconds, names)
        smooth = BOTH if system.ahead else CAUSAL if system.history else NONE
        over_time = OverTime(smooth, track.up if system.gravity else None)
        lifted = lift_stream(lift, lifter.memory(), stream, over_time)
    else:
        lifted = lift_all(lift, *to_model(seen.points, seen.confidence))
    if system.filter is None:
        return lifted
    smoother = Smoother(system.filter)
    smoothed = [
        smoother(lifted.at([i]), ("person",), second)[0]
        for i, second in enumerate(track.seconds.tolist())
    ]
    return Lifted._make(np.concatenate(parts) for parts in zip(*smoothed, strict=True))


def lifting_errors(lifter: Lifter, track: Track, system: System, *, intrinsics: bool) -> Errors:
    """Return the errors of a track, lifted as in `lift_track`."""
    lifted = lift_track(lifter, track, system, intrinsics=intrinsics)
    layout = lifter.model.layout
    limbs = [layout.index(joint) for joint in JOINTS]
    unit = lifter.options.reference_length or layout.reference_length or 1.0
    return shape_errors(track, lifted.shapes[:, limbs], unit if intrinsics else None)


def shape_errors(track: Track, shapes: Floats, unit: float | None) -> Errors:
    """Return the errors of shapes.

    Args:
        track: with the truth.
        shapes: (f, 12, 3) in the camera's axes.
        unit: reference length of shapes that are at their places; None: they are not.
    """
    known = np.isfinite(track.truth).all((1, 2)) & np.isfinite(shapes).all((1, 2))
    placed, truth, seconds = shapes[known].astype(float), track.truth[known], track.seconds[known]
    S, T = centre(placed), centre(truth)
    scale = (S * T).sum((1, 2)) / (S * S).sum((1, 2))
    E = scale[:, None, None] * S - T
    R = align(S, T).rotation
    turned = np.array([rotation_vector(Q) for Q in R]).reshape(-1, 3)
    place = np.full(len(S), np.nan)
    if unit is not None and len(S):
        length = track.reference_length / unit
        place = np.linalg.norm(length * placed.mean(1) - truth.mean(1), axis=1)
    jitter = np.full((len(S), 2), np.nan)
    if len(S) > 1:
        jitter[1:, 0] = rotation_angles(R[1:].swapaxes(1, 2) @ R[:-1])
        jitter[1:, 1] = np.linalg.norm(np.diff(E, axis=0), axis=2).mean(1)
        step = np.diff(seconds)
        jitter[1:][step > 1.5 * step.min()] = np.nan
    return Errors(
        procrustes_distances(S, T),
        np.linalg.norm(E, axis=2),
        rotation_angles(R),
        -np.degrees(turned[:, 0]),
        align(S, T, allow_reflection=True).mirrored,
        place,
        _missing(track)[known],
        jitter,
        _delayed_errors(np.median(scale) * S, T, seconds),
    )


def _missing(track: Track) -> Masks:
    """Return which limb joints (f, 12) the detector lacks."""
    at = [track.layout.index(joint) for joint in JOINTS]
    missing: Masks = track.confidence[:, at] < InputOptions().min_confidence
    return missing


def _delayed_errors(S: Floats, T: Floats, seconds: Floats) -> Floats:
    """Return the squared error (n, 2, d) of S against T delayed; NaN where it cannot be known.

    A constant error is left out, since it says nothing about the delay.
    """
    n, d = len(S), len(_DELAYS)
    errors = np.full((n, 2, d), np.nan)
    if n < 2 or np.sqrt(T.var(0).sum(-1).mean()) < _LEAST_MOTION:
        return errors
    inside = (seconds >= seconds[0] + _DELAYS[-1]) & (seconds <= seconds[-1] + _DELAYS[0])
    if not inside.any():
        return errors
    for i, delay in enumerate(_DELAYS):
        times = seconds[inside] - delay
        after = np.clip(np.searchsorted(seconds, times), 1, n - 1)
        share = (times - seconds[after - 1]) / (seconds[after] - seconds[after - 1])
        E = S[inside] - T[after - 1] - share[:, None, None] * (T[after] - T[after - 1])
        squares = np.square(E - E.mean(0)).sum(1)
        errors[inside, 0, i], errors[inside, 1, i] = squares.sum(1), squares[:, :2].sum(1)
    return errors


def figures(tracks: Sequence[tuple[str, Errors]]) -> dict[str, float]:
    """Return the means over the views of the `FIGURES` of tracks, each with its view."""
    views: dict[str, list[Errors]] = {}
    for view, errors in tracks:
        views.setdefault(view, []).append(errors)
    rows = [
        _view_figures(Errors(*map(np.concatenate, zip(*parts, strict=True))))
        for parts in views.values()
    ]
    rows = [row for row in rows if row["frames"]]
    means = {
        name: float(np.mean([row[name] for row in rows if name in row]))
        for name in FIGURES
        if any(name in row for row in rows)
    }
    return means | {"frames": sum(row["frames"] for row in rows)}


def _view_figures(errors: Errors) -> dict[str, float]:
    """Return the `FIGURES` of one view that apply."""
    n = len(errors.rotation)
    if not n:
        return {"frames": 0.0}
    row = {
        "PA mm": errors.aligned.mean(),
        "camera mm": errors.in_camera.mean(),
        "rotation deg": np.median(errors.rotation),
        "p90 deg": np.percentile(errors.rotation, 90),
        "mirrored %": 100 * errors.mirrored.mean(),
        "pitch deg": errors.pitch.mean(),
        "frames": n,
    }
    if np.isfinite(errors.place).any():
        row["place mm"] = np.nanmean(errors.place)
    if errors.missing.any():
        row["missing mm"] = errors.in_camera[errors.missing].mean()
    moved = np.isfinite(errors.jitter[:, 0])
    if moved.any():
        row["jitter deg"], row["jitter mm"] = np.median(errors.jitter[moved], axis=0)
    delayed = errors.delayed[np.isfinite(errors.delayed[:, 0, 0])]
    if len(delayed):
        row["lag ms"], row["image lag ms"] = map(_best_delay, delayed.sum(0))
    return {name: float(value) for name, value in row.items() if np.isfinite(value)}


def _best_delay(errors: Floats) -> float:
    """Return the delay of least error (d,) in ms, by a parabola through the three least."""
    i = int(np.clip(errors.argmin(), 1, len(errors) - 2))
    before, least, after = errors[i - 1 : i + 2]
    bend = before - 2 * least + after
    offset = (before - after) / (2 * bend) if bend > 0 else 0.0
    return 1000 * float(_DELAYS[i] + offset * (_DELAYS[1] - _DELAYS[0]))


class Onlookers(NamedTuple):
    """People without truth."""

    layout: KeypointLayout
    points: Floats  # (n, q, 2) pixels, 0 where missing
    confidence: Floats  # (n, q)
    size: tuple[int, int] | None  # of the image, if known


def people_without_truth(data: Path) -> Iterator[tuple[str, Onlookers]]:
    """Yield name and people of the scenes without truth that exist."""
    for file in sorted((data / "scenes" / "signers").glob("*.npz")):
        with np.load(file) as a:
            layout = BODY25 if a["pose"].shape[1] == len(BODY25) else MEDIAPIPE33
            size = (int(a["image_size"][0]), int(a["image_size"][1]))
            yield (
                f"signers, {file.stem}",
                Onlookers(layout, np.nan_to_num(a["pose"]), a["pose_confidence"], size),
            )
    file = data / "scenes" / "people_mpii" / "people_mpii.npz"
    if file.exists():
        with np.load(file) as a:
            for title, key in (("detector", "points"), ("annotated", "points_annotated")):
                visible = np.isfinite(a[key]).all(-1) & ~a["missing"]
                points = np.where(visible[..., None], a[key], 0)
                yield f"MPII, {title}", Onlookers(MPII16, points, visible.astype(float), None)


LOOKED_AT = {
    "people": "people in images",
    "lifted %": "those with enough keypoints",
    "residual %": "of the network, relative reprojection error, median",
    "confidence %": "of all points of the lifted people, mean",
    **plausibility.FIGURES,
}


def look_at(lifters: Mapping[str, Lifter], data: Path, output: Path) -> Table:
    """Lift people without truth; write pictures and return the table of plausibility."""
    table = Table(
        "people_without_truth",
        "People without truth",
        ("scene", "model"),
        tuple(LOOKED_AT),
        LOOKED_AT,
        bars("residual %", "knees %"),
    )
    for scene, people in people_without_truth(data):
        values = np.concatenate([people.points, people.confidence[..., None]], -1)
        seen = to_observation(values, InputOptions().min_confidence)
        if people.size:
            seen = without_border(seen, people.size)
        shapes: dict[str, Floats] = {}
        own = KeypointMap(people.layout, HUMAN17)(seen.points, seen.confidence)
        for model, lifter in lifters.items():
            lifter = Lifter(lifter.model, lifter.options, layout=people.layout)
            lifted = lifter(seen.points, seen.confidence)
            done = np.isfinite(lifted.residual)
            S = lifted.shapes[:, [lifter.model.layout.index(k) for k in HUMAN17.keypoints]]
            row = {
                "people": float(len(done)),
                "lifted %": 100 * float(done.mean()),
                "residual %": 100 * float(np.median(lifted.residual[done])),
                "confidence %": 100 * float(lifted.confidence[done].mean()),
            }
            row |= plausibility.figures(S[done], own[1][done] > 0)
            table.add((scene, model), {k: v for k, v in row.items() if np.isfinite(v)})
            shapes[model] = S
        done = np.isfinite(np.stack(list(shapes.values()))).all((0, 2, 3))
        at = np.flatnonzero(done)
        at = at[np.linspace(0, len(at) - 1, min(_PICTURED, len(at))).astype(int)]
        figure = pyplot.figure(layout="constrained")
        dataset = Dataset(own[0], own[1] > 0, HUMAN17, scene)
        plausibility.draw(figure, dataset, shapes, at.tolist())
        output.mkdir(parents=True, exist_ok=True)
        figure.savefig(output / f"people_{scene.replace(', ', '_')}.png", dpi=60)
        pyplot.close(figure)
    return table


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", nargs="*", default=["human"], help="names or files of models")
    parser.add_argument("--data", type=Path, required=True, help="folder with cmu/ and scenes/")
    parser.add_argument("--output", type=Path, default=Path("runs/benchmarks"))
    parser.add_argument("--stride", type=int, default=1, help="use every n-th trial or sequence")
    parser.add_argument("--scenes", nargs="+", default=[], help="names of scenes; default: all")
    parser.add_argument(
        "--without",
        nargs="+",
        default=[],
        choices=PARTS,
        help="leave out the keypoints of these parts, as a detector that lacks them",
    )
    parser.add_argument(
        "--focal-error",
        nargs="+",
        type=float,
        default=[],
        metavar="FACTOR",
        help="add rows of a camera without distortion and with so many times the true focal length",
    )
    parser.add_argument(
        "--wrong",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="move this share of the keypoints to wrong places, 0.01 typical",
    )
    parser.add_argument(
        "--systems", nargs="+", default=list(SYSTEMS), choices=SYSTEMS, help="default: all"
    )
    add_arguments(parser, LiftingOptions)
    args = parser.parse_args(argv)

    def tables() -> list[Table]:
        options = override(LiftingOptions(), args)
        files = [find_model(name, model_folders(default_models_dir())) for name in args.models]
        lifters = {file.stem: Lifter(load_model(file), options) for file in files}
        systems = {name: SYSTEMS[name] for name in args.systems}
        choice = Choice(args.stride, args.scenes, args.without, args.focal_error, args.wrong)
        errors = benchmark(lifters, systems, args.data, args.output, choice)
        return [errors] if args.scenes else [errors, look_at(lifters, args.data, args.output)]

    print_tables(tables, args.output)


if __name__ == "__main__":
    main()
