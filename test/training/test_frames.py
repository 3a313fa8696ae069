# SPDX-License-Identifier: Apache-2.0
"""Tests of the frames that a training draws from."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
import torch

from deep_nrsfm_ros.batched import slices
from deep_nrsfm_ros.training import frames as pools
from deep_nrsfm_ros.training.frames import FrameStore

F, P = 50, 4


@pytest.fixture
def pool() -> FrameStore:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((F, P, 2), dtype=np.float32)
    visible = rng.random((F, P)) < 0.7
    points[~visible] = np.nan
    return dataclasses.replace(FrameStore.of(points, visible), usable=torch.arange(1, F, 2))


def test_holds_what_it_was_given() -> None:
    points, visible = np.ones((3, P, 2), np.float32), np.ones((3, P), bool)
    pool = FrameStore.of(points, visible)
    points[1], visible[2, 0] = 7, False
    assert pool.points[1, 0, 0] == 7 and not pool.visible[2, 0]
    assert pool.to(torch.device("cpu")) is pool


def test_takes_arrays_that_may_not_be_written() -> None:
    points, visible = np.ones((6, P, 2), np.float32), np.ones((6, P), bool)
    points.flags.writeable = False
    assert len(FrameStore.of(points[::-2], visible[::-2])) == 3


def test_a_batch_has_the_usable_frames_and_zeros_for_missing_points(pool: FrameStore) -> None:
    batch = pool.batch(torch.tensor([3, 0, 3]))
    assert len(pool) == F // 2
    for frame, points, mask in zip((7, 1, 7), batch.points, batch.mask, strict=True):
        there = pool.visible[frame]
        assert torch.equal(mask[:, 0] > 0, there)
        assert torch.equal(points[there], pool.points[frame][there])
        assert not points[~there].any()


def test_blocks_are_all_usable_frames_once(
    pool: FrameStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "slices", partial(slices, size=10))
    parts = list(pool.batches())
    assert [len(part.points) for part in parts] == [10, 10, 5]
    whole = pool.batch(slice(None))
    assert torch.equal(torch.cat([part.points for part in parts]), whole.points)
    assert torch.equal(torch.cat([part.mask for part in parts]), whole.mask)


def test_elsewhere_is_a_copy_of_what_is_usable(pool: FrameStore) -> None:
    there = pool.to(torch.device("meta"))
    assert there.device.type == "meta"
    assert there.points.shape == (F // 2, P, 2) and len(there) == len(pool)
