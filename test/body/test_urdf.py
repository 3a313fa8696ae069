# SPDX-License-Identifier: Apache-2.0
"""URDF text: read by another library, its forward kinematics is that of the tree."""

from __future__ import annotations

import warnings
from xml.etree import ElementTree

import numpy as np
import pytest

from deep_nrsfm_ros.body.kinematic_tree import KinematicTree
from deep_nrsfm_ros.body.urdf import UrdfDrawing, rep155_name, urdf
from deep_nrsfm_ros.layouts.presets import HUMAN17
from test.fixtures.standing_person import random_angles, standing_person

TREE = KinematicTree(HUMAN17)
OFFSETS = TREE.offsets(TREE(standing_person()[None]))[0]
N = 20


def forward(angles: np.ndarray) -> np.ndarray:
    """Return the transforms (n, j, 4, 4) to the root by the tree."""
    n = len(angles)
    pose = TREE.forward(np.zeros((n, 3)), np.eye(3)[None].repeat(n, 0), angles, OFFSETS)
    T = np.tile(np.eye(4), (n, len(TREE), 1, 1))
    T[..., :3, :3], T[..., :3, 3] = pose.rotations, pose.origins
    return T


ANGLES = random_angles(TREE, N, np.random.default_rng(0))


def test_a_library_for_urdf_finds_the_frames_of_the_tree() -> None:
    kinpy = pytest.importorskip("kinpy")
    rename = rep155_name("a1b2")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        chain = kinpy.build_chain_from_urdf(urdf(TREE, OFFSETS, "person", rename))
    for angles, wanted in zip(ANGLES, forward(ANGLES), strict=True):
        names = map(rename, TREE.angle_names)
        found = chain.forward_kinematics(dict(zip(names, angles.tolist(), strict=True)))
        for name, T in zip(TREE.names, wanted, strict=True):
            np.testing.assert_allclose(found[rename(name)].matrix(), T, atol=2e-5)


def test_the_drawing_finds_the_frames_of_the_tree() -> None:
    drawing = UrdfDrawing(urdf(TREE, OFFSETS))
    assert drawing.root == "body" and set(drawing.angle_names) == set(TREE.angle_names)
    for angles, wanted in zip(ANGLES, forward(ANGLES), strict=True):
        frames = drawing.frames(dict(zip(TREE.angle_names, angles.tolist(), strict=True)))
        for name, T in zip(TREE.names, wanted, strict=True):
            np.testing.assert_allclose(frames[name], T, atol=2e-5)


def test_capsules_lie_on_the_bones() -> None:
    drawing = UrdfDrawing(urdf(TREE, OFFSETS))
    angles = dict(zip(TREE.angle_names, ANGLES[0].tolist(), strict=True))
    origins = dict(zip(TREE.names, forward(ANGLES[:1])[0, :, :3, 3], strict=True))
    found = [c for c in drawing.capsules(angles) if c.link == "left_shoulder"]
    arm, elbow = sorted(found, key=lambda c: -float(np.linalg.norm(c.end - c.start)))
    ends = {tuple(np.round(e, 3)) for e in (arm.start, arm.end)}
    wanted = {tuple(np.round(origins[name], 3)) for name in ("left_shoulder", "left_elbow")}
    assert ends == wanted
    np.testing.assert_allclose(elbow.start, origins["left_elbow"], atol=1e-4)
    np.testing.assert_array_equal(elbow.start, elbow.end)
    assert 0.01 < arm.radius < 0.1
    bones = sum(bool(np.linalg.norm(offset)) for offset in OFFSETS)
    assert len(drawing.capsules({})) == 2 * bones


def test_names_are_those_of_rep_155() -> None:
    rename = rep155_name("x7")
    assert [rename(n) for n in ("left_elbow", "body", "r_y_hip", "right_hip")] == [
        "l_elbow_x7",
        "body_x7",
        "r_y_hip_x7",
        "r_hip_x7",
    ]


@pytest.mark.parametrize("name", ["anna", 'a"b', "it's", "<&>", "a\tb\nc\rd", "\"'&"])
def test_a_name_is_read_as_it_was_written(name: str) -> None:
    assert ElementTree.fromstring(urdf(TREE, OFFSETS, name)).get("name") == name


def test_names_are_escaped() -> None:
    drawing = UrdfDrawing(urdf(TREE, OFFSETS, 'a"<b', rep155_name("<&>")))
    assert drawing.root == "body_<&>"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no URDF"),
        ("<robot><link name='a'/><link name='b'/></robot>", "2"),
        ("<!DOCTYPE x><robot/>", "document type"),
        ("<robot><link name='a'/><joint name='j' type='planar'/></robot>", "planar"),
    ],
)
def test_other_texts_are_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        UrdfDrawing(text)
