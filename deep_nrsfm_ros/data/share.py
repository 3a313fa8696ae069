# SPDX-License-Identifier: Apache-2.0
"""The part of a recording that one of several processes reads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Item = TypeVar("Item")

BLOCK = 16
"""Consecutive messages or objects that one process reads: near-duplicates stay together."""


@dataclass(frozen=True)
class Share:
    """Every `size`-th block of a recording, so that each process has some of all of it.

    Attributes:
        index: of the process, from 0.
        size: number of processes.
    """

    index: int = 0
    size: int = 1

    def of(self, items: Iterable[Item], first_block: int = 0) -> Iterator[Item]:
        """Yield the items of this share; `first_block` spreads many short recordings."""
        if self.size == 1:
            yield from items
            return
        for number, item in enumerate(items, first_block * BLOCK):
            if number // BLOCK % self.size == self.index:
                yield item

    def rows(self, n: int) -> NDArray[np.int64]:
        """Return the indices of this share among n items."""
        own: NDArray[np.bool_] = np.arange(n) // BLOCK % self.size == self.index
        return np.flatnonzero(own)


WHOLE_SHARE = Share()
"""All of a recording."""
