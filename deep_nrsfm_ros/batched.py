# SPDX-License-Identifier: Apache-2.0
"""Slices of a large array, to bound memory and to stay in the processor's cache."""

from __future__ import annotations


def slices(n: int, size: int = 4096) -> list[slice]:
    """Return slices of at most `size` elements that cover range(n), in order; none for n = 0."""
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]
