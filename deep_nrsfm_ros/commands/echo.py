# SPDX-License-Identifier: Apache-2.0
"""Print the points of a running lifter as numbers: identity, keypoint, x, y, z and confidence."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from deep_nrsfm_ros.commands.program import Parser, program, program_name
from deep_nrsfm_ros.extras import require_extra

_LIFTER = "/lifter"
_RATE = 1.0


def arguments() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(prog=program_name("echo"), description=__doc__)
    parser.add_argument(
        "--keypoint",
        action="append",
        default=[],
        metavar="NAME",
        help="keypoint of the model to print, such as left_wrist; may be given several times "
        "(default: all)",
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=_RATE,
        help="messages a second at most; 0 = all (default: %(default)g)",
    )
    parser.add_argument("--once", action="store_true", help="end after one message")
    parser.add_argument(
        "--lifter", default=_LIFTER, help="name of the running lifter (default: %(default)s)"
    )
    return parser


def echo(args: argparse.Namespace) -> str:
    """Print until Ctrl-C, or one message; return what is wrong, or ""."""
    require_extra("ros", "echo")
    import rclpy  # imported here so that --help needs no ROS
    from rclpy.signals import SignalHandlerOptions

    from deep_nrsfm_ros.node.points_text import PointsText
    from deep_nrsfm_ros.node.shutdown import shut_down

    lifter = args.lifter.rstrip("/")
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # its own ones break a call
    try:
        node = rclpy.create_node("points_text")
        text = PointsText(
            node, lifter, args.keypoint, args.rate, lambda text: print(text, flush=True)
        )
        print(f"waiting for {node.resolve_topic_name(f'{lifter}/points')}", file=sys.stderr)
        while not (text.problem or (args.once and text.written)):
            rclpy.spin_once(node, timeout_sec=0.1)
        return text.problem
    except KeyboardInterrupt:
        return ""
    finally:
        shut_down()


@program
def main(argv: Sequence[str] | None = None) -> None:
    """Print the points; exit with 2 if the lifter has not what is asked for."""
    args = arguments().parse_args(argv)
    try:
        if not 0 <= args.rate < float("inf"):
            raise ValueError(f"--rate is {args.rate:g}; it must be at least 0, 0 = all messages")
        if problem := echo(args):
            raise ValueError(problem)
    except ValueError as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
