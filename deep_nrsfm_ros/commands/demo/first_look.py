# SPDX-License-Identifier: Apache-2.0
"""Lift a real person, seen by four cameras one at a time, and write a page that shows it.

The clip is part of the package: 2D keypoints of a detector, images, and ground truth to compare
with. The keypoints of each camera are written as a file too, to try `lift` and `train` on. With
--node they take the way of a robot: they are played over DDS to the lifter, its answers are
recorded, and a model is trained on the recording by the lifter's service.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.commands.program import Parser, program, program_name
from deep_nrsfm_ros.data.cameras import Array
from deep_nrsfm_ros.data.clip import STANDING, Clip, read_clip
from deep_nrsfm_ros.data.detections import gather, stamps_at
from deep_nrsfm_ros.data.over_time import OverTime
from deep_nrsfm_ros.data.pose2sim import JOINTS, RATE, View
from deep_nrsfm_ros.data.recording import lift_recording
from deep_nrsfm_ros.extras import is_installed, require_extra
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25B
from deep_nrsfm_ros.lifting.lifter import Lifter
from deep_nrsfm_ros.lifting.observation import Observation
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.model_files.folders import default_models_dir, model_folders
from deep_nrsfm_ros.model_files.model_file import Model, find_model, load_model
from deep_nrsfm_ros.nrsfm.recipe import AUTOMATIC
from deep_nrsfm_ros.reporting.stage import Stage, make_stage, stage_page

TORSO = 0.5
"""Metres from the neck to the middle of the hips that the demo assumes of the person."""
PAGE, PICTURE, STANDING_PAGE = "demo.html", "demo.png", "standing.html"
_TITLE = "A person in 3D, from one camera at a time"
_NOTES = (
    f"place and size from the camera's intrinsics and an assumed torso of {TORSO} m; "
    "nothing is fitted to the ground truth",
)
_STANDING_NOTES = (
    *_NOTES,
    "keypoints by MediaPipe; the ground truth is triangulated from them",
    "the lifter is given the direction of gravity, as by TF or an IMU",
)
_UP = np.array([0.0, 0.0, 1.0])  # against gravity, in the world of the clips


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(prog=program_name("demo"), description=__doc__)
    parser.add_argument(
        "--output", type=Path, default=Path("demo_output"), help="folder of the results"
    )
    parser.add_argument(
        "--model",
        default="human",
        help="model to lift with: a name or a path; your own are found as by `lift`",
    )
    parser.add_argument(
        "--node",
        action="store_true",
        help="play the keypoints over DDS to the lifter node, and train on the recording; needs "
        "the extras ros and train",
    )
    parser.add_argument(
        "--train-steps",
        type=int,
        default=AUTOMATIC,
        help="training steps; -1 = as many as `train` takes, 0 = no training",
    )
    return parser


def say(text: str) -> None:
    """Print a step of the demo without buffering."""
    print(f"- {text}", flush=True)


def model_file(name: str, output: Path) -> Path:
    """Return the file of a model: of an earlier demo, the user's own, or of the package.

    Raises:
        ValueError: it is not there.
    """
    return find_model(name, [output / "models", *model_folders(default_models_dir())])


def read_model(name: str, output: Path) -> Model:
    """Return the model of the demo.

    Raises:
        ValueError: it is not there, damaged, or lacks a joint of the ground truth.
    """
    model = load_model(model_file(name, output))
    if lacking := [joint for joint in JOINTS if joint not in model.layout.keypoints]:
        raise ValueError(f"model {model.name!r} lifts no person: it has no {lacking[0]}")
    return model


def lift_view(
    view: View, model: Model, layout: KeypointLayout = BODY25B, up: Array | None = None
) -> NDArray[np.floating]:
    """Return the lifted points (f, p, 3) of one camera in its optical frame, in metres.

    Args:
        view: what the camera saw.
        model: lifts it.
        layout: of the view's keypoints.
        up: (3,) direction against gravity in the camera's axes; None: unknown.
    """
    frames = [
        Observation(view.points[i : i + 1], view.confidence[i : i + 1])
        for i in range(len(view.points))
    ]
    detections = gather(
        frames,
        stamps_at(RATE, len(frames)),
        len(layout),
        view.camera.name,
        ["person"] * len(frames),
    )
    lifter = Lifter(model, LiftingOptions(reference_length=TORSO))
    recording = lift_recording(
        detections, layout, lifter, intrinsics=view.camera.intrinsics, over_time=OverTime(up=up)
    )
    shapes: NDArray[np.floating] = recording.lifted.shapes
    return shapes


def write_keypoints(clip: Clip, output: Path) -> None:
    """Write a file of keypoints for each camera, as `lift` and `train` read it, and name them."""
    output.mkdir(parents=True, exist_ok=True)
    files = [output / f"{view.camera.name}.npz" for view in clip.session.views]
    for file, view in zip(files, clip.session.views, strict=True):
        names = np.array(BODY25B.keypoints)
        stamps = stamps_at(RATE, len(view.points))
        np.savez_compressed(
            file, points=view.points, confidence=view.confidence, names=names, stamps=stamps
        )
    say(f"keypoints of each camera, to try `lift` and `train` on: {files[0]} to {files[-1].name}")


def show(stage: Stage, output: Path) -> str:
    """Write page and picture of a stage; return a sentence that names the page.

    The page links to that of the person who stands, where there is one.
    """
    output.mkdir(parents=True, exist_ok=True)
    page = output / PAGE
    links = {"the same person, standing": STANDING_PAGE}
    if not (output / STANDING_PAGE).exists():
        links = {}
    page.write_text(stage_page(stage, _TITLE, _NOTES, links), encoding="utf-8")
    if is_installed("PIL"):
        from deep_nrsfm_ros.reporting.stage_image import draw_picture

        draw_picture(stage, output / PICTURE)
        say(f"picture: {output / PICTURE}")
    else:
        say("no picture, as Pillow is not installed: pip install pillow")
    said = f"page, for any browser: {page.absolute().as_uri()}"
    say(said)
    return said


def run(args: argparse.Namespace) -> None:
    """Lift the clip without ROS.

    Raises:
        ValueError: the model cannot be used.
        OSError: a file cannot be written.
    """
    model, clip = read_model(args.model, args.output), read_clip()
    truth, _ = clip.session.pixels
    say(
        f"{len(clip.session.views)} cameras saw a person for {len(clip.session.world) / RATE:.1f} "
        f"s; the ground truth is triangulated from all of them ({truth:.1f} px off on average)"
    )
    stage = stage_of(clip, model, [lift_view(view, model) for view in clip.session.views])
    for view in stage.views:
        say(
            f"{view.name}: {view.lifted.sum()} of {len(view.lifted)} frames lifted; joints are "
            f"{view.error.aligned:.0f} mm off after alignment, the rotation "
            f"{view.error.rotation:.0f} degrees"
        )
    write_keypoints(clip, args.output)
    write_standing(model, args.output)
    show(stage, args.output)


def write_standing(model: Model, output: Path) -> None:
    """Lift the person who stands, write the page of it, and say how far the joints are off."""
    clip = read_clip(STANDING)
    lifted = [
        lift_view(view, model, clip.layout, view.camera.rotation @ _UP)
        for view in clip.session.views
    ]
    stage = stage_of(clip, model, lifted)
    off = [f"{view.error.aligned:.0f}" for view in stage.views]
    output.mkdir(parents=True, exist_ok=True)
    page = stage_page(stage, f"{_TITLE}: standing", _STANDING_NOTES, {"balancing": PAGE})
    (output / STANDING_PAGE).write_text(page, encoding="utf-8")
    say(
        f"the same person standing, {len(clip.session.world)} frames: joints are {', '.join(off)} "
        f"mm off by camera; the page links to {STANDING_PAGE}"
    )


def stage_of(clip: Clip, model: Model, lifted: Sequence[NDArray[np.floating]]) -> Stage:
    """Return the stage of the clip with its lifted points (f, p, 3) of each camera."""
    return make_stage(clip.session, clip.images, clip.layout, model.layout, lifted)


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Run the demo; exit with 1 on an error, with 130 when interrupted."""
    args = arguments().parse_args(argv)
    try:
        if not args.node:
            run(args)
            return
        require_extra("ros", "demo --node")
        if args.train_steps:
            require_extra("train", "training")
        from deep_nrsfm_ros.commands.demo import over_dds

        over_dds.launch(over_dds.run, args)
    except (OSError, ValueError) as error:
        sys.exit(f"demo: {error}")
