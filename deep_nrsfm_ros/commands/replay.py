# SPDX-License-Identifier: Apache-2.0
"""Show a recording, or a running lifter, in a browser: 2D keypoints beside 3D skeletons."""

from __future__ import annotations

import argparse
import math
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from deep_nrsfm_ros.commands.lift import (
    add_reading_arguments,
    lift_objects,
    progress,
    read_model,
    read_objects,
    summary_of,
    warn,
)
from deep_nrsfm_ros.commands.program import Parser, program, program_name
from deep_nrsfm_ros.configuration import options, override
from deep_nrsfm_ros.data.bag_files import BagError
from deep_nrsfm_ros.data.detections import Detections
from deep_nrsfm_ros.data.keypoint_files import KINDS, is_bag
from deep_nrsfm_ros.data.lifted_bags import has_lifted_messages, read_lifted_messages
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.data.recording import Recording, join_lifted_messages
from deep_nrsfm_ros.extras import require_extra
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.lifting.options import FieldOfViewOptions, LiftingOptions
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.reporting.player import (
    MOST_FRAMES,
    SceneTransform,
    live_page,
    recording_page,
    scenes,
)
from deep_nrsfm_ros.reporting.serving import HOST, Broadcast, in_real_time, server

_PORT = 8765
_LIFTER = "/lifter"
_DIAGNOSTICS_WAIT = 5.0  # seconds; a lifter sends them once a second


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(prog=program_name("replay"), description=__doc__)
    parser.add_argument(
        "input",
        type=Path,
        nargs="?",
        metavar="BAG",
        help=f"recording: {KINDS}. Lifted points in a bag are shown as recorded; keypoints alone "
        "are lifted. Without a recording, --serve shows the running lifter",
    )
    out = parser.add_argument_group("Output")
    out.add_argument("--html", type=Path, help="HTML page to write; it needs no network")
    out.add_argument(
        "--serve",
        action="store_true",
        help="serve a page to this machine, at the rate of the recording or of the lifter",
    )
    out.add_argument(
        "--port",
        type=int,
        help=f"port of the served page; 0 = a free port (default: {_PORT})",
    )
    out.add_argument(
        "--max-frames",
        type=int,
        help=f"most frames in --html; a longer recording is subsampled (default: {MOST_FRAMES})",
    )
    out.add_argument(
        "--lift-again",
        action="store_true",
        help="lift the keypoints again instead of showing the lifted points of the bag",
    )
    out.add_argument("--lifter", help=f"name of the running lifter (default: {_LIFTER})")
    add_reading_arguments(parser)
    return parser


def given_options(args: argparse.Namespace, cls: type) -> list[str]:
    """Return the options of a dataclass that are on the command line, as they are written."""
    return ["--" + f.name.replace("_", "-") for f, _, _ in options(cls) if f.name in args]


def check_output_options(args: argparse.Namespace) -> None:
    """Raise ValueError for an option that would have no effect, and say why."""
    live = args.input is None
    for name, value, needs, has_effect in (
        ("--port", args.port, "--serve", args.serve),
        ("--max-frames", args.max_frames, "--html", args.html),
        ("--lifter", args.lifter, "a running lifter, not a recording", live),
        ("--intrinsics", args.intrinsics or None, "a recording", not live),
        ("--lift-again", args.lift_again or None, "a recording", not live),
        ("--mapping", args.mapping or None, "a recording", not live),
    ):
        if value is not None and not has_effect:
            raise ValueError(f"{name} has no effect here: it needs {needs}")
    if not live:
        return
    unused = [option for option in given_options(args, ReadOptions) if option != "--topic"]
    unused += given_options(args, FieldOfViewOptions)
    unused += ["--objects"] * (args.objects != "all") + ["--rectified"] * args.rectified
    if unused:
        raise ValueError(f"{', '.join(unused)} has no effect here: it needs a recording")
    if unused := given_options(args, LiftingOptions):
        raise ValueError(
            f"{', '.join(unused)} has no effect on a running lifter: set its parameters instead"
        )


def read_recording(
    args: argparse.Namespace, model: Model, layout: KeypointLayout | None
) -> tuple[Recording, str]:
    """Return the recording, and the origin of its shapes as text.

    Raises:
        ValueError: the input does not exist or is not usable.
    """
    if not args.input.exists():
        raise ValueError(f"{args.input} does not exist")
    if args.lift_again or not is_bag(args.input) or not has_lifted_messages(args.input):
        detections, source, findings = read_objects(args, model, layout)
        recording = lift_objects(args, model, source, detections)
        for finding in summary_of(args, model, recording, findings).findings:
            warn(str(finding))
        return recording, f"lifted with model {model.name}"
    unused = given_options(args, FieldOfViewOptions) + given_options(args, LiftingOptions)
    if unused:
        raise ValueError(
            f"{', '.join(unused)} has no effect on the lifted points of a bag, which are shown as "
            "recorded: add --lift-again, or leave it out"
        )
    with progress("reading lifted points") as on_progress:
        lifted = read_lifted_messages(args.input, on_progress, warn)
    try:
        recorded: Detections | None
        recorded, source, _ = read_objects(args, model, layout)
    except BagError as error:
        warn(f"showing the lifted points without keypoints: {error}")
        recorded, source = None, layout or model.layout
    recording = join_lifted_messages(lifted, recorded, source, model.layout)
    frame = recording.fixed_frame and f" in {recording.fixed_frame}, z up"
    return recording, f"as recorded{frame}; drawn as model {model.name}"


