# SPDX-License-Identifier: Apache-2.0
"""The dataset refuses what does not fit together, and keeps what does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset, concatenate
from deep_nrsfm_ros.layouts.layout import KeypointLayout

FIVE = KeypointLayout.numbered(5)


def dataset(f: int = 4, source: str = "a", truth: bool = True, **changes: Any) -> Dataset:
    rng = np.random.default_rng(f)
    fields: dict[str, Any] = {
        "points": rng.standard_normal((f, 5, 2)).astype(np.float32),
        "visible": rng.random((f, 5)) < 0.7,
        "layout": FIVE,
        "source": source,
        "shapes": rng.standard_normal((f, 5, 3)).astype(np.float32) if truth else None,
    }
    return Dataset(**(fields | changes))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"points": np.zeros((4, 6, 2))}, r"points are \(4, 6, 2\).*\(frames, 5, 2\)"),
        ({"points": np.zeros((4, 5, 3))}, r"points are \(4, 5, 3\)"),
        ({"visible": np.ones((3, 5), bool)}, r"visible is \(3, 5\).*\(4, 5\)"),
        ({"visible": np.ones((4, 5, 1), bool)}, r"visible is \(4, 5, 1\)"),
        ({"shapes": np.zeros((4, 5, 2))}, r"shapes are \(4, 5, 2\).*\(4, 5, 3\)"),
        ({"sequence_starts": np.array([1])}, "must ascend from 0"),
        ({"sequence_starts": np.array([0, 2, 2])}, "must ascend from 0"),
        ({"sequence_starts": np.array([0, 4])}, "to a frame of the 4"),
        ({"layout": KeypointLayout.numbered(6)}, r"points are \(4, 5, 2\).*\(frames, 6, 2\)"),
    ],
)
def test_arrays_must_fit(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        dataset(**changes)


def test_empty_is_an_ensemble() -> None:
    assert len(dataset(0)) == 0 and len(dataset(4)) == 4


@pytest.mark.parametrize("frames", [slice(1, 3), np.array([3, 0]), slice(0, 0)])
@pytest.mark.parametrize("shapes", [True, False])
def test_frames_are_chosen_together(frames: Any, shapes: bool) -> None:
    whole = dataset(truth=shapes)
    part = whole[frames]
    np.testing.assert_array_equal(part.points, whole.points[frames])
    np.testing.assert_array_equal(part.visible, whole.visible[frames])
    if shapes:
        assert whole.shapes is not None
        np.testing.assert_array_equal(part.shapes, whole.shapes[frames])
    else:
        assert part.shapes is None
    assert part.layout is whole.layout and part.source == whole.source


def test_concatenate_keeps_order_and_names_each_source_once() -> None:
    parts = [dataset(2, "a"), dataset(3, "b"), dataset(4, "a")]
    whole = concatenate(parts)
    assert len(whole) == 9 and whole.source == "a; b"
    for start, part in zip((0, 2, 5), parts, strict=True):
        again = whole[start : start + len(part)]
        for name in ("points", "visible", "shapes"):
            np.testing.assert_array_equal(getattr(again, name), getattr(part, name))


def test_ground_truth_is_kept_only_if_all_have_it() -> None:
    assert concatenate([dataset(2), dataset(3, truth=False)]).shapes is None


def test_concatenate_refuses_nothing_and_different_layouts() -> None:
    with pytest.raises(ValueError, match="no datasets"):
        concatenate([])
    other = KeypointLayout("other", tuple("abcde"))
    with pytest.raises(ValueError, match="2 different keypoint layouts"):
        concatenate([dataset(), dataset(layout=other)])


def test_sequences_go_with_their_frames() -> None:
    whole = dataset(8, sequence_starts=np.array([0, 3, 5]))
    assert whole[np.array([1, 2, 5, 7])].sequence_starts.tolist() == [0, 2]
    assert whole[2:5].sequence_starts.tolist() == [0, 1]
    assert dataset(8)[2:5].sequence_starts.tolist() == []
    both = concatenate([whole, dataset(4, sequence_starts=np.array([0]))])
    assert both.sequence_starts.tolist() == [0, 3, 5, 8]
    assert concatenate([whole, dataset(4)]).sequence_starts.tolist() == []
