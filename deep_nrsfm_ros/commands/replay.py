"""Look at a recording, or at a lifter at work, in a browser: 2D keypoints beside 3D skeletons."""

from __future__ import annotations

import argparse
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
    warn,
)
from deep_nrsfm_ros.commands.program import program, program_name
from deep_nrsfm_ros.configuration import override
from deep_nrsfm_ros.data.bag_files import BagError
from deep_nrsfm_ros.data.keypoint_files import KINDS, is_bag
from deep_nrsfm_ros.data.lifted_bags import has_lifted_messages, read_lifted_messages
from deep_nrsfm_ros.data.recording import Recording, join_lifted_messages
from deep_nrsfm_ros.extras import require_extra
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.messages.pipeline import InputOptions
from deep_nrsfm_ros.model_files.model_file import Model
from deep_nrsfm_ros.reporting.player import (
    MOST_FRAMES,
    Stage,
    live_page,
    recording_page,
    scenes,
)
from deep_nrsfm_ros.reporting.serving import HOST, Broadcast, in_real_time, server


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog=program_name("replay"), description=__doc__)
    parser.add_argument(
        "input",
        type=Path,
        nargs="?",
        metavar="BAG",
        help=f"recording: {KINDS}. A lifter's answers in a bag are shown as they are; keypoints "
        "alone are lifted. Without one, --serve shows the lifter that runs",
    )
    out = parser.add_argument_group("What to do with it")
    out.add_argument("--html", type=Path, help="page to write; it opens offline")
    out.add_argument(
        "--serve", action="store_true", help="show it as it happens, on a page of this machine"
    )
    out.add_argument(
        "--port", type=int, default=8765, help="of that page; 0: a free one (default: %(default)s)"
    )
    out.add_argument(
        "--max-frames",
        type=int,
        default=MOST_FRAMES,
        help="of a longer recording --html shows every n-th frame (default: %(default)s)",
    )
    out.add_argument(
        "--lift-again", action="store_true", help="do not show the answers that the bag has"
    )
    out.add_argument("--lifter", default="/lifter", help="the node to look at (default: /lifter)")
    add_reading_arguments(parser)
    return parser


def read_recording(
    given: argparse.Namespace, model: Model, source: KeypointLayout
) -> tuple[Recording, str]:
    """Return the recording, and in words where its shapes come from; raise ValueError if none."""
    if not given.input.exists():
        raise ValueError(f"{given.input} does not exist")
    if given.lift_again or not is_bag(given.input) or not has_lifted_messages(given.input):
        seen = read_objects(given, source)
        return lift_objects(given, model, source, seen), f"lifted with model {model.name}"
    with progress("reading answers") as on_progress:
        answers = read_lifted_messages(given.input, on_progress, warn)
    try:
        seen_then = read_objects(given, source)
    except BagError as error:
        warn(f"showing the answers without keypoints: {error}")
        seen_then = None
    recording = join_lifted_messages(answers, seen_then, source, model.layout)
    return recording, f"as recorded; drawn as model {model.name}"


def serve(page: str, port: int, work: Callable[[Broadcast, threading.Event], None]) -> None:
    """Serve a page while `work` puts frames into it, and after, until Ctrl-C."""
    broadcast, stop = Broadcast(), threading.Event()
    # As `program` has it, the first browser that leaves would end the server.
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    with server(page, broadcast, port) as made:
        threading.Thread(target=made.serve_forever, daemon=True).start()
        print(f"http://{HOST}:{made.server_port}/ (Ctrl-C ends it)", flush=True)
        try:
            work(broadcast, stop)
            broadcast.end()
            while not stop.wait(0.5):  # a signal just before does not end a wait without end
                pass
        except KeyboardInterrupt:
            pass
        finally:
            broadcast.end()
            made.shutdown()


def watch(given: argparse.Namespace, model: Model, source: KeypointLayout) -> None:
    """Serve what the lifter that runs answers; raise ValueError where there is no ROS."""
    require_extra("ros", "replay without a BAG")
    import rclpy  # only here: files need no ROS
    from rclpy.executors import ExternalShutdownException

    from deep_nrsfm_ros.node.lifter_client import LifterClient

    inputs, stage = override(InputOptions(), given), Stage()

    def work(broadcast: Broadcast, stop: threading.Event) -> None:
        def show(recording: Recording) -> None:
            for scene in scenes(recording, stage=stage):
                broadcast.put(scene)

        rclpy.init()
        try:
            topic = given.topic or "/keypoints"
            names = (given.lifter, topic, source, model.layout)
            rclpy.spin(LifterClient(*names, inputs.min_confidence, inputs.image_size, show))
        except ExternalShutdownException:
            raise KeyboardInterrupt from None
        finally:
            rclpy.try_shutdown()

    serve(live_page(source, model.layout, f"live: {given.lifter}"), given.port, work)


def play(given: argparse.Namespace, recording: Recording, origin: str) -> None:
    """Serve a recording at the pace at which it was made."""
    source, target = recording.source, recording.target

    def work(broadcast: Broadcast, stop: threading.Event) -> None:
        in_real_time(scenes(recording), broadcast.put, stop.wait)

    serve(live_page(source, target, f"{given.input.name}, {origin}"), given.port, work)


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Write or serve the page; exit code 2 says that the input was at fault."""
    given = arguments().parse_args(argv)
    try:
        if not given.html and not given.serve:
            raise ValueError("say what to do with it: --html FILE, --serve, or both")
        model, source = read_model(given)
        if given.input is None:
            if given.html:
                raise ValueError("--html needs a BAG; record one, or look with --serve alone")
            watch(given, model, source)
            return
        recording, origin = read_recording(given, model, source)
        if given.html:
            page = recording_page(recording, given.input.name, [origin], given.max_frames)
            given.html.write_text(page, encoding="utf-8")
            size = given.html.stat().st_size / 1e6
            print(f"{given.html}: {size:.1f} MB, open it in a browser")
        if given.serve:
            play(given, recording, origin)
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
