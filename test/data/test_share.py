# SPDX-License-Identifier: Apache-2.0
"""What each of several processes reads: together all of it, once, each some of every part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deep_nrsfm_ros.data import dataset
from deep_nrsfm_ros.data.bags import frames, read_bags, write_bag
from deep_nrsfm_ros.data.share import BLOCK, Share
from deep_nrsfm_ros.layouts.layout import KeypointLayout

LAYOUT = KeypointLayout.numbered(5)


def test_shares_are_blocks_of_everything() -> None:
    n = 7 * BLOCK + 3
    parts = [list(Share(i, 3).of(range(n))) for i in range(3)]
    assert sorted(sum(parts, [])) == list(range(n))
    assert [Share(i, 3).rows(n).tolist() for i in range(3)] == parts
    assert max(map(len, parts)) - min(map(len, parts)) <= BLOCK
    assert parts[1][:BLOCK] == list(range(BLOCK, 2 * BLOCK))
    assert list(Share().of(range(n))) == list(range(n))


def test_processes_read_each_message_of_each_bag_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset, "_CHUNK", 50)  # the dataset is put together of several parts
    monkeypatch.setattr(dataset, "_BLOCK", 8)
    points = np.random.default_rng(0).uniform(1, 600, (200, 5, 2)).astype(np.float32)
    halves = {"a": points[:70], "b": points[70:]}
    for name, half in halves.items():
        write_bag(tmp_path / name, "/keypoints", frames(half, np.ones(half.shape[:2])))
    bags = [tmp_path / name for name in halves]
    whole = read_bags(bags, LAYOUT, LAYOUT)
    np.testing.assert_array_equal(whole.dataset.points, points)
    reads = [read_bags(bags, LAYOUT, LAYOUT, share=Share(i, 2)) for i in range(2)]
    assert sum(reading.messages for reading in reads) == 200 == whole.messages
    # The second bag begins with another process, else all short bags would be of the first one.
    rows = [np.concatenate([Share(i, 2).rows(70), 70 + Share(1 - i, 2).rows(130)]) for i in (0, 1)]
    for reading, chosen in zip(reads, rows, strict=True):
        np.testing.assert_array_equal(reading.dataset.points, points[chosen])
