# SPDX-License-Identifier: Apache-2.0
"""Frames that the judge gets: the ends of blocks, so that no near-duplicate is trained on."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import BLOCKS, MIN_HELD_OUT, split
from deep_nrsfm_ros.layouts.layout import KeypointLayout


def numbered_frames(n: int) -> Dataset:
    """Return n frames whose first coordinate is the number of the frame."""
    points = np.ones((n, 4, 2), np.float32)
    points[:, 0, 0] = np.arange(n)
    return Dataset(points, np.ones((n, 4), bool), KeypointLayout.numbered(4), "test")


@pytest.mark.parametrize("share", [0.05, 0.1, 0.5])
def test_each_block_gives_its_last_frames(share: float) -> None:
    n = 1000
    frames = split(numbered_frames(n), share)
    kept, held = (part.points[:, 0, 0].astype(int) for part in frames)
    assert sorted((*kept, *held)) == list(range(n))
    assert len(held) == pytest.approx(share * n, abs=BLOCKS)
    runs = np.split(held, np.flatnonzero(np.diff(held) > 1) + 1)
    assert [run[-1] for run in runs] == [n * (k + 1) // BLOCKS - 1 for k in range(BLOCKS)]


def test_nothing_is_held_out_of_few_frames_or_by_no_share() -> None:
    few = numbered_frames(10 * MIN_HELD_OUT - 1)
    assert split(few, 0.1).training is few and split(few, 0.1).held_out is few
    many = numbered_frames(1000)
    assert split(many, 0.0).training is many
