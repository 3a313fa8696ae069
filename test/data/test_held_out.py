# SPDX-License-Identifier: Apache-2.0
"""Frames that the judge gets: the ends of sequences or of quarters, after a gap."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.held_out import BLOCKS, GAP, MIN_HELD_OUT, split
from deep_nrsfm_ros.layouts.layout import KeypointLayout


def numbered_frames(n: int, *starts: int) -> Dataset:
    """Return n frames whose first coordinate is the number of the frame."""
    points = np.ones((n, 4, 2), np.float32)
    points[:, 0, 0] = np.arange(n)
    layout, visible = KeypointLayout.numbered(4), np.ones((n, 4), bool)
    return Dataset(points, visible, layout, "test", sequence_starts=np.array(starts, np.int64))


def runs(dataset: Dataset) -> list[tuple[int, int]]:
    """Return the first and the last frame of each run of consecutive frames."""
    numbers = dataset.points[:, 0, 0].astype(int)
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]


@pytest.mark.parametrize("share", [0.05, 0.1, 0.5])
def test_each_quarter_gives_its_last_frames(share: float) -> None:
    n = 1000
    frames = split(numbered_frames(n), share)
    assert len(frames.held_out) == pytest.approx(share * n, abs=BLOCKS)
    ends = [n * (k + 1) // BLOCKS - 1 for k in range(BLOCKS)]
    assert [last for _, last in runs(frames.held_out)] == ends
    pairs = zip(runs(frames.training), runs(frames.held_out), strict=True)
    for (_, last), (first, _) in pairs:
        assert first - last - 1 == pytest.approx(GAP * share * n / BLOCKS, abs=1)


def test_each_sequence_gives_its_last_frames() -> None:
    frames = split(numbered_frames(1000, 0, 200), 0.1)
    assert runs(frames.held_out) == [(180, 199), (920, 999)]
    assert runs(frames.training) == [(0, 169), (200, 879)]
    assert frames.training.sequence_starts.tolist() == [0, 170]


def test_all_held_out_frames_of_one_recording_are_later() -> None:
    assert runs(split(numbered_frames(1000, 0), 0.1).held_out) == [(900, 999)]


def test_sequences_too_short_to_share_are_taken_together() -> None:
    tracks = numbered_frames(1000, *range(0, 1000, 5))
    assert len(split(tracks, 0.1).held_out) == 100


def test_nothing_is_held_out_of_few_frames_or_by_no_share() -> None:
    few = numbered_frames(10 * MIN_HELD_OUT - 1)
    assert split(few, 0.1).training is few and split(few, 0.1).held_out is few
    many = numbered_frames(1000)
    assert split(many, 0.0).training is many
