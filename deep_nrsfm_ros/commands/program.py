# SPDX-License-Identifier: Apache-2.0
"""What all programs have in common: their parser, how they end early, their name in usages."""

from __future__ import annotations

import argparse
import functools
import re
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from deep_nrsfm_ros.similar_names import did_you_mean

Main = Callable[[Sequence[str] | None], None]

_called_as = ""


class Parser(argparse.ArgumentParser):
    """A parser that takes options by their whole names only, and names those that may be meant.

    Completed by argparse, `--mirror` would be `--mirrored` until there is another such option.
    """

    def __init__(self, **settings: Any) -> None:
        """Take the keyword arguments of `argparse.ArgumentParser`."""
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        """Print an error and exit with code 2."""
        if unknown := re.match(r"unrecognized arguments:.*?(--[\w-]+)", message, re.DOTALL):
            known = [option for option in self._option_string_actions if option[:2] == "--"]
            begun = [option for option in known if option.startswith(unknown[1])]
            hint = did_you_mean(unknown[1], known)
            if begun:  # as argparse would complete it
                hint = f"did you mean {' or '.join(map(repr, begun))}?"
            message += f"; {hint}" if hint else ""
        super().error(message)


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
