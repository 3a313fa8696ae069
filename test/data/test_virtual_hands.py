# SPDX-License-Identifier: Apache-2.0
"""Virtual hands: right hands of published proportions that bend to the palm."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.data import virtual_hands as module
from deep_nrsfm_ros.data.virtual_hands import FINGERS, PHALANGES, THUMB, hand_shapes, virtual_hands
from deep_nrsfm_ros.layouts.presets import preset

LAYOUT = preset("hand21")
COUNT = 2000


@pytest.fixture
def shapes(monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """Return hands whose keypoints are at the joints."""
    for name in ("KEYPOINT_SPREAD", "WRIST_SPREAD", "THUMB_BASE_SPREAD"):
        monkeypatch.setattr(module, name, 0.0)
    return np.asarray(hand_shapes(COUNT, np.random.default_rng(0)))


def joint(shapes: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(shapes[:, LAYOUT.index(name)])


def chain(shapes: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Return the lengths (n, b) of the bones between the named joints."""
    joints = np.stack([joint(shapes, name) for name in names], 1)
    return np.asarray(np.linalg.norm(np.diff(joints, axis=1), axis=2))


def _straightness(shapes: np.ndarray, finger: str) -> np.ndarray:
    """Return the distance (n,) of a tip from its knuckle, relative to that of a straight finger."""
    names = tuple(f"{finger}_{part}" for part in ("mcp", "pip", "dip", "tip"))
    return np.asarray(chain(shapes, names[::3])[:, 0] / chain(shapes, names).sum(1))


def test_bones_have_the_published_lengths(shapes: np.ndarray) -> None:
    for finger, expected in zip(FINGERS, PHALANGES, strict=True):
        lengths = chain(shapes, tuple(f"{finger}_{part}" for part in ("mcp", "pip", "dip", "tip")))
        np.testing.assert_allclose(lengths.mean(0), expected, rtol=0.01)
        assert (lengths.std(0) / lengths.mean(0)).max() < 0.1
    lengths = chain(shapes, tuple(f"thumb_{part}" for part in ("cmc", "mcp", "ip", "tip")))
    np.testing.assert_allclose(lengths.mean(0), THUMB, rtol=0.01)


def test_they_are_right_hands_that_bend_to_the_front(shapes: np.ndarray) -> None:
    assert (joint(shapes, "pinky_mcp")[:, 1] > joint(shapes, "index_mcp")[:, 1]).all()
    assert (joint(shapes, "thumb_cmc")[:, 1] < joint(shapes, "middle_mcp")[:, 1]).all()
    assert (joint(shapes, "middle_mcp")[:, 2] < joint(shapes, "wrist")[:, 2]).all()
    bent = _straightness(shapes, "middle") < 0.7
    ahead = joint(shapes, "middle_tip") - joint(shapes, "middle_mcp")
    assert (ahead[bent, 0] > 0).mean() > 0.98


def test_fingers_are_open_shut_and_in_between(shapes: np.ndarray) -> None:
    for finger in FINGERS:
        share = _straightness(shapes, finger)
        assert (share > 0.97).mean() > 0.1
        assert (share < 0.6).mean() > 0.1
        assert ((share > 0.7) & (share < 0.9)).mean() > 0.1


def test_dataset_shows_each_hand_to_a_camera_of_its_own() -> None:
    hands = virtual_hands(50, seed=3)
    assert hands.shapes is not None
    assert hands.layout == LAYOUT
    cameras = np.linalg.pinv(hands.shapes) @ hands.points  # (n, 3, 2)
    np.testing.assert_allclose(hands.shapes @ cameras, hands.points, atol=1e-3)
    eye = np.broadcast_to(np.eye(2), (50, 2, 2))
    np.testing.assert_allclose(cameras.swapaxes(1, 2) @ cameras, eye, atol=1e-4)
    assert cameras.std(0).min() > 0.3
    np.testing.assert_array_equal(hands.points, virtual_hands(50, seed=3).points)
    assert not np.array_equal(hands.points, virtual_hands(50, seed=4).points)
