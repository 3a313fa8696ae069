# SPDX-License-Identifier: Apache-2.0
"""Hands of both sides become right hands."""

from __future__ import annotations

import numpy as np

from deep_nrsfm_ros.data.hands import mirrored, palms_as_right_hands, right_hands
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


def test_palms_become_right_ones() -> None:
    right = right_palm()
    hands = palms_as_right_hands(np.stack([right, mirrored(right)]))
    np.testing.assert_array_equal(hands, np.stack([right, right]))
