# SPDX-License-Identifier: Apache-2.0
"""Run the lifter, the ROS node that lifts keypoints and trains models, with ROS arguments."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence

_USAGE = """usage: {program} [--ros-args ...]

{description}
Parameters: {program} --ros-args -p NAME:=VALUE; docs/reference/parameters.md lists them."""


def main(argv: Sequence[str] | None = None) -> None:
    """Run the node until SIGINT or SIGTERM.

    Exit code 2 says that rclpy is not installed, or that an argument is none of ROS.

    Args:
        argv: arguments of the program; None: those of the process.
    """
    # The imports take a second. A signal that comes meanwhile ends the process at once.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))

    from deep_nrsfm_ros.commands.program import program_name
    from deep_nrsfm_ros.extras import MissingExtraError, require_extra

    words = sys.argv[1:] if argv is None else list(argv)
    if words and words[0] in ("-h", "--help"):
        print(_USAGE.format(program=program_name("lifter"), description=__doc__))
        return
    if unknown := _outside_ros_args(words):
        print(
            f"failed: {' '.join(unknown)!r} has no effect: give parameters as "
            f"{program_name('lifter')} --ros-args -p NAME:=VALUE",
            file=sys.stderr,
        )
        sys.exit(2)
    try:
        require_extra("ros", "the lifter node")
    except MissingExtraError as error:
        print(f"failed: {error}", file=sys.stderr)
        sys.exit(2)

    from deep_nrsfm_ros.node.lifter import main as run

    sys.argv[1:] = words  # rclpy reads the arguments of the process
    run()


def _outside_ros_args(words: Sequence[str]) -> list[str]:
    """Return the words that ROS ignores: those not between `--ros-args` and `--`, or the end."""
    outside, of_ros = [], False
    for word in words:
        if word in ("--ros-args", "--"):
            of_ros = word == "--ros-args"
        elif not of_ros:
            outside.append(word)
    return outside


if __name__ == "__main__":
    main()
