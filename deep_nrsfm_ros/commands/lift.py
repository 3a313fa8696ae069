# SPDX-License-Identifier: Apache-2.0
"""Lift a file of 2D keypoints to 3D, without ROS: npz, JSON or bag in, npz, JSON or bag out.

Exit code 0: nothing looks wrong, which is no proof (an object that is no person may be mirrored or
lie on its side, unseen); 2: the input or an option is at fault; 3: the answer is written, and
something about it looks wrong (--force: 0).
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from deep_nrsfm_ros.commands.lift_summary import Summary, summarise
from deep_nrsfm_ros.commands.program import Parser, program, program_name
from deep_nrsfm_ros.configuration import add_arguments, override
from deep_nrsfm_ros.data.camera_file import read_camera_file, read_image_size
from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.keypoint_files import KINDS, is_bag, read_keypoints
from deep_nrsfm_ros.data.lifted_files import check_output, write_recording
from deep_nrsfm_ros.data.over_time import CAUSAL, SMOOTH, OverTime
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.recording import Recording, lift_recording
from deep_nrsfm_ros.data.resolve_layout import check_names, resolve_layout
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.intrinsics import Intrinsics, check_field_of_view
from deep_nrsfm_ros.lifting.lifter import Lifter, check_min_visible
from deep_nrsfm_ros.lifting.options import FieldOfViewOptions, GravityOptions, LiftingOptions
from deep_nrsfm_ros.lifting.sanity import EXIT_DOUBTFUL, Finding, Size, is_person
from deep_nrsfm_ros.messages.mapping_file import read_mapping
from deep_nrsfm_ros.messages.options import AUTO, MODEL_ORDER, InputOptions
from deep_nrsfm_ros.model_files.find_layout import find_layout
from deep_nrsfm_ros.model_files.model_file import Model, load_model

_NODE_ONLY_OPTIONS = ("input_type", "topics", "bags_dir", "max_objects", "min_score")
"""Options of the node's input that mean nothing for a file."""


class Camera(NamedTuple):
    """What the options say of the camera.

    Attributes:
        intrinsics: of the camera, or of its field of view; None: not given.
        image_size: width and height of the image in pixels; None: unknown.
    """

    intrinsics: Intrinsics | None
    image_size: Size | None


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(
        prog=program_name("lift"),
        usage="%(prog)s [options] INPUT --output OUTPUT (--help lists the options)",
        description=__doc__,
    )
    parser.add_argument("input", type=Path, help=f"keypoints: {KINDS}")
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        help="what to write, by its suffix: .npz, .json, or a bag (a name without suffix)",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="end with exit code 0 even if the answer looks wrong",
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
    add_arguments(parser, FieldOfViewOptions)
    add_arguments(parser, ReadOptions)
    add_arguments(parser, InputOptions, without=_NODE_ONLY_OPTIONS)
    add_arguments(parser, LiftingOptions)
    parser.add_argument(
        "--smooth",
        default=CAUSAL,
        choices=SMOOTH,
        help="how the frames of an object help each other: causal = those so far, as in the node; "
        "both = those before and after, at three times the time; none = each frame by itself "
        "(default: %(default)s)",
    )
    add_arguments(parser, GravityOptions)


def read_model(args: argparse.Namespace) -> tuple[Model, KeypointLayout | None]:
    """Return the model, and the layout that the user names for the keypoints; None = auto.

    Raises:
        ValueError: the model or the layout is missing, or an option has no effect.
    """
    inputs = override(InputOptions(), args)
    model = load_model(inputs.model, Path(inputs.models_dir).expanduser())
    check_options(args, model)
    if inputs.keypoint_layout == AUTO:
        return model, None
    if inputs.keypoint_layout == MODEL_ORDER:
        return model, model.layout
    return model, find_layout("--keypoint-layout", inputs.keypoint_layout)


