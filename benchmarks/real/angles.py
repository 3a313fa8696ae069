# SPDX-License-Identifier: Apache-2.0
"""Joint angles of lifted people against those of the truth by the same formulas, and their closure.

The angles of both follow from the 12 limb joints, so that the table shows what lifting costs.
Elbows and knees also against the angles in CMU's AMC files, which have them as hinges.
Closure: forward kinematics of the angles with a person's mean bone lengths, against the points.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.data.people_scenes import (
    AZIMUTHS,
    CMU,
    CMU_STRIDE,
    HELD_OUT,
    HUMANEVA,
    filmed,
    held_out_trials,
    noisy,
    people_scenes,
)
from benchmarks.harness import model_parser
from benchmarks.real.people import SYSTEMS, lift_track
from benchmarks.table import Table, bars, print_tables
from deep_nrsfm_ros.body.kinematic_tree import KinematicTree
from deep_nrsfm_ros.data.mocap import human17, read_amc, read_amc_angles, read_asf, trials
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.layouts.joints import fitting_joints
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.model_files.model_file import load_model
from deep_nrsfm_ros.nrsfm.metrics import rotation_angles

Floats = NDArray[Any]

LIMBS = KeypointLayout("limbs12", JOINTS, joints=fitting_joints(HUMAN17.joints, JOINTS))
SYSTEM = "in time"
SCENES = (CMU, HUMANEVA)
SUBJECTS = ("01", "05", "14", "86", "127", *HELD_OUT)
"""Of CMU, whose poses are closed."""
HEIGHT = 3.5
"""A person's height in lengths of the trunk, from mid-hip to neck: 1.75 m with 0.5 m."""
_LEVELLED = 5.0
"""Degrees: a hanging arm within this angle has no y_shoulder and r_shoulder of its own."""
HINGES = {"elbow": ("radius", 1.0), "knee": ("tibia", -1.0)}
"""Angle -> the bone of AMC files that it turns, and the sign of its angle there."""
FIGURES = {
    "median deg": "of the absolute error",
    "mean deg": "of the absolute error",
    "p90 deg": "90th percentile of the absolute error",
    "fixed deg": "median absolute error of a constant, the median of the truth",
    "frame deg": "median angle between lifted and true frame of the joint, relative to its parent",
}
CLOSURE = {
    "RMS %": "distance of forward kinematics from the points, RMS, of the height (3.5 trunks)",
    "p99 %": "99th percentile of that distance",
    "REP-155 alone %": "the RMS without r_waist and y_waist, which REP-155 does not have",
}
AMC_FIGURES = {
    "truth deg": "median absolute difference of the true 3D's angle by our formulas from AMC's",
    "truth max deg": "the largest of them",
    "lifted deg": "median absolute difference of the lifted angle from AMC's",
    "lifted p90 deg": "90th percentile of it",
    "bias deg": "median of lifted - AMC's; above 0: lifted more bent",
    "fixed deg": "median absolute difference of a constant, the median of AMC's",
    "frames": "frames of all cameras",
}


def scene_angles(
    lifter: Lifter, data: Path, output: Path, stride: int, chosen: Sequence[str]
) -> Table:
    """Return the table of angle errors.

    Args:
        lifter: a model with its options.
        data: folder that holds cmu/ and scenes/.
        output: folder of results.
        stride: every n-th trial or sequence only.
        chosen: names of the scenes.
    """
    tree = KinematicTree(LIMBS)
    table = Table(
        "angles",
        "Angles of lifted people against those of the truth",
        ("scene", "angle"),
        tuple(FIGURES),
        FIGURES | {"angle": "means of left and right"},
        bars("median deg", "fixed deg"),
    )
    layout = lifter.model.layout
    limbs = [layout.index(joint) for joint in JOINTS]
    for scene, tracks in people_scenes(data, output, stride, chosen):
        lifted, truth = [], []
        for track in tracks:
            S = lift_track(lifter, track, SYSTEMS[SYSTEM], intrinsics=True).shapes[:, limbs]
            known = np.isfinite(S).all((1, 2)) & np.isfinite(track.truth).all((1, 2))
            lifted.append(S[known].astype(float))
            truth.append(track.truth[known])
        for name, row in angle_errors(tree, np.concatenate(lifted), np.concatenate(truth)):
            table.add((scene, name), row)
        print(scene, "done", file=sys.stderr)
    return table


