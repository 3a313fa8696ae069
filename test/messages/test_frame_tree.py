# SPDX-License-Identifier: Apache-2.0
"""Rotations between frames, as tf2 gives them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

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
    assert len(tree._frames) <= _MAX_FRAMES


def test_a_transform_is_interpolated_to_its_time() -> None:
    tree, second = FrameTree(), 1_000_000_000
    ends = [Rotation.from_euler("xyz", a, degrees=True) for a in ((5, -70, 20), (60, 10, -90))]
    for i in (1, 0):  # in any order
        x, y, z, w = ends[i].as_quat(canonical=bool(i)).tolist()
        tree.add("map", "base", (-x, -y, -z, -w), (i, 2.0 * i, 0.0), (100 + i) * second)
    tree.add("base", "camera", (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0))  # of /tf_static
    found = tree.transform("map", "camera", 100 * second + second // 4)
    assert found is not None and found.gap == 0
    wanted = Slerp([0, 1], Rotation.concatenate(ends))(0.25)
    np.testing.assert_allclose(found.rotation, wanted.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.translation, [0.25, 0.5, 0] + wanted.apply([0, 0, 1]))


def test_outside_of_what_is_kept_the_nearest_is_taken_and_the_gap_told() -> None:
    tree, second = FrameTree(), 1_000_000_000
    for i in range(300):
        tree.add("map", "base", (0.0, 0.0, 0.0, 1.0), (float(i), 0.0, 0.0), 1 + i * second // 10)

    def at(stamp: int) -> tuple[float, float]:
        found = tree.transform("map", "base", stamp)
        assert found is not None
        return float(found.translation[0]), round(found.gap, 6)

    assert at(0) == (299.0, 0.0) and at(1 + 30 * second) == (299.0, 0.1)
    assert at(1) == (249.0, 24.9)  # 5 s are kept
    tree.add("map", "base", (0.0, 0.0, 0.0, 1.0), (7.0, 0.0, 0.0), second)  # the clock begins anew
    assert at(second) == at(0) == (7.0, 0.0)


def test_the_same_stamp_twice_is_the_last_one() -> None:
    tree = FrameTree()
    for x in (1.0, 2.0):
        tree.add("map", "base", (0.0, 0.0, 0.0, 1.0), (x, 0.0, 0.0), 5)
    assert tree.transform("map", "base", 5)[1][0] == 2  # type: ignore[index]
