# SPDX-License-Identifier: Apache-2.0
"""One person seen by four cameras: the lifter, MediaPipe's own 3D and a mean shape.

Needs MediaPipe, which `make demo-live` installs, and downloads the pose2sim clip from PyPI.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.data.pose2sim_scenes import LIMBS, Scene, scenes
from benchmarks.harness import Session, run_program
from benchmarks.table import Table, bars
from deep_nrsfm_ros.data.mocap import TrialSelection, read_split
from deep_nrsfm_ros.data.pose2sim import JOINTS
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25B, HUMAN17, MEDIAPIPE33
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.observation import to_observation
from deep_nrsfm_ros.lifting.perspective import lift_perspective
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.model_files.folders import model_folders
from deep_nrsfm_ros.model_files.model_file import find_model, load_model
from deep_nrsfm_ros.nrsfm.geometry import align, centre
from deep_nrsfm_ros.nrsfm.metrics import camera_errors, rotation_angles

Floats = NDArray[Any]

SUBJECTS = ("01", "02", "05", "14", "49", "60", "61", "86", "127")
"""The subjects that the model `human` was trained on."""
MEAN_STRIDE = 30
"""Frames of the motion capture of which the mean shape takes one."""
ON_CLIP, ON_MEDIAPIPE = "ours, clip's 2D", "ours, MediaPipe's 2D"
WITH_INTRINSICS = ", intrinsics"
WORLD, MEAN_SHAPE = "MediaPipe 3D", "mean shape"
FIGURES = {
    "frames": "with a detected person and complete truth; all figures are of these frames",
    "PA mm": "mean distance after similarity alignment by a proper rotation, frame by frame",
    "camera mm": "the same after the best scale and shift only: the camera's rotation, known from "
    "the calibration, must be right too",
    "rotation deg": "angle between the two alignments, median",
    "mirrored %": "frames that a reflection would fit better",
    "jitter deg": "angle between the shapes of one frame and the next in the camera's axes, "
    "median; of the standing person alone, where it should be 0",
    "ms": "median time per frame from the input of the system, at the current load of the machine",
}
SYSTEMS = (
    ON_CLIP,
    ON_CLIP + WITH_INTRINSICS,
    ON_MEDIAPIPE,
    ON_MEDIAPIPE + WITH_INTRINSICS,
    WORLD,
    MEAN_SHAPE,
)
LEGEND = {
    ON_CLIP: "our model `human`, trained on 2D projections of motion capture; input: the "
    "detections of the clip (OpenPose BODY_25B, the largest person), frame by frame",
    ON_MEDIAPIPE: "the same model; input: the 2D landmarks of MediaPipe in the videos, "
    "smoothed over time by MediaPipe",
    WITH_INTRINSICS.strip(", "): "the same with the camera's intrinsics (`camera_info`), "
    "which MediaPipe does not take",
    WORLD: "world landmarks of MediaPipe Pose 0.10.14, trained with 3D labels; input: "
    "the images; smoothed over time by MediaPipe",
    MEAN_SHAPE: "one rigid shape, the mean of the motion capture that `human` was trained on; "
    "with the rotation and scale that fit the truth of each frame best",
}


def benchmark(session: Session) -> Table:
    """Return the table of errors of each system for each camera and their mean."""
    balancing, standing, pixels = scenes(session.output)
    lifter = Lifter(load_model(find_model("human", model_folders(session.output / "models"))))
    mean = mean_person(session.data / "cmu", session.subjects, MEAN_STRIDE * session.stride)
    trials = {
        "balancing": "100 frames; the truth is triangulated from the detections that come with the "
        f"clip ({pixels[0]:.1f} px mean reprojection error), refined as in the demo",
        "standing": "11 frames; the detections that come with the clip are synthetic, so the truth "
        f"is triangulated from MediaPipe's 2D ({pixels[1]:.1f} px), with its definition of joints",
    }
    scope = {"scope": "one person, one room, one clip: figures of these four views, no more"}
    table = Table(
        "mediapipe_comparison",
        "One person seen by four cameras, 12 limb joints",
        ("trial", "system", "camera"),
        tuple(FIGURES),
        {**LEGEND, **trials, **FIGURES, **scope},
        draw,
    )
    for trial, views in zip(trials, (balancing, standing), strict=True):
        for system in SYSTEMS:
            rows = [figures(system, view, lifter, mean) for view in views]
            for view, row in zip(views, rows, strict=True):
                if row:
                    table.add((trial, system, view.camera), row)
            if rows[0]:
                means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
                table.add((trial, system, "mean"), means)
    return table


def figures(system: str, scene: Scene, lifter: Lifter, mean: Floats) -> dict[str, float]:
    """Return the FIGURES of a system, none if it has nothing to go by.

    mean: (12, 3) the mean shape.
    """
    mediapipe, detections, truth = scene.mediapipe, scene.detections, scene.truth
    if system == MEAN_SHAPE:
        row = scores(np.broadcast_to(mean, truth.shape), truth)
        return {name: row[name] for name in ("frames", "PA mm")}
    intrinsics = scene.intrinsics if system.endswith(WITH_INTRINSICS) else None
    if system == WORLD:
        shapes, seconds = mediapipe.world[:, LIMBS], mediapipe.seconds
    elif system.startswith(ON_MEDIAPIPE):
        shapes, seconds = lift(
            lifter, MEDIAPIPE33, mediapipe.points, mediapipe.confidence, intrinsics
        )
    elif detections is not None:
        shapes, seconds = lift(
            lifter, BODY25B, detections.points, detections.confidence, intrinsics
        )
    else:
        return {}
    row = scores(shapes, truth) | {"ms": 1e3 * float(np.median(seconds))}
    return row if detections is not None else row | {"jitter deg": jitter(shapes)}


def scores(shapes: Floats, truth: Floats) -> dict[str, float]:
    """Return the errors of shapes (f, 12, 3) against the truth (f, 12, 3)."""
    valid = np.isfinite(shapes).all((1, 2)) & np.isfinite(truth).all((1, 2))
    error = camera_errors(shapes[valid], truth[valid])
    return {
        "frames": float(valid.sum()),
        "PA mm": error.aligned,
        "camera mm": error.in_camera,
        "rotation deg": error.rotation,
        "mirrored %": 100 * error.mirrored,
    }


def lift(
    lifter: Lifter,
    detector: KeypointLayout,
    points: Floats,
    confidence: Floats,
    intrinsics: Intrinsics | None,
) -> tuple[Floats, Floats]:
    """Return the shapes (f, 12, 3) of detections as the node lifts them, and the seconds.

    intrinsics: of the camera, if the lifter is told.
    """
    values = np.concatenate([points, confidence[..., None]], -1)
    layout = lifter.model.layout
    valid = to_observation(values, InputOptions().min_confidence)
    mapped = zip(*KeypointMap(detector, layout)(valid.points, valid.confidence), strict=True)
    shapes, seconds = [], []
    for keypoints in mapped:
        begin = time.perf_counter()
        frame = keypoints[0][None], keypoints[1][None]
        lifted = lift_perspective(lifter, intrinsics, *frame) if intrinsics else lifter(*frame)
        shapes.append(lifted.shapes[0])
        seconds.append(time.perf_counter() - begin)
    places = [layout.index(joint) for joint in JOINTS]
    return np.stack(shapes)[:, places], np.array(seconds)


def jitter(shapes: Floats) -> float:
    """Return the median angle, in degrees, from each shape of (f, p, 3) to the next."""
    S = centre(shapes[np.isfinite(shapes).all((1, 2))].astype(float))
    return float(np.median(rotation_angles(align(S[:-1], S[1:]).rotation)))


def mean_person(
    folder: Path, subjects: Sequence[str] = SUBJECTS, stride: int = MEAN_STRIDE
) -> Floats:
    """Return the mean shape (12, 3) of every stride-th frame of all trials of some subjects."""
    capture = read_split(TrialSelection(folder, subjects, "all", stride), HUMAN17)
    assert capture.shapes is not None
    return mean_shape(capture.shapes)[[HUMAN17.index(joint) for joint in JOINTS]]


def mean_shape(shapes: Floats) -> Floats:
    """Return the mean (p, 3) of shapes (f, p, 3), normalised in size and aligned by rotation."""
    S = centre(shapes.astype(float))
    S /= np.linalg.norm(S, axis=(1, 2), keepdims=True)
    mean: Floats = S[0]
    for _ in range(5):
        mean = align(S, np.broadcast_to(mean, S.shape)).aligned.mean(0)
    return mean


def draw(table: Table, figure: Figure) -> None:
    """Plot the means of the cameras."""
    means = copy.copy(table)
    means.rows = [row for row in table.rows if row.labels[-1] == "mean"]
    bars("PA mm", "camera mm")(means, figure)


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command."""
    run_program(benchmark, __doc__, SUBJECTS, argv)


if __name__ == "__main__":
    main()
