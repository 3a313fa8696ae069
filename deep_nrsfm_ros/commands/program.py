# SPDX-License-Identifier: Apache-2.0
"""What all programs have in common: how they end early, and their name in usages."""

from __future__ import annotations

import functools
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

Main = Callable[[Sequence[str] | None], None]

_called_as = ""


def program(main: Main) -> Callable[..., None]:
    """Return the main function of a program, with the end that a shell expects of it.

    When nobody reads its output any more (`models | head`), the program ends silently. Python
    would ignore SIGPIPE and raise BrokenPipeError wherever something is printed, at its own end
    too. Ctrl-C ends it with a word and exit code 130, without a traceback.
    """

    @functools.wraps(main)
    def run(argv: Sequence[str] | None = None) -> None:
        handler = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        try:
            main(argv)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            sys.exit(128 + signal.SIGINT)
        finally:
            sys.stdout.flush()  # output in the buffer is written while SIGPIPE still ends us
            signal.signal(signal.SIGPIPE, handler)

    return run


def called_as(name: str) -> None:
    """Set the name of the running program in usages: "deep-nrsfm lift"."""
    global _called_as
    _called_as = name


def program_name(name: str) -> str:
    """Return how the running program was called, for `prog` of its parser.

    Args:
        name: name of the program, "lift".

    Returns:
        "deep-nrsfm lift", "python -m deep_nrsfm_ros.commands.lift" or
        "ros2 run deep_nrsfm_ros lift" by the way it was started; `name` in any other case, as in
        a test.
    """
    if _called_as:
        return _called_as
    started = Path(sys.argv[0])
    folder = Path(__file__).parent
    if started in (folder / f"{name}.py", folder / name / "__main__.py"):
        return f"python -m {__package__}.{name}"
    if started.name == name and started.parent.name == "deep_nrsfm_ros":
        return f"ros2 run deep_nrsfm_ros {name}"
    return name
