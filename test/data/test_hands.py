# SPDX-License-Identifier: Apache-2.0
"""Hands of both sides become right hands."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.data.dataset import Dataset
from deep_nrsfm_ros.data.hands import (
    as_right_hands,
    mirrored,
    mixed_sides,
    other_side_share,
    palms_as_right_hands,
    right_hands,
)
from deep_nrsfm_ros.data.sufficiency import assess_sufficiency
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import preset

LAYOUT = preset("hand21")


def right_palm() -> np.ndarray:
    """Return a right palm before the camera, fingers up: the thumb is on the right (21, 2)."""
    hand = np.random.default_rng(0).normal(0, 1, (21, 2)).astype(np.float32)
    for name, place in {"wrist": (0, 50), "index_mcp": (20, -20), "pinky_mcp": (-20, -10)}.items():
        hand[LAYOUT.index(name)] = place
    return hand


def test_hands_are_sorted_by_their_places_and_left_ones_mirrored() -> None:
    right = right_palm()
    left = mirrored(right) + np.array([200, 0], np.float32)
    right = right - np.array([200, 0], np.float32)
    hands = right_hands(np.stack([[right, left], [left, right]]))
    assert hands.shape == (4, 21, 2)
    centred = hands - hands.mean(1, keepdims=True)
    np.testing.assert_allclose(centred, np.tile(centred[:1], (4, 1, 1)), atol=1e-4)
    np.testing.assert_array_equal(hands[0], right)


def test_a_mirrored_image_is_mirrored_back() -> None:
    right = right_palm() - np.array([200, 0], np.float32)
    pair = np.stack([right, mirrored(right)])[None]
    np.testing.assert_array_equal(right_hands(mirrored(pair), mirrored_image=True)[0], right)


@pytest.mark.parametrize("shape", [(4, 21, 2), (4, 1, 21, 2), (4, 2, 20, 2), (2, 21)])
def test_both_hands_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(
        ValueError, match=r"points are .*; hands need \(f, 2, 21, 2\); single hands"
    ):
        right_hands(np.zeros(shape, np.float32))
    if shape != (4, 21, 2):
        with pytest.raises(ValueError, match=r"hands need \(f, 21, 2\)$"):
            palms_as_right_hands(np.zeros(shape, np.float32))


def hands(right: int, left: int) -> Dataset:
    """Return so many right and left palms."""
    palm = right_palm()
    points = np.stack([palm] * right + [mirrored(palm)] * left)
    points += np.random.default_rng(1).normal(0, 0.5, points.shape).astype(np.float32)
    return Dataset(points, np.ones(points.shape[:2], bool), LAYOUT, "test")


def test_hands_of_both_sides_are_asked_about_unless_their_side_is_said() -> None:
    mixed = hands(60, 40)
    assert other_side_share(mixed) == pytest.approx(0.4)
    assert "40 % of the hands look like those of the other side" in mixed_sides(mixed)
    assert any(
        "(--hands, train.hands): palms" in text for text in assess_sufficiency(mixed).warnings
    )
    assert mixed_sides(hands(95, 5)) == "" == mixed_sides(hands(0, 100))
    assert mixed_sides(mixed, 0.5) == ""
    for side in ("right", "left", "palms"):
        said = as_right_hands(mixed, side)
        assert mixed_sides(said) == "" == mixed_sides(said[:10])
        assert other_side_share(said) == pytest.approx(0.0 if side == "palms" else 0.4)
        assert (said.points[0, 0, 0] == mixed.points[0, 0, 0]) == (side != "left")


def test_other_objects_and_hidden_palms_are_no_question() -> None:
    other = KeypointLayout("other", tuple(f"k{i}" for i in range(21)))
    mixed = hands(50, 50)
    unknown = Dataset(mixed.points, mixed.visible, other, "test")
    assert mixed_sides(unknown) == ""
    with pytest.raises(ValueError, match="'other' has no wrist, index_mcp, pinky_mcp"):
        as_right_hands(unknown, "right")
    visible = mixed.visible.copy()
    visible[:, LAYOUT.index("wrist")] = False
    assert mixed_sides(Dataset(mixed.points, visible, LAYOUT, "test")) == ""


def test_palms_become_right_ones() -> None:
    right = right_palm()
    hands = palms_as_right_hands(np.stack([right, mirrored(right)]))
    np.testing.assert_array_equal(hands, np.stack([right, right]))
