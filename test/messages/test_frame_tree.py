"""Rotations between frames, as tf2 gives them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from deep_nrsfm_ros.messages.frame_tree import _MAX_FRAMES, FrameTree

OPTICAL = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # in a link with x forward


def add(tree: FrameTree, parent: str, child: str, rotation: Rotation) -> None:
    x, y, z, w = rotation.as_quat().tolist()
    tree.add(parent, child, (x, y, z, w))


def test_up_in_the_optical_frame_of_a_camera_that_looks_down() -> None:
    tree = FrameTree()
    add(tree, "map", "base_link", Rotation.from_euler("z", 77, degrees=True))
    add(tree, "base_link", "camera", Rotation.from_euler("y", 20, degrees=True))
    add(tree, "/camera", "/optical", OPTICAL)
    R = tree.rotation("optical", "map")
    assert R is not None
    angle = np.radians(20)
    np.testing.assert_allclose(R[:, 2], [0, -np.cos(angle), -np.sin(angle)], atol=1e-12)
    back = tree.rotation("map", "optical")
    assert back is not None
    np.testing.assert_allclose(back, R.T, atol=1e-12)


def test_frames_that_are_not_connected_have_none() -> None:
    tree = FrameTree()
    add(tree, "map", "a", Rotation.identity())
    add(tree, "odom", "b", Rotation.identity())
    assert tree.rotation("a", "b") is None and tree.rotation("a", "nowhere") is None
    np.testing.assert_array_equal(tree.rotation("x", "x"), np.eye(3))


def test_loops_end_and_broken_rotations_are_not_taken() -> None:
    tree = FrameTree()
    for parent, child in (("a", "b"), ("b", "a")):
        add(tree, parent, child, Rotation.identity())
    tree.rotation("a", "b")
    tree.add("map", "c", (0.0, 0.0, 0.0, 0.0))
    tree.add("map", "c", (np.nan, 0.0, 0.0, 1.0))
    assert tree.rotation("c", "map") is None


def test_frames_that_come_and_go_do_not_fill_the_memory() -> None:
    tree = FrameTree()
    for i in range(3 * _MAX_FRAMES):
        add(tree, "camera", f"object{i}", Rotation.identity())
    assert len(tree._parents) <= _MAX_FRAMES
