"""Lift a file of 2D keypoints to 3D, without ROS: npz, JSON or bag in, npz, JSON or bag out."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from deep_nrsfm_ros.commands.program import program, program_name
from deep_nrsfm_ros.configuration import add_arguments, override
from deep_nrsfm_ros.data.camera_file import read_camera_file
from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.keypoint_files import KINDS, read_keypoints
from deep_nrsfm_ros.data.lifted_files import check_output, write_recording
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.recording import Recording, lift_recording
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.lifter import Lifter, LiftingOptions
from deep_nrsfm_ros.messages.mapping_file import read_mapping
from deep_nrsfm_ros.messages.pipeline import MODEL_ORDER, InputOptions
from deep_nrsfm_ros.model_files.find_layout import find_layout
from deep_nrsfm_ros.model_files.model_file import Model, load_model


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog=program_name("lift"), description=__doc__)
    parser.add_argument("input", type=Path, help=f"keypoints: {KINDS}")
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        help="what to write, by its suffix: .npz, .json, or a bag (a name without suffix)",
    )
    add_reading_arguments(parser)
    return parser


def add_reading_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of reading keypoints and of lifting."""
    parser.add_argument(
        "--mapping",
        default="",
        help="field mapping (.yaml) for messages in a bag of a type not known here",
    )
    parser.add_argument(
        "--objects",
        default="all",
        choices=("all", "largest"),
        help="lift all objects of a frame, or the largest in the image of those with at least half "
        "of the best score (default: %(default)s)",
    )
    parser.add_argument(
        "--intrinsics",
        default="",
        metavar="FILE",
        help="CameraInfo of the camera (.yaml, as `ros2 topic echo --once` or camera calibration "
        "writes it): objects come out at their place before it",
    )
    parser.add_argument(
        "--rectified",
        action="store_true",
        help="the keypoints are those of the rectified image, to which CameraInfo's P belongs",
    )
    add_arguments(parser, ReadOptions)
    add_arguments(parser, InputOptions, without=("input_type", "topics"))
    add_arguments(parser, LiftingOptions)


def read_model(args: argparse.Namespace) -> tuple[Model, KeypointLayout | None]:
    """Return the model, and the layout that the user names for the keypoints; None = no layout.

    Raises:
        ValueError: the model or the layout is missing.
    """
    inputs = override(InputOptions(), args)
    model = load_model(inputs.model, Path(inputs.models_dir).expanduser())
    if inputs.keypoint_layout == MODEL_ORDER:
        return model, None
    return model, find_layout("--keypoint-layout", inputs.keypoint_layout)


def read_objects(
    args: argparse.Namespace, model: Model, layout: KeypointLayout | None
) -> tuple[Detections, KeypointLayout]:
    """Return the objects in the input, and the layout of their keypoints.

    Args:
        args: the command line.
        model: its layout is that of an input that does not name its keypoints.
        layout: as the user names it; None = that of the input or of the model.

    Raises:
        ValueError: the input cannot be read, or has other keypoints than the layout.
    """
    inputs = override(InputOptions(), args)
    options = dataclasses.replace(
        override(ReadOptions(), args),
        min_confidence=inputs.min_confidence,
        mapping=read_mapping(Path(args.mapping).expanduser()) if args.mapping else None,
        image_size=inputs.image_size,
        layout=layout,
        fallback=model.layout,
    )
    with progress("reading") as on_progress:
        detections = read_keypoints(args.input, options, on_progress)
    for warning in detections.warnings:
        warn(warning)
    chosen = detections.largest() if args.objects == "largest" else detections
    return chosen, detections.layout or model.layout


def lift_objects(
    args: argparse.Namespace, model: Model, source: KeypointLayout, detections: Detections
) -> Recording:
    """Return the recording of the objects, lifted with the options of the command line."""
    lifter = Lifter(model, override(LiftingOptions(), args))
    file = Path(args.intrinsics).expanduser()
    intrinsics = read_camera_file(file, rectified=args.rectified) if args.intrinsics else None
    with progress("lifting") as on_progress:
        return lift_recording(detections, source, lifter, on_progress, intrinsics)


@contextmanager
def progress(label: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows, on a terminal, how many of how many are done."""
    with tqdm(desc=label, disable=None, leave=False, file=sys.stderr) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def warn(message: str) -> None:
    """Print a warning on standard error."""
    tqdm.write(f"warning: {message}", file=sys.stderr)


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Write the lifted objects; exit code 2 says that the input was at fault."""
    args = arguments().parse_args(argv)
    try:
        check_output(args.output)
        model, layout = read_model(args)
        detections, source = read_objects(args, model, layout)
        recording = lift_objects(args, model, source, detections)
        write_recording(args.output, recording, model.name)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    lifted, total = recording.is_lifted.sum(), len(recording.detections)
    frames = len(recording.detections.stamps)
    print(f"{args.output}: {lifted} of {total} objects in {frames} frames lifted")
    if lifted < total:
        warn(f"{total - lifted} objects have too few detected keypoints, or all on one line")


if __name__ == "__main__":
    main()
