# SPDX-License-Identifier: Apache-2.0
"""What a sentence calls an option: as the programs and the node do, or as Python's `train` does.

Sentences that name an option are made in several rooms, far from the caller who reads them. So the
caller is a context, as with `numpy.errstate`, and no argument of everything in between.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_IS_PYTHON = ContextVar("_IS_PYTHON", default=False)


def wording(program: str, *, python: str) -> str:
    """Return words for a sentence: `python` within `in_python`, else `program`.

    Args:
        program: names options of the command line and parameters of the node.
        python: names arguments of `train` and fields of `Recipe`; "" where there is no such one.
    """
    return python if _IS_PYTHON.get() else program


@contextmanager
def in_python() -> Iterator[None]:
    """Have the sentences of this thread name arguments of Python; also a decorator."""
    token = _IS_PYTHON.set(True)
    try:
        yield
    finally:
        _IS_PYTHON.reset(token)
