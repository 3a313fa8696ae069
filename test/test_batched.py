# SPDX-License-Identifier: Apache-2.0
"""Blocks are all there is, in order, and none is larger than asked for."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from deep_nrsfm_ros.batched import evenly_spaced, slices


@given(st.integers(0, 100), st.integers(1, 30))
def test_blocks_are_all_in_order(n: int, size: int) -> None:
    frames = list(range(n))
    parts = [frames[block] for block in slices(n, size)]
    assert [frame for part in parts for frame in part] == frames
    assert all(1 <= len(part) <= size for part in parts)
    assert [block.stop - block.start for block in slices(n, size)] == [len(part) for part in parts]


@given(st.integers(0, 300), st.integers(2, 30))
def test_items_are_evenly_spaced(n: int, count: int) -> None:
    found = evenly_spaced(iter(range(n)), count)
    steps = {after - before for before, after in pairwise(found)}
    assert len(steps) <= 1 and found[:1] == list(range(n))[:1]
    assert min(count, n) <= len(found) < 2 * count or n < 2 * count
    assert n - found[-1] <= max(steps, default=1) * 2 if found else not n
