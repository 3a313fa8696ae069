"""What all programs have in common."""

from __future__ import annotations

import functools
import signal
import sys
from collections.abc import Callable, Sequence

Main = Callable[[Sequence[str] | None], None]


def program(main: Main) -> Callable[..., None]:
    """Let a program end silently, as others do, when nobody reads on: `models | head`.

    Python would ignore SIGPIPE and raise BrokenPipeError wherever something is printed, at its
    own end too.
    """

    @functools.wraps(main)
    def run(argv: Sequence[str] | None = None) -> None:
        before = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        try:
            main(argv)
        finally:
            sys.stdout.flush()  # what is left would be flushed when the signal is ignored again
            signal.signal(signal.SIGPIPE, before)

    return run
