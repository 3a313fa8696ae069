# SPDX-License-Identifier: Apache-2.0
"""Frames and angles of known poses, and the way from angles to points and back."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros import kernel
from deep_nrsfm_ros.body.kinematic_tree import (
    KinematicTree,
    _quaternions,
    quaternions,
)
from deep_nrsfm_ros.layouts.joints import Joint
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import CMU31, COCO17, HUMAN17
from deep_nrsfm_ros.nrsfm.geometry import rotation_from_vector
from test.fixtures.standing_person import (
    HEIGHT,
    keypoints_of,
    random_angles,
    random_rotations,
    standing_person,
)

TREE = KinematicTree(HUMAN17)
STANDING = standing_person()
OFFSETS = TREE.offsets(TREE(STANDING[None]))[0]
_JOINTS = (
    Joint("cab", ("track",), directions=(("up", ("track", "cab")), ("front", ("track", "boom")))),
    Joint("boom", ("boom",), "cab", (("front", ("boom", "stick")),), (("boom", "right"),)),
    Joint("stick", ("stick",), "boom", (("down", ("stick", "bucket")),), (("stick", "left"),)),
    Joint("bucket", ("bucket",), "stick"),
)
EXCAVATOR = KeypointLayout("excavator", ("track", "cab", "boom", "stick", "bucket"), joints=_JOINTS)
REP155 = {"waist", "r_head", "y_head", "p_head"} | {
    f"{side}_{part}"
    for side in "lr"
    for part in (*(f"{a}_{j}" for a in "ypr" for j in ("shoulder", "hip")), "elbow", "knee")
}


LEG_OUT = {
    "left_knee": (0, 0.464, -0.21),
    "left_ankle": (0, 0.827, -0.42),
    "left_big_toe": (0.2, 0.827, -0.42),
}


def people(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the keypoints (n, 17, 3) and the angles (n, a) of people in random poses."""
    rng = np.random.default_rng(seed)
    angles = random_angles(TREE, n, rng)
    pose = TREE.forward(rng.normal(size=(n, 3)), random_rotations(n, rng), angles, OFFSETS)
    return keypoints_of(TREE, pose), angles


def angle(points: np.ndarray, name: str) -> float:
    """Return an angle of one person in degrees."""
    return float(np.degrees(TREE(points[None]).angles[0, TREE.angle_names.index(name)]))


def moved(**points: tuple[float, float, float]) -> np.ndarray:
    """Return the standing person with other places of keypoints."""
    person = STANDING.copy()
    for name, place in points.items():
        person[HUMAN17.index(name)] = place
    return person


def test_the_angles_of_rep_155_are_there_and_0_in_the_standing_pose() -> None:
    assert set(TREE.angle_names) >= REP155 and len(REP155) == 20
    pose = TREE(STANDING[None])
    np.testing.assert_allclose(np.degrees(pose.angles), 0, atol=0.1)  # the nose is at 63.43 degrees
    np.testing.assert_allclose(pose.rotations[0, :-4], np.eye(3)[None].repeat(17, 0), atol=1e-3)


@pytest.mark.parametrize(
    ("name", "degrees", "points"),
    [
        # The signs are those of the axes in the URDF of the package human_description.
        ("l_elbow", 90, {"left_wrist": (0.25, 0.18, 0.22)}),
        ("r_elbow", 90, {"right_wrist": (0.25, -0.18, 0.22)}),
        ("l_knee", -90, {"left_ankle": (-0.42, 0.1, -0.42), "left_big_toe": (-0.42, 0.1, -0.62)}),
        ("r_knee", -90, {"right_ankle": (-0.42, -0.1, -0.42)}),
        ("l_p_shoulder", 90, {"left_elbow": (0, 0.46, 0.5), "left_wrist": (0, 0.71, 0.5)}),
        ("r_p_shoulder", 90, {"right_elbow": (0, -0.46, 0.5), "right_wrist": (0, -0.71, 0.5)}),
        ("l_p_hip", 60, LEG_OUT),
        ("l_r_hip", 90, {"left_knee": (0.42, 0.1, 0), "left_ankle": (0.42, 0.1, -0.42)}),
        ("y_head", 90, {"nose": (0, 0.12, 0.74)}),
        ("p_head", -63.4, {"nose": (0.2, 0, 0.5)}),
    ],
)
def test_a_limb_that_moves_gives_its_angle(
    name: str, degrees: float, points: dict[str, tuple[float, float, float]]
) -> None:
    assert angle(moved(**points), name) == pytest.approx(degrees, abs=0.1)