def angle_errors(
    tree: KinematicTree, lifted: Floats, truth: Floats
) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the name of each angle, of both sides together, and its `FIGURES`.

    Args:
        tree: of both.
        lifted: (n, p, 3).
        truth: (n, p, 3), in another unit or not.
    """
    found, true = tree(lifted), tree(truth)
    error = np.abs(_wrapped(found.angles - true.angles))
    middle = np.arctan2(np.median(np.sin(true.angles), 0), np.median(np.cos(true.angles), 0))
    fixed = np.abs(_wrapped(true.angles - middle))
    locked = _locked(tree, true.angles)
    columns: dict[str, list[int]] = {}
    for column, name in enumerate(tree.angle_names):
        side, _, part = name.partition("_")
        is_side = side in ("l", "r") and tree.names[tree.angle_joints[column]] != "waist"
        columns.setdefault(part if is_side else name, []).append(column)
    relative = [
        rotations[:, list(tree.parents)].swapaxes(-1, -2) @ rotations
        for rotations in (found.rotations, true.rotations)
    ]
    apart = relative[0].swapaxes(-1, -2) @ relative[1]
    for name, members in columns.items():
        use = ~locked[:, members]
        if name == "waist":  # no keypoint shows it
            continue
        values = np.degrees(error[:, members][use])
        turned = rotation_angles(
            apart[:, [tree.angle_joints[c] for c in members]].reshape(-1, 3, 3)
        )
        yield (
            name,
            {
                "median deg": float(np.median(values)),
                "mean deg": float(values.mean()),
                "p90 deg": float(np.percentile(values, 90)),
                "fixed deg": float(np.median(np.degrees(fixed[:, members][use]))),
                "frame deg": float(np.median(turned)),
            },
        )


def amc_table(lifter: Lifter, data: Path, stride: int) -> Table:
    """Return the table of hinges against the angles that CMU's AMC files carry.

    Other joints of AMC have three angles about axes of their own, which ours are not. A hinge has
    the same axis in both; the files' angles are those of an optimisation of the whole skeleton.

    Args:
        lifter: a model with its options.
        data: folder that holds cmu/.
        stride: every n-th trial only.
    """
    tree = KinematicTree(LIMBS)
    table = Table(
        "amc",
        "Elbows and knees against the angles of AMC files",
        ("angle",),
        tuple(AMC_FIGURES),
        AMC_FIGURES,
        bars("truth deg", "lifted deg", "fixed deg"),
    )
    table.digits["frames"] = 0
    limbs = [lifter.model.layout.index(joint) for joint in JOINTS]
    hinges = [(side, angle) for angle in HINGES for side in ("left", "right")]
    bones = [side[0] + HINGES[angle][0] for side, angle in hinges]
    columns = [tree.angle_names.index(f"{side[0]}_{angle}") for side, angle in hinges]
    signs = np.array([HINGES[angle][1] for _, angle in hinges])
    parts = []
    for seed, (trial, motion) in enumerate([*held_out_trials(data / "cmu")][::stride]):
        amc = read_amc_angles(trial, bones)[::CMU_STRIDE]
        for azimuth in AZIMUTHS:
            track = noisy(filmed(motion, azimuth, seed), seed)
            S = lift_track(lifter, track, SYSTEMS[SYSTEM], intrinsics=True).shapes[:, limbs]
            known = np.isfinite(S).all((1, 2))
            ours = [
                signs * np.degrees(tree(X[known].astype(float)).angles[:, columns])
                for X in (track.truth, S)
            ]
            parts.append((amc[known], *ours))
    amc, truth, lifted = (np.concatenate(part) for part in zip(*parts, strict=True))
    for column, (side, angle) in enumerate(hinges):
        row = amc_errors(amc[:, column], truth[:, column], lifted[:, column])
        table.add((f"{side} {angle}",), row)
    return table


def amc_errors(amc: Floats, truth: Floats, lifted: Floats) -> dict[str, float]:
    """Return the `AMC_FIGURES` of one hinge, from angles (n,) in degrees, above 0 where bent."""
    of_truth, of_lifted = np.abs(truth - amc), np.abs(lifted - amc)
    return {
        "truth deg": float(np.median(of_truth)),
        "truth max deg": float(of_truth.max()),
        "lifted deg": float(np.median(of_lifted)),
        "lifted p90 deg": float(np.percentile(of_lifted, 90)),
        "bias deg": float(np.median(lifted - amc)),
        "fixed deg": float(np.median(np.abs(amc - np.median(amc)))),
        "frames": len(amc),
    }


def _locked(tree: KinematicTree, angles: Floats) -> NDArray[np.bool_]:
    """Return which angles (n, a) a hanging arm leaves undetermined: the shoulder's y and r."""
    locked = np.zeros(angles.shape, bool)
    for side in "lr":
        raised = angles[:, tree.angle_names.index(f"{side}_p_shoulder")]
        for angle in "yr":
            column = tree.angle_names.index(f"{side}_{angle}_shoulder")
            locked[:, column] = np.abs(raised) < np.radians(_LEVELLED)
    return locked