def serve(page: str, port: int | None, work: Callable[[Broadcast, threading.Event], None]) -> None:
    """Serve a page until Ctrl-C.

    Args:
        page: HTML.
        port: 0 = a free port; None = the usual one.
        work: puts frames into the broadcast; it may return before Ctrl-C.
    """
    broadcast, stop = Broadcast(), threading.Event()
    # `program` lets SIGPIPE end the process; a browser that disconnects must not end the server.
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    with server(page, broadcast, _PORT if port is None else port) as made:
        threading.Thread(target=made.serve_forever, daemon=True).start()
        print(f"http://{HOST}:{made.server_port}/ (Ctrl-C ends it)", flush=True)
        try:
            work(broadcast, stop)
            broadcast.end()
            while not stop.wait(
                0.5
            ):  # an unbounded wait would miss a signal that arrives before it
                pass
        except KeyboardInterrupt:
            pass
        finally:
            broadcast.end()
            made.shutdown()


def live_layout(lifter: str, said: str, model: Model) -> KeypointLayout:
    """Return the layout of the keypoints of a running lifter, and warn where it is not known.

    Args:
        lifter: name of the node.
        said: name of the layout as the lifter's diagnostics give it.
        model: whose layout is taken where the lifter's is not known.
    """
    if layout := {**LAYOUTS, model.layout.name: model.layout}.get(said):
        return layout
    warn(
        f"{lifter} uses the layout {said!r}, which is no preset: its keypoints are drawn in the "
        f"order of {model.layout.name}; name their order with --keypoint-layout if they look wrong"
    )
    return model.layout


def watch(args: argparse.Namespace, model: Model, layout: KeypointLayout | None) -> None:
    """Serve the frames of the running lifter; needs ROS."""
    require_extra("ros", "replay without a BAG")
    import rclpy  # imported here because recordings need no ROS
    from rclpy.executors import ExternalShutdownException

    from deep_nrsfm_ros.node.lifter_client import LifterClient, LifterTopics, running_layout
    from deep_nrsfm_ros.node.shutdown import shut_down

    lifter = args.lifter or _LIFTER
    if layout is None:
        said = running_layout(lifter, _DIAGNOSTICS_WAIT)
        if not said:
            warn(f"waiting for {lifter}: does it run? --lifter names another one")
        layout = live_layout(lifter, said or running_layout(lifter, math.inf), model)
    source = layout
    inputs, transform = override(InputOptions(), args), SceneTransform()

    def work(broadcast: Broadcast, stop: threading.Event) -> None:
        def show(recording: Recording) -> None:
            for scene in scenes(recording, transform=transform):
                broadcast.put(scene)

        rclpy.init()
        try:
            topic = override(ReadOptions(), args).topic
            layouts = (source, model.layout)
            limits = (inputs.min_confidence, inputs.image_size)
            topics = LifterTopics(lifter, topic, *layouts, *limits)
            rclpy.spin(LifterClient(topics, show))
        except ExternalShutdownException:
            raise KeyboardInterrupt from None
        finally:
            shut_down()

    serve(live_page(source, model.layout, f"live: {lifter}"), args.port, work)


def play(args: argparse.Namespace, recording: Recording, origin: str) -> None:
    """Serve a recording at its own rate."""
    source, target = recording.source, recording.target

    def work(broadcast: Broadcast, stop: threading.Event) -> None:
        in_real_time(scenes(recording), broadcast.put, stop.wait)

    serve(live_page(source, target, f"{args.input.name}, {origin}"), args.port, work)


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Write or serve the page; exit with 2 if the input is not usable."""
    args = arguments().parse_args(argv)
    try:
        if not args.html and not args.serve:
            raise ValueError("no output chosen: give --html FILE, --serve, or both")
        check_output_options(args)
        model, layout = read_model(args)
        if args.input is None:
            if args.html:
                raise ValueError(
                    "--html needs a BAG: record one, or show the running lifter with --serve"
                )
            watch(args, model, layout)
            return
        recording, origin = read_recording(args, model, layout)
        if args.html:
            frames = MOST_FRAMES if args.max_frames is None else args.max_frames
            page = recording_page(recording, args.input.name, [origin], frames)
            args.html.write_text(page, encoding="utf-8")
            size = args.html.stat().st_size / 1e6
            print(f"{args.html}: {size:.1f} MB, open it in a browser")
        if args.serve:
            play(args, recording, origin)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