def test_a_knee_that_is_lifted_as_if_bent_forward_does_not_turn_the_leg_round() -> None:
    backward = moved(left_knee=(-0.05, 0.1, -0.42))
    assert angle(backward, "l_knee") > 10
    assert abs(angle(backward, "l_y_hip")) < 20


def test_a_straight_arm_has_the_twist_of_the_trunk() -> None:
    noise = 0.002 * np.random.default_rng(0).standard_normal((100, 17, 3))
    elbow_axis = TREE(STANDING + noise).rotations[:, TREE.names.index("left_shoulder"), :, 1]
    assert np.degrees(np.arccos(elbow_axis[:, 1])).max() < 20


def test_angles_of_10000_poses_are_found_again() -> None:
    points, angles = people(10_000)
    found = TREE(points).angles
    difference = (found - angles + np.pi) % (2 * np.pi) - np.pi
    # The twist of a leg whose knee is bent by 20 degrees still follows the foot a little.
    legs = [name.endswith(("_foot", "_hip")) for name in TREE.angle_names]
    bound = np.where(legs, 12.0, 4.0)
    worst = np.degrees(np.abs(difference)).max(0)
    assert (worst < bound).all(), dict(zip(TREE.angle_names, worst.round(2), strict=True))
    assert np.degrees(np.median(np.abs(difference), 0)).max() < 1


def test_forward_kinematics_of_10000_poses_gives_the_points_back() -> None:
    points, _ = people(10_000, seed=1)
    pose = TREE(points)
    again = TREE.forward(pose.origins[:, 0], pose.rotations[:, 0], pose.angles, OFFSETS)
    error = np.linalg.norm(keypoints_of(TREE, again) - points, axis=-1)
    assert np.sqrt((error**2).mean()) < 0.003 * HEIGHT
    np.testing.assert_allclose(again.rotations, pose.rotations, atol=1e-9)


def test_any_points_are_closed_by_their_own_lengths() -> None:
    points = np.random.default_rng(2).normal(size=(2000, 17, 3))
    pose = TREE(points)
    again = TREE.forward(pose.origins[:, 0], pose.rotations[:, 0], pose.angles, TREE.offsets(pose))
    exact = [TREE.names.index(name) for name in ("torso", "left_elbow", "right_knee", "nose")]
    np.testing.assert_allclose(again.origins[:, exact], pose.origins[:, exact], atol=1e-9)
    np.testing.assert_allclose(again.rotations, pose.rotations, atol=1e-9)


def test_frames_are_rotations_and_follow_their_bones() -> None:
    points, _ = people(500, seed=3)
    pose = TREE(points)
    gram = pose.rotations @ pose.rotations.swapaxes(-1, -2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(pose.rotations), 1, atol=1e-9)
    for joint, end in (("left_hip", "left_knee"), ("right_shoulder", "right_elbow")):
        bone = points[:, HUMAN17.index(end)] - points[:, HUMAN17.index(joint)]
        bone /= np.linalg.norm(bone, axis=1, keepdims=True)
        z = pose.rotations[:, TREE.names.index(joint), :, 2]
        np.testing.assert_allclose(z, -bone, atol=1e-9)


def test_a_person_who_turns_has_the_same_angles() -> None:
    points, _ = people(200, seed=4)
    turned = points @ random_rotations(200, np.random.default_rng(5)).swapaxes(1, 2) + 3
    np.testing.assert_allclose(TREE(turned).angles, TREE(points).angles, atol=1e-7)


