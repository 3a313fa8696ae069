# SPDX-License-Identifier: Apache-2.0
"""What the benchmark spoils is what it says, and perfect curation would score perfectly."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.robustness import corrupted_data
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import centre, random_cameras


@pytest.fixture
def people() -> Dataset:
    rng = np.random.default_rng(0)
    shapes = centre(rng.standard_normal((17, 3)) + 0.2 * rng.standard_normal((400, 17, 3)))
    points = (shapes @ random_cameras(400, rng)).astype(np.float32)
    return Dataset(points, np.ones((400, 17), bool), HUMAN17, "made up")


def test_jumps_and_swaps_are_where_they_are_said_to_be(people: Dataset) -> None:
    bad = corrupted_data.corrupt(people, 0)
    assert (bad.jumps > 0).any(1).sum() == (bad.swaps > 0).any(1).sum() == 10
    assert ((bad.jumps > 0).sum(1) <= 1).all()
    assert (bad.jumps[bad.jumps > 0] > 0.69).all() and bad.jumps.max() < 3.01
    size = np.sqrt((centre(people.points) ** 2).sum(2).mean(1))
    moved = np.linalg.norm(bad.points - people.points, axis=2) / size[:, None]
    np.testing.assert_allclose(
        moved, np.maximum(bad.jumps, bad.swaps), atol=6 * corrupted_data.NOISE
    )


def test_figures_count_points_and_frames(people: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    bad = corrupted_data.corrupt(people, 0)
    right = (bad.jumps > 0) | (bad.swaps > 0)
    monkeypatch.setattr(corrupted_data, "find_outliers", lambda *_: (right, None))
    assert tuple(corrupted_data.detection_rates(people, bad).values()) == (0, 0, 100, 100, 100)
    monkeypatch.setattr(corrupted_data, "find_outliers", lambda *_: (~right, None))
    assert tuple(corrupted_data.detection_rates(people, bad).values()) == (100, 100, 0, 100, 0)
