# SPDX-License-Identifier: Apache-2.0
"""Figures for the choice of a model of people, without the pose2sim clip.

Proportions of detectors' joints and of motion capture, and errors of models on both. The model
`human17` was chosen by them; `benchmarks.real.mediapipe_comparison` tests it on the clip.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.real.mediapipe_comparison import SUBJECTS
from benchmarks.robustness.smoothing import VIDEO, Clip, video_clip
from deep_nrsfm_ros.configuration import add_arguments, override
from deep_nrsfm_ros.data.mocap import read_trials, trials
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31, HUMAN17
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifted, Lifter, lift_all
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import find_model, load_model
from deep_nrsfm_ros.nrsfm.metrics import camera_errors

Floats = NDArray[Any]

HELD_OUT = ("03", "131")
STRIDE = 20
VIDEO_STRIDE = 5
MIN_CONFIDENCE = 0.5  # lowest confidence of measured joints
MIN_SHOULDER_WIDTH = 0.65  # of a person who faces the camera, in torso lengths
CAMERA = Intrinsics((1600.0, 1600.0), (960.0, 540.0))
NOISE = 0.04  # of a frame's size
MISSING = 0.05  # of the joints
_TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "nose")
_CMU_TRUNK = ("lclavicle", "rclavicle", "lhipjoint", "rhipjoint")
LEGEND = f"""hips, shoulders: distance of left and right in torso lengths, 90th percentile over the
    frames; nose: its height above the neck along the torso, median; CMU: the first trials of the
    nine subjects that `human17` was trained on
residual: of the network on the video's detections, relative, median; no label is needed
the others: CMU {" and ".join(HELD_OUT)}, not used in training, in front of a perspective
    camera 3 to 5 m away that looks down by 12 +- 10 degrees and rolls by 8, {NOISE:.0%} noise,
    {MISSING:.0%} of the joints missing; 12 limb joints, means of the two subjects; errors as in
    mediapipe_comparison"""


class Observations(NamedTuple):
    """Simulated observations of n people."""

    points: Floats  # (n, 17, 2) pixels
    confidence: Floats  # (n, 17)
    truth: Floats  # (n, 12, 3) mm, `JOINTS` in the camera's axes


def proportions(X: Floats) -> dict[str, float]:
    """Return the proportions of people X (n, 4 or 5, 2 or 3): shoulders, hips, perhaps nose."""
    left, right, left_hip, right_hip = X.swapaxes(0, 1)[:4]
    neck = (left + right) / 2
    up = neck - (left_hip + right_hip) / 2
    torso = np.linalg.norm(up, axis=1)
    across = {"hips": left_hip - right_hip, "shoulders": left - right}
    row = {
        name: float(np.percentile(np.linalg.norm(gap, axis=1) / torso, 90))
        for name, gap in across.items()
    }
    if X.shape[1] > len(_CMU_TRUNK):
        row["nose"] = float(np.median(((X[:, 4] - neck) * up).sum(1) / torso**2))
    return row


def facing_trunks(clip: Clip) -> Floats:
    """Return trunk and nose (n, 5, 2) of the people who face the camera."""
    places = [HUMAN17.index(joint) for joint in _TRUNK]
    X = clip.points[:, places][(clip.confidence[:, places] > MIN_CONFIDENCE).all(1)].astype(float)
    facing_camera = [proportions(person[None])["shoulders"] > MIN_SHOULDER_WIDTH for person in X]
    chosen: Floats = X[facing_camera]
    return chosen


def read_shapes(paths: Sequence[Path], layout: KeypointLayout) -> Floats:
    """Return the shapes (n, p, 3) of trials in metres, y up."""
    shapes = read_trials(paths, layout, stride=STRIDE).shapes
    assert shapes is not None
    return shapes


def simulate_camera(shapes: Floats, rng: np.random.Generator) -> Observations:
    """Return the observations of shapes (n, 17, 3), metres, y up, by a random camera."""
    n = len(shapes)
    roll, tilt = rng.normal(0, 8, n), rng.normal(12, 10, n)
    angles = np.column_stack((roll, tilt, rng.uniform(0, 360, n)))
    R = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    depth = rng.uniform(3, 5, n)
    place = np.column_stack((rng.normal(0, 0.15, (n, 2)) * depth[:, None], depth))
    X = (shapes * [1, -1, -1]) @ R.swapaxes(1, 2) + place[:, None]
    W = CAMERA.pixels(X[..., :2] / X[..., 2:])
    size = (W - W.mean(1, keepdims=True)).std((1, 2), keepdims=True)
    W = W + NOISE * size * rng.standard_normal(W.shape)
    visible = rng.random(W.shape[:2]) >= MISSING
    limbs = [HUMAN17.index(joint) for joint in JOINTS]
    return Observations(W.astype(np.float32), visible.astype(np.float32), 1000 * X[:, limbs])


def errors(lifter: Lifter, observations: Observations, *, intrinsics: bool) -> dict[str, float]:
    """Return the errors of a lifter with or without the camera's intrinsics."""
    limbs = [HUMAN17.index(joint) for joint in JOINTS]

    def placed(points: Floats, confidence: Floats) -> Lifted:
        return lift_perspective(lifter, CAMERA, points, confidence)

    shapes = lift_all(
        placed if intrinsics else lifter.lift, observations.points, observations.confidence
    ).shapes
    visible = np.isfinite(shapes).all((1, 2))
    error = camera_errors(shapes[visible][:, limbs], observations.truth[visible])
    return {
        "PA mm": error.aligned,
        "camera mm": error.in_camera,
        "rotation deg": error.rotation,
        "mirrored %": 100 * error.mirrored,
    }


