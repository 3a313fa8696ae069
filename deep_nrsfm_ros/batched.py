# SPDX-License-Identifier: Apache-2.0
"""Slices of a large array, to bound memory and to stay in the processor's cache."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with what is done and with the total; it may raise an exception to end the work."""


def no_progress(done: int, total: int) -> None:
    """Do nothing: the progress that nobody follows."""


def slices(n: int, size: int = 4096) -> list[slice]:
    """Return slices of at most `size` elements that cover range(n), in order; none for n = 0."""
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]