def check_options(args: argparse.Namespace, model: Model) -> None:
    """Raise ValueError for an option that would have no effect, and say why."""
    inputs, lifting = override(InputOptions(), args), override(LiftingOptions(), args)
    if bool(inputs.image_width) != bool(inputs.image_height):
        raise ValueError(
            f"--image-width is {inputs.image_width} and --image-height is {inputs.image_height}: "
            "the size of the image needs both"
        )
    if args.rectified and not args.intrinsics:
        raise ValueError("--rectified has no effect without --intrinsics: it chooses P there")
    if _field_of_view(args) and args.intrinsics:
        raise ValueError(
            "--field-of-view and --intrinsics contradict each other: leave --field-of-view out, "
            "the file says more"
        )
    if angle := _field_of_view(args):
        check_field_of_view(angle)
    check_min_visible("--min-visible", lifting.min_visible, model)
    if "noise" in args and lifting.correction == "none":
        raise ValueError("--noise has no effect with --correction none: leave one out")
    if reason := lifting.unused_height(model.layout):
        raise ValueError(f"--person-height has no effect, since {reason}")
    if lifting.test_time_mirror and model.layout.partners() is None:
        raise ValueError(
            f"--test-time-mirror has no effect on model {model.name!r}: its layout "
            f"{model.layout.name!r} has no handedness, or no pairs of left_ and right_ keypoints"
        )


def _field_of_view(args: argparse.Namespace) -> float:
    """Return the field of view of the command line in degrees; 0: unknown."""
    return override(FieldOfViewOptions(), args).field_of_view


def read_camera(args: argparse.Namespace, detections: Detections) -> Camera:
    """Return the camera of detections.

    Raises:
        ValueError: nothing says the size of its image, or the images have several sizes.
    """
    angle, given = _field_of_view(args), _camera_of_options(args)
    if (angle or given.image_size or given.intrinsics) and detections.sizes_text:
        raise ValueError(
            f"the images of {args.input} have {detections.sizes_text}, and one size, field of view "
            "or camera cannot be that of all: write a file for the images of each size, and lift "
            "each by itself"
        )
    if not angle:
        return given
    size = given.image_size or detections.image_size
    if size is None:
        raise ValueError(
            f"--field-of-view {angle:g} needs the size of the image, which {args.input} does not "
            "say: give --image-width and --image-height"
        )
    return Camera(Intrinsics.from_field_of_view(angle, size), size)


def _camera_of_options(args: argparse.Namespace) -> Camera:
    """Return what the options and the camera file say, without the field of view.

    Raises:
        ValueError: the file cannot be read or contradicts the options.
    """
    size = override(InputOptions(), args).image_size
    if not args.intrinsics:
        return Camera(None, size)
    path = Path(args.intrinsics).expanduser()
    intrinsics, own = read_camera_file(path, rectified=args.rectified), read_image_size(path)
    if size and own and size != own:
        raise ValueError(
            f"--image-width and --image-height say {size[0]} x {size[1]}, and {path} is of an "
            f"image of {own[0]} x {own[1]}: keypoints and camera must be of the same image"
        )
    return Camera(intrinsics, size or own)


class Objects(NamedTuple):
    """The objects in the input.

    Attributes:
        detections: keypoints in pixels.
        layout: of the keypoints.
        findings: what looks wrong about the layout.
    """

    detections: Detections
    layout: KeypointLayout
    findings: tuple[Finding, ...] = ()


def read_objects(args: argparse.Namespace, model: Model, layout: KeypointLayout | None) -> Objects:
    """Return the objects in the input.

    Args:
        args: the command line.
        model: lifts them.
        layout: as the user names it; None = that of the input, or the one that fits best.

    Raises:
        ValueError: the input cannot be read, has other keypoints than the layout, or is a file
            without an object.
    """
    inputs = override(InputOptions(), args)
    options = dataclasses.replace(
        override(ReadOptions(), args),
        min_confidence=inputs.min_confidence,
        mapping=read_mapping(Path(args.mapping).expanduser()) if args.mapping else None,
        image_size=_camera_of_options(args).image_size,
        layout=layout,
        fallback=None if is_person(model.layout) else model.layout,
        target=model.layout,
    )
    with progress("reading") as on_progress:
        detections = read_keypoints(args.input, options, on_progress)
    for sentence in detections.notes:
        note(sentence)
    for warning in detections.warnings:
        warn(warning)
    # A bag may be shown without its keypoints, and says how many there would be.
    if not len(detections.without_padding()) and not is_bag(args.input):
        raise ValueError(_no_object(args.input, len(detections.stamps)))
    chosen = detections.largest() if args.objects == "largest" else detections
    if detections.layout:
        names = check_names(detections.layout, model.layout, f"model {model.name!r}")
        for warning in names.warnings:
            warn(warning)
        return Objects(chosen, detections.layout, (*detections.findings, *names.findings))
    layout, reason, ambiguity = resolve_layout(chosen.without_padding(), model)
    note(f"keypoint layout {layout.name}: {reason}")
    found = (*detections.findings, *([ambiguity] if ambiguity else []))
    return Objects(chosen, layout, found)