def show(title: str, rows: Mapping[str, Mapping[str, float]]) -> None:
    """Print rows of figures as a table; the first has all the columns."""
    columns = list(next(iter(rows.values())))
    print(f"| {' | '.join((title, *columns))} |\n{'|---' * (1 + len(columns))}|")
    for name, row in rows.items():
        cells = (f"{row[column]:.3g}" if column in row else "" for column in columns)
        print(f"| {name} | {' | '.join(cells)} |")
    print(flush=True)


def benchmark(lifters: Mapping[str, Lifter], data: Path) -> None:
    """Print both tables."""
    video, folder = video_clip(data / VIDEO), data / "cmu"
    trunk = [HUMAN17.index(joint) for joint in _TRUNK]
    raw = [CMU31.index(joint) for joint in _CMU_TRUNK]
    first = [trials(folder, subject)[0] for subject in SUBJECTS]
    show(
        "people",
        {
            "OpenPose on a video, facing the camera": proportions(facing_trunks(video)),
            "CMU, as captured": proportions(read_shapes(first, CMU31)[:, raw]),
            "CMU, as `human17`": proportions(read_shapes(first, HUMAN17)[:, trunk]),
        },
    )
    nearly_complete = (video.confidence > 0).sum(1) >= 12
    points, confidence = (part[nearly_complete][::VIDEO_STRIDE] for part in video[:2])
    held_out = [read_shapes(trials(folder, subject), HUMAN17) for subject in HELD_OUT]
    observations = [simulate_camera(shapes, np.random.default_rng(1)) for shapes in held_out]
    rows: dict[str, dict[str, float]] = {}
    for name, lifter in lifters.items():
        lifted = lift_all(lifter.lift, points, confidence)
        rows[name] = {"residual": float(np.nanmedian(lifted.residual))}
        for with_intrinsics, suffix in ((False, ""), (True, ", intrinsics")):
            each = [errors(lifter, person, intrinsics=with_intrinsics) for person in observations]
            rows[name] |= {
                f"{key}{suffix}": float(np.mean([e[key] for e in each])) for key in each[0]
            }
    show("model", rows)
    print(LEGEND)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", nargs="*", default=["human17"], help="models of `human17`")
    parser.add_argument("--data", type=Path, required=True, help="holds cmu/ and detections/")
    add_arguments(parser, LiftingOptions)
    args = parser.parse_args(argv)
    options = override(LiftingOptions(), args)
    folders = model_folders(default_models_dir())
    try:
        models = {name: load_model(find_model(name, folders)) for name in args.models}
        benchmark({name: Lifter(model, options) for name, model in models.items()}, args.data)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
