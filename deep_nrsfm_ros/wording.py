# SPDX-License-Identifier: Apache-2.0
"""What a sentence calls an option: as the programs, the node or Python's `train` do.

Sentences that name an option are made in several rooms, far from the caller who reads them. So the
caller is a context, as with `numpy.errstate`, and no argument of everything in between.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_PROGRAM, _NODE, _PYTHON = "program", "node", "python"
_CALLER = ContextVar("_CALLER", default=_PROGRAM)


def wording(program: str, *, python: str, node: str | None = None) -> str:
    """Return words for a sentence: `python` within `in_python`, `node` within `in_node`.

    Args:
        program: names options of the command line, and parameters of the node where `node` is None.
        python: names arguments of `train` and fields of `Recipe`; "" where there is no such one.
        node: names parameters of the node alone; None = `program`.
    """
    return {_PROGRAM: program, _NODE: program if node is None else node, _PYTHON: python}[
        _CALLER.get()
    ]


def is_in_node() -> bool:
    """Return whether the sentences of this thread name parameters of the node."""
    return _CALLER.get() == _NODE


@contextmanager
def in_python() -> Iterator[None]:
    """Have the sentences of this thread name arguments of Python; also a decorator."""
    with _caller(_PYTHON):
        yield


@contextmanager
def in_node() -> Iterator[None]:
    """Have the sentences of this thread name parameters of the node; also a decorator."""
    with _caller(_NODE):
        yield


@contextmanager
def _caller(name: str) -> Iterator[None]:
    """Set the caller for a while."""
    token = _CALLER.set(name)
    try:
        yield
    finally:
        _CALLER.reset(token)
