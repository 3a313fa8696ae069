"""Many frames, some at a time: all at once would take their memory again, and leave the cache."""

from __future__ import annotations


def slices(n: int, size: int = 4096) -> list[slice]:
    """Return slices of at most `size` that together are n."""
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]
