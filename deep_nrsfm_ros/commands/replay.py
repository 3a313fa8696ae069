"""Look at a recording, or at a lifter at work, in a browser: 2D keypoints beside 3D skeletons."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from deep_nrsfm_ros.commands.lift import (
    add_reading_arguments,
    lift_objects,
    progress,
    read_model,
    read_objects,
    warn,
)
from deep_nrsfm_ros.commands.program import program
from deep_nrsfm_ros.observations.answers import has_answers, read_answers
from deep_nrsfm_ros.observations.bag_files import BagError
from deep_nrsfm_ros.observations.keypoint_files import KINDS, is_bag
from deep_nrsfm_ros.observations.recording import Recording, lifted_before
from deep_nrsfm_ros.reporting.player import MOST_FRAMES, recording_page


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="replay", description=__doc__)
    parser.add_argument(
        "input",
        type=Path,
        metavar="BAG",
        help=f"recording: {KINDS}. A lifter's answers in a bag are shown as they are; keypoints "
        "alone are lifted",
    )
    parser.add_argument("--html", type=Path, required=True, help="page to write; it opens offline")
    parser.add_argument(
        "--max-frames",
        type=int,
        default=MOST_FRAMES,
        help="of a longer recording every n-th frame is shown (default: %(default)s)",
    )
    parser.add_argument(
        "--lift-again", action="store_true", help="do not show the answers that the bag has"
    )
    add_reading_arguments(parser)
    return parser


def read_recording(given: argparse.Namespace) -> tuple[Recording, str]:
    """Return the recording, and in words where its shapes come from; raise ValueError if none."""
    model, source = read_model(given)
    if not given.input.exists():
        raise ValueError(f"{given.input} does not exist")
    if given.lift_again or not is_bag(given.input) or not has_answers(given.input):
        seen = read_objects(given, source)
        return lift_objects(given, model, source, seen), f"lifted with model {model.name}"
    with progress("reading answers") as on_progress:
        answers = read_answers(given.input, on_progress, warn)
    try:
        seen_then = read_objects(given, source)
    except BagError as error:
        warn(f"showing the answers without keypoints: {error}")
        seen_then = None
    recording = lifted_before(answers, seen_then, source, model.layout)
    return recording, f"as recorded; drawn as model {model.name}"


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Write the page; exit code 2 says that the input was at fault."""
    given = arguments().parse_args(argv)
    try:
        recording, origin = read_recording(given)
        page = recording_page(recording, given.input.name, [origin], given.max_frames)
        given.html.write_text(page, encoding="utf-8")
    except (ValueError, OSError) as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"{given.html}: {given.html.stat().st_size / 1e6:.1f} MB, open it in a browser")


if __name__ == "__main__":
    main()