def test_gimbal_locks_lose_no_rotation() -> None:
    # An arm that hangs down locks the shoulder, a thigh out to the side the hip.
    hanging = moved(left_wrist=(0.1, 0.28, 0.0))
    sideways = moved(left_knee=(0, 0.52, 0), left_ankle=(0, 0.52, -0.42))
    for person in (hanging, sideways):
        pose = TREE(person[None])
        again = TREE.forward(
            pose.origins[:, 0], pose.rotations[:, 0], pose.angles, TREE.offsets(pose)
        )
        np.testing.assert_allclose(again.rotations, pose.rotations, atol=1e-6)
    at = TREE.angle_names.index("l_y_shoulder")
    assert TREE(hanging[None]).angles[0, at] == 0


def test_degenerate_points_give_finite_angles_and_nan_stays_nan() -> None:
    points = np.stack([np.zeros((17, 3)), np.full((17, 3), np.nan), STANDING])
    points[0, :, 2] = np.arange(17)
    with np.errstate(invalid="ignore"):
        pose = TREE(points)
    assert np.isfinite(pose.angles[[0, 2]]).all() and np.isnan(pose.angles[1]).any()
    assert np.isfinite(TREE(np.zeros((1, 17, 3))).rotations).all()


def test_a_layout_without_joints_has_no_tree() -> None:
    with pytest.raises(ValueError, match="cmu31.* names no joints"):
        KinematicTree(CMU31)


def test_any_object_may_have_a_tree() -> None:
    tree = KinematicTree(EXCAVATOR)
    points = np.array([[0, 0, 0], [0, 0, 2], [1, 0, 1], [3, 0, 3], [3, 0, 1]], float)
    R = rotation_from_vector(np.array([0.6, 0, 0.8]))
    pose = tree(points[None] @ R.T)
    assert np.degrees(pose.angles[0]).tolist() == pytest.approx([45, 45])
    np.testing.assert_allclose(pose.rotations[0, 0], R, atol=1e-9)


@pytest.mark.skipif(not kernel.AVAILABLE, reason="there is no kernel")
@pytest.mark.parametrize("layout", [HUMAN17, COCO17, EXCAVATOR], ids=lambda layout: layout.name)
def test_the_kernel_computes_the_same(layout: KeypointLayout) -> None:
    tree = KinematicTree(layout)
    points = np.random.default_rng(6).normal(size=(3000, len(layout), 3))
    pose = tree(points)
    directions = (tree._weights @ points)[:, len(tree) :]
    rotations, angles = np.empty((3000, len(tree), 3, 3)), np.zeros_like(pose.angles)
    tree._fill(directions, rotations, angles)
    np.testing.assert_allclose(pose.rotations, rotations[:, tree._frames], atol=1e-9)
    turn = np.abs(pose.angles - angles)
    assert np.minimum(turn, 2 * np.pi - turn).max() < 1e-6
    R = random_rotations(500, np.random.default_rng(7))
    R[0], R[1] = np.diag([1, -1, -1]), np.diag([-1, -1, 1])
    np.testing.assert_allclose(quaternions(R), _quaternions(R), atol=1e-12)


@pytest.mark.skipif(not kernel.AVAILABLE, reason="there is no kernel")
@pytest.mark.parametrize(("column", "value"), [(2, 99), (3, 20), (4, 99), (5, 4), (6, 99), (9, 99)])
def test_the_kernel_refuses_indices_out_of_range(column: int, value: int) -> None:
    compiled = TREE._compiled
    assert compiled
    indices, constants = compiled[0].copy(), compiled[1]
    indices[1, column] = value
    directions = np.zeros((1, len(TREE._weights) - len(TREE), 3))
    outputs = np.zeros((1, len(TREE), 3, 3)), np.zeros((1, len(TREE.angle_names)))
    with pytest.raises(ValueError, match="do not fit"):
        kernel._kernel.joint_frames(indices, constants, directions, *outputs, (1, len(TREE)))