def _wrapped(angles: Floats) -> Floats:
    """Return angles in radians, in -pi to pi."""
    wrapped: Floats = (angles + np.pi) % (2 * np.pi) - np.pi
    return wrapped


def closure_table(data: Path, frames: int) -> Table:
    """Return the table of closures on the poses of CMU.

    Args:
        data: folder that holds cmu/.
        frames: of a subject at most.
    """
    tree = KinematicTree(HUMAN17)
    table = Table(
        "closure",
        "Forward kinematics of a person's angles against the points",
        ("subject",),
        (*CLOSURE, "poses"),
        CLOSURE,
        bars("RMS %", "REP-155 alone %"),
    )
    for subject in SUBJECTS:
        skeleton = read_asf(data / "cmu" / subject / f"{subject}.asf")
        paths = trials(data / "cmu", subject)
        poses = np.concatenate([human17(read_amc(path, skeleton)) for path in paths])
        poses = poses[:: max(len(poses) // frames, 1)].astype(float)
        table.add((subject,), closure(tree, poses))
    return table


def closure(tree: KinematicTree, points: Floats) -> dict[str, float]:
    """Return the `CLOSURE` of the poses (n, p, 3) of one person."""
    pose = tree(points)
    offsets = tree.offsets(pose).mean(0)
    height = HEIGHT * float(np.linalg.norm(offsets[tree.names.index("torso")]))
    ours = [name not in ("r_waist", "y_waist") for name in tree.angle_names]
    distances = []
    for angles in (pose.angles, pose.angles * ours):
        again = tree.forward(pose.origins[:, 0], pose.rotations[:, 0], angles, offsets)
        distances.append(100 / height * np.linalg.norm(again.origins - pose.origins, axis=-1))
    rms = [float(np.sqrt(np.square(d).mean())) for d in distances]
    p99 = float(np.percentile(distances[0], 99))
    return {"RMS %": rms[0], "p99 %": p99, "REP-155 alone %": rms[1], "poses": len(points)}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = model_parser(__doc__, "cmu/ and scenes/")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), help="names of scenes")
    parser.add_argument("--frames", type=int, default=10_000, help="poses of a subject to close")
    args = parser.parse_args(argv)

    def tables() -> list[Table]:
        lifter = Lifter(load_model(args.model))
        closure = closure_table(args.data, args.frames)
        amc = amc_table(lifter, args.data, args.stride)
        scenes = scene_angles(lifter, args.data, args.output, args.stride, args.scenes)
        return [closure, amc, scenes]

    print_tables(tables, args.output)


if __name__ == "__main__":
    main()