def lift_objects(
    args: argparse.Namespace, model: Model, source: KeypointLayout, detections: Detections
) -> Recording:
    """Return the recording of the objects, lifted with the options of the command line."""
    lifter = Lifter(model, override(LiftingOptions(), args))
    intrinsics = read_camera(args, detections).intrinsics
    over_time = OverTime(args.smooth, override(GravityOptions(), args).direction)
    with progress("lifting") as on_progress:
        return lift_recording(detections, source, lifter, on_progress, intrinsics, over_time)


def summary_of(
    args: argparse.Namespace,
    model: Model,
    recording: Recording,
    findings: tuple[Finding, ...] = (),
) -> Summary:
    """Return the summary of a recording, with findings of its input.

    Raises:
        ValueError: nothing in it is lifted.
    """
    camera = read_camera(args, recording.detections)
    min_visible = override(LiftingOptions(), args).min_visible
    summary = summarise(recording, model, *camera, min_visible)
    summary = dataclasses.replace(summary, findings=(*findings, *summary.findings))
    if not summary.total:
        raise ValueError(_no_object(args.input, summary.frames))
    if not summary.lifted:
        found = "".join(f"; {finding}" for finding in summary.findings)
        raise ValueError(
            f"none of {summary.total} objects is lifted: {summary.left_out_text}{found}"
        )
    return summary


def camera_hint(args: argparse.Namespace, model: Model, detections: Detections) -> str:
    """Return what the user can say of the camera of people; "" if they say it, or have none."""
    camera = read_camera(args, detections)
    if camera.intrinsics or not is_person(model.layout):
        return ""
    known = camera.image_size or detections.image_size
    if detections.sizes_text:
        return ""
    said = (
        "hint: say the camera's field of view, even roughly, and people are lifted more "
        "accurately, at their places in metres from the camera: "
    )
    if known:
        upright = known[1] > known[0]
        usual = "45 (phones held upright)" if upright else "65 (webcams, phones held sideways)"
        return f"{said}--field-of-view {usual}"
    return (
        f"{said}--field-of-view 65 (webcams, phones held sideways) or 45 (held upright) "
        "--image-width W --image-height H, the size of the image in which the keypoints were "
        "detected"
    )


def _no_object(path: Path, frames: int) -> str:
    """Return the error text for an input without an object."""
    return f"{path} has no object in its {frames} frame{'s' * (frames != 1)}"


@contextmanager
def progress(label: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows, on a terminal, how many of how many are done."""
    with tqdm(desc=label, disable=None, leave=False, file=sys.stderr) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def note(message: str) -> None:
    """Print how the input is taken, on standard error."""
    tqdm.write(message, file=sys.stderr)


def warn(message: str) -> None:
    """Print a warning on standard error."""
    tqdm.write(f"warning: {message}", file=sys.stderr)


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Write the lifted objects and print a summary; the exit code says whether to believe it."""
    args = arguments().parse_args(argv)
    try:
        check_output(args.output)
        model, layout = read_model(args)
        detections, source, findings = read_objects(args, model, layout)
        recording = lift_objects(args, model, source, detections)
        summary = summary_of(args, model, recording, findings)
        write_recording(args.output, recording, model.name)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"{args.output}: {summary.figures_text}")
    if summary.left_out_text:
        print(f"left out: {summary.left_out_text}")
    if summary.wrong_keypoints:
        reason = "they contradict the others and count as missing"
        print(f"wrong keypoints: {summary.wrong_keypoints} of the objects ({reason})")
    if not summary.findings and (hint := camera_hint(args, model, detections)):
        note(hint)
    for finding in summary.findings:
        warn(str(finding))
    if summary.findings and not args.force:
        warn(f"something looks wrong: exit code {EXIT_DOUBTFUL} (--force: 0)")
        sys.exit(EXIT_DOUBTFUL)


if __name__ == "__main__":
    main()
