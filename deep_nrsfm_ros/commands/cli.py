# SPDX-License-Identifier: Apache-2.0
"""One command for all programs: `deep-nrsfm lift`, `deep-nrsfm train` and so on."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from deep_nrsfm_ros import __version__
from deep_nrsfm_ros.commands.program import Parser, called_as
from deep_nrsfm_ros.model_files.folders import PACKAGE
from deep_nrsfm_ros.similar_names import did_you_mean

PROGRAMS = {
    "demo": "lift a real person and show it on a page: a first look",
    "lift": "lift a file of 2D keypoints to 3D",
    "train": "train a model from bags of 2D keypoints",
    "evaluate": "compare models with motion capture or with real cameras",
    "models": "list the models that are installed",
    "replay": "show a recording, or a running lifter, in a browser",
    "echo": "print the points of a running lifter as numbers",
    "doctor": "check the installation and say how to mend it",
    "lifter": "run the ROS node that lifts",
}
"""Programs and what each does; a program is the module of its name in this package."""
_WIDTH = max(map(len, PROGRAMS)) + 2


def arguments() -> argparse.ArgumentParser:
    """Return the parser of what stands before the arguments of a program."""
    listed = "\n".join(f"  {name:{_WIDTH}}{line}" for name, line in PROGRAMS.items())
    parser = Parser(
        prog=_name(),
        usage="%(prog)s [-h] [--version] COMMAND ...",
        description="2D keypoints in, 3D shape and camera out, learned from 2D alone.",
        epilog=f"commands:\n{listed}\n\n%(prog)s COMMAND --help describes a command.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    parser.add_argument("command", metavar="COMMAND", help="one of the commands below")
    rest = parser.add_argument("rest", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    rest.required = False  # else the error of a missing command would name it too
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    """Run the program that the first argument names; only its module is imported.

    Args:
        argv: name of the program and its arguments; None: those of the process.
    """
    parser = arguments()
    args = parser.parse_args(argv)
    if args.command not in PROGRAMS:
        hint = did_you_mean(args.command, PROGRAMS) or f"choose one of {', '.join(PROGRAMS)}"
        parser.error(f"there is no command {args.command!r}; {hint}")
    called_as(f"{parser.prog} {args.command}")
    module = importlib.import_module(f"deep_nrsfm_ros.commands.{args.command}")
    module.main(args.rest)


def _name() -> str:
    """Return how the command was called, for its usage."""
    return f"python -m {PACKAGE}" if Path(sys.argv[0]).name == "__main__.py" else "deep-nrsfm"


if __name__ == "__main__":
    main()
