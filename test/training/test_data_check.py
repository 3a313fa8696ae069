# SPDX-License-Identifier: Apache-2.0
"""Data that looks wrong is said before a training, by the check that `lift` uses."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.data.walking_person import IMAGE, in_layout
from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN17
from deep_nrsfm_ros.training.data_check import check_dataset

POINTS, CONFIDENCE = in_layout(COCO17)


def warnings(
    points: np.ndarray, layout: KeypointLayout = COCO17, size: tuple[int, int] | None = None
) -> tuple[list[str], Dataset]:
    said: list[str] = []
    reporter: Any = SimpleNamespace(warn=said.append)
    dataset = Dataset(points.astype(np.float32), CONFIDENCE > 0, layout, "test")
    return said, check_dataset(dataset, layout, size, reporter)


def test_sound_data_is_taken_without_a_word() -> None:
    for size in (None, IMAGE):
        said, dataset = warnings(POINTS, size=size)
        assert not said
        np.testing.assert_array_equal(dataset.points, POINTS)


def test_normalised_points_become_pixels_where_the_size_is_known() -> None:
    normalised = POINTS / np.array(IMAGE)
    assert "they are normalised" in warnings(normalised)[0][0]
    said, dataset = warnings(normalised, size=IMAGE)
    assert not said
    np.testing.assert_allclose(dataset.points, POINTS, rtol=1e-5)


@pytest.mark.parametrize(
    ("points", "layout", "expected"),
    [
        (POINTS, HUMAN17, "is it coco17?"),
        (POINTS * [1, -1] + [0, 720], COCO17, "upside down"),
        (np.where(np.arange(17)[:, None] == 9, -1, POINTS), COCO17, "exactly (-1, -1)"),
    ],
)
def test_what_looks_wrong(points: np.ndarray, layout: KeypointLayout, expected: str) -> None:
    assert any(expected in warning for warning in warnings(points, layout)[0])


def test_objects_without_names_are_not_taken_for_people() -> None:
    assert not warnings(POINTS, KeypointLayout.numbered(17))[0]
