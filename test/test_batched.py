# SPDX-License-Identifier: Apache-2.0
"""Blocks are all there is, in order, and none is larger than asked for."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from deep_nrsfm_ros.batched import slices


@given(st.integers(0, 100), st.integers(1, 30))
def test_blocks_are_all_in_order(n: int, size: int) -> None:
    frames = list(range(n))
    parts = [frames[block] for block in slices(n, size)]
    assert [frame for part in parts for frame in part] == frames
    assert all(1 <= len(part) <= size for part in parts)
    assert [block.stop - block.start for block in slices(n, size)] == [len(part) for part in parts]
