# SPDX-License-Identifier: Apache-2.0
"""The figures of angles on poses whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.real import angles
from deep_nrsfm_ros.body.kinematic_tree import KinematicTree
from deep_nrsfm_ros.layouts.presets import HUMAN17
from test.fixtures.standing_person import keypoints_of, random_angles, standing_person

LIMBS = [HUMAN17.index(joint) for joint in angles.LIMBS.keypoints]
TREE = KinematicTree(HUMAN17)


def people(turned: np.ndarray) -> np.ndarray:
    """Return the limb joints (n, 12, 3) of people with these angles."""
    offsets = TREE.offsets(TREE(standing_person()[None]))[0]
    n = len(turned)
    pose = TREE.forward(np.zeros((n, 3)), np.eye(3)[None].repeat(n, 0), turned, offsets)
    return keypoints_of(TREE, pose)[:, LIMBS]


def test_an_elbow_that_is_wrong_by_10_degrees_is_the_only_error() -> None:
    true = random_angles(TREE, 300, np.random.default_rng(0))
    wrong = true.copy()
    for side in "lr":
        wrong[:, TREE.angle_names.index(f"{side}_elbow")] += np.radians(10)
    rows = dict(angles.angle_errors(KinematicTree(angles.LIMBS), people(wrong), people(true)))
    assert rows["elbow"]["median deg"] == pytest.approx(10, abs=0.1)
    assert rows["elbow"]["frame deg"] == pytest.approx(10, abs=0.1)
    assert rows["elbow"]["fixed deg"] > 20
    others = {name: row["median deg"] for name, row in rows.items() if name != "elbow"}
    assert max(others.values()) < 1 and "waist" not in others and "y_waist" in others


def test_a_person_without_bend_and_twist_is_closed_by_rep_155_alone() -> None:
    turned = random_angles(TREE, 200, np.random.default_rng(1))
    offsets = TREE.offsets(TREE(standing_person()[None]))[0]
    rows = []
    for bent in (1, 0):
        for name in ("r_waist", "y_waist"):
            turned[:, TREE.angle_names.index(name)] *= bent
        R = np.eye(3)[None].repeat(200, 0)
        pose = TREE.forward(np.zeros((200, 3)), R, turned, offsets)
        rows.append(angles.closure(TREE, keypoints_of(TREE, pose)))
    assert rows[0]["REP-155 alone %"] > 2 and rows[1]["REP-155 alone %"] < 0.4
    assert rows[0]["RMS %"] < 0.4 and rows[0]["poses"] == 200


def test_hinges_are_compared_with_the_angles_of_the_file() -> None:
    amc = np.array([0.0, 10, 20, 30, 40])
    row = angles.amc_errors(amc, amc + [0, 0, 0, 0, 2], amc - 3)
    assert row["truth deg"] == 0 and row["truth max deg"] == 2
    assert row["lifted deg"] == 3 and row["bias deg"] == -3
    assert row["fixed deg"] == 10 and row["frames"] == 5
