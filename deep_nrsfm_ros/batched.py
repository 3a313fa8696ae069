# SPDX-License-Identifier: Apache-2.0
"""Parts of what is large, to bound memory and to stay in the processor's cache."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

Item = TypeVar("Item")

Progress = Callable[[int, int], None]
"""Called with what is done and with the total; it may raise an exception to end the work."""


def no_progress(done: int, total: int) -> None:
    """Do nothing: the progress that nobody follows."""


def slices(n: int, size: int = 4096) -> list[slice]:
    """Return slices of at most `size` elements that cover range(n), in order; none for n = 0."""
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def evenly_spaced(items: Iterable[Item], count: int) -> list[Item]:
    """Return `count` to twice as many evenly spaced items, or all if there are fewer.

    Their number need not be known, and memory holds no more than these.
    """
    kept: list[Item] = []
    step = 1
    for number, item in enumerate(items):
        if number % step == 0:
            kept.append(item)
            if len(kept) == 2 * count:
                kept, step = kept[::2], 2 * step
    return kept
