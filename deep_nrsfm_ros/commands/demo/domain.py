# SPDX-License-Identifier: Apache-2.0
"""A DDS domain for demos, benchmarks and tests that run on one machine at the same time."""

from __future__ import annotations

import fcntl
import random
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

_DOMAINS = range(1, 102)  # 0 is the default; above 101 ports are taken from those of the system
_KEPT = ExitStack()


@contextmanager
def own_domain() -> Iterator[int]:
    """Give a random DDS domain that nothing else on this machine was given, within the context.

    Raises:
        OSError: all domains are taken.
    """
    for number in random.sample(_DOMAINS, len(_DOMAINS)):
        path = Path(tempfile.gettempdir()) / f"ros_domain_{number}.lock"
        try:
            lock = path.open("w")
        except PermissionError:  # of another user
            continue
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield number
            return
    raise OSError("all DDS domains from 1 to 101 are taken by other demos on this machine")


def take_domain() -> int:
    """Return a domain as `own_domain` gives it, taken until this process ends."""
    return _KEPT.enter_context(own_domain())
