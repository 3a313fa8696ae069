# SPDX-License-Identifier: Apache-2.0
"""The body that is drawn is where the lifted points are."""

from __future__ import annotations

import numpy as np

from deep_nrsfm_ros.body.kinematic_tree import KinematicTree
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17
from deep_nrsfm_ros.reporting.capsules import body_capsules
from test.fixtures.standing_person import (
    keypoints_of,
    random_angles,
    random_rotations,
    standing_person,
)

TREE = KinematicTree(HUMAN17)


def test_capsules_are_the_bones_of_each_frame() -> None:
    rng = np.random.default_rng(0)
    offsets = TREE.offsets(TREE(standing_person()[None]))[0]
    angles = random_angles(TREE, 4, rng)
    pose = TREE.forward(rng.normal(size=(4, 3)), random_rotations(4, rng), angles, offsets)
    shapes = keypoints_of(TREE, pose)
    shapes[2] = np.nan
    ends, radius = body_capsules(HUMAN17, shapes)
    assert 0.01 < radius < 0.1 and np.isnan(ends[2]).all()
    for a, b in (("left_elbow", "left_wrist"), ("right_hip", "right_knee")):
        bone = shapes[:, [HUMAN17.index(a), HUMAN17.index(b)]]
        off = np.linalg.norm(ends - bone[:, None], axis=-1).max(-1).min(-1)
        np.testing.assert_allclose(off[[0, 1, 3]], 0, atol=0.02)


def test_without_joints_or_answers_there_is_no_body() -> None:
    chair = KeypointLayout("chair", ("a", "b", "c", "d"))
    assert body_capsules(chair, np.zeros((3, 4, 3))).ends.shape == (3, 0, 2, 3)
    nothing = np.full((3, len(HUMAN17), 3), np.nan)
    assert body_capsules(HUMAN17, nothing).radius == 0
