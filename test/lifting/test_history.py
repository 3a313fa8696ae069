# SPDX-License-Identifier: Apache-2.0
"""What is remembered is bounded, found by identity, and forgotten."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.lifting.history import _MAX_AGE, _MAX_IDENTITIES, Memory, StateLayout

LAYOUT = StateLayout(5, 3)


def marked(memory: Memory, identities: tuple[str, ...], time: float) -> list[float]:
    """Return a number of each row of a message, and write the time as a lift does."""
    context = memory(identities, time)
    numbers = [float(context.states[row, 12]) for row in context.rows]
    for row in context.rows:
        context.states[row, 0] = time
        if np.isnan(context.states[row, 12]):
            context.states[row, 12] = len(memory)
    return numbers


def test_parts_are_views_that_fill_a_row() -> None:
    rows = np.zeros((4, LAYOUT.size))
    parts = LAYOUT.split(rows)
    assert sum(part[0].size for part in parts) == LAYOUT.size
    for part in parts:
        part += 1
    np.testing.assert_array_equal(rows, 1)


def test_an_identity_keeps_its_row() -> None:
    memory = Memory(LAYOUT)
    assert np.isnan(marked(memory, ("a", "b"), 0.0)).all()
    first = marked(memory, ("a", "b"), 0.1)
    assert marked(memory, ("b", "c", "a"), 0.2)[::2] == first[::-1]
    assert memory(("a", ""), 0.3).rows[1] == -1
    assert memory.row("a") is not None and memory.row("z") is None


@pytest.mark.parametrize("n", [1, 30])
def test_memory_is_bounded(n: int) -> None:
    memory = Memory(LAYOUT)
    for frame in range(40 * _MAX_IDENTITIES // n):
        names = tuple(f"{frame}-{i}" for i in range(n))
        assert np.isnan(marked(memory, names, 0.01 * frame)).all()
        assert len(memory) <= 2 * _MAX_IDENTITIES
    capacity = len(memory(("x",), 1.0).states)
    assert capacity <= 2 * _MAX_IDENTITIES


def test_identities_that_are_gone_leave_first() -> None:
    memory = Memory(LAYOUT)
    marked(memory, ("gone",), 0.0)
    for frame in range(1000):
        marked(memory, ("stays", f"{frame}"), 1 + frame * _MAX_AGE / 50)
    assert memory.row("gone") is None and memory.row("stays") is not None
    assert len(memory) < 150


def test_more_objects_than_are_remembered_have_rows_of_their_own() -> None:
    memory = Memory(LAYOUT)
    names = tuple(map(str, range(3 * _MAX_IDENTITIES)))
    rows = memory(names, 0.0).rows
    assert len(set(rows.tolist())) == len(names) and rows.min() >= 0
