# SPDX-License-Identifier: Apache-2.0
"""Kinematic trees in layout files: what they may say, and what is refused by name."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.body.kinematic_tree import KinematicTree
from deep_nrsfm_ros.layouts.joints import direction_vector, joints_from_json
from deep_nrsfm_ros.layouts.layout_file import LayoutFileError, read_layout
from deep_nrsfm_ros.layouts.presets import HUMAN25
from deep_nrsfm_ros.model_files.model_file import load_model

HAND = Path(__file__).parents[2] / "config" / "layouts" / "hand.yaml"
ROOT = "base: {at: a, up: [a, b], left: [a, c]}"
START = "name: thing\nkeypoints: [a, b, c, d]\njoints:\n  "


def test_a_finger_of_the_example_bends_to_the_front() -> None:
    layout = read_layout(HAND)
    tree = KinematicTree(layout)
    points = np.zeros((1, len(layout), 3))
    places = {"middle_mcp": (0, 0, -9), "pinky_mcp": (0, 4, -8), "index_mcp": (0, -2, -9)}
    places |= {"index_pip": (0, -2, -13), "index_dip": (2, -2, -13), "index_tip": (3, -2, -12)}
    for name, place in places.items():
        points[0, layout.index(name)] = place
    angles = dict(zip(tree.angle_names, np.degrees(tree(points).angles[0]), strict=True))
    wanted = {"index_spread": 0, "index_bend": 0, "index_middle_bend": 90, "index_end_bend": 45}
    assert angles == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize(
    ("joints", "reason"),
    [
        ("base: {at: e, up: [a, b], left: [a, c]}", "no keypoint 'e'"),
        ("base: {at: a, up: [a, b]}", "root: its frame needs two directions"),
        ("base: {at: a, up: [a, b], left: [a, e]}", "'e', which is neither a keypoint nor a joint"),
        ("base: {at: a, upward: [a, b], left: [a, c]}", "'upward' is not made of front"),
        ("base: {up: [a, b]}", "joints.base lacks the field 'at'"),
        (f"{ROOT}\n  arm: {{at: b}}", "only it has no parent"),
        (f"{ROOT}\n  arm: {{at: b, parent: leg}}", "'leg' is not a joint before it"),
        (f"{ROOT}\n  arm: {{at: b, parent: base, angles: {{x: left}}}}", "no direction"),
        (
            f"{ROOT}\n  arm: {{at: b, parent: base, up: [b, d], angles: {{x: up}}}}",
            "does not move by x",
        ),
        (f"{ROOT}\n  arm: {{at: b, parent: base, up: [b, d], angles: {{x: odd}}}}", "axis 'odd'"),
        (f"{ROOT}\n  arm: {{at: b, parent: base, max_twist: 0}}", "must be in degrees"),
        ("people", "joints is 'base"),
    ],
)
def test_a_wrong_tree_is_refused(tmp_path: Path, joints: str, reason: str) -> None:
    path = tmp_path / "thing.yaml"
    text = START + joints + "\n" if joints != "people" else START.replace(":\n  ", ": 'base'\n")
    path.write_text(text)
    with pytest.raises(LayoutFileError) as caught:
        read_layout(path)
    assert reason in str(caught.value)


def test_joints_survive_the_header_of_a_model() -> None:
    def tuples(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: tuples(item) for key, item in value.items()}
        return tuple(map(tuples, value)) if isinstance(value, list) else value

    stored = json.loads(json.dumps([dataclasses.asdict(joint) for joint in HUMAN25.joints]))
    assert joints_from_json(tuples(stored)) == HUMAN25.joints == load_model("human").layout.joints
    stored[0]["name"] = 3
    with pytest.raises(ValueError, match="no texts"):
        joints_from_json(tuples(stored))


def test_directions_are_sums_of_words() -> None:
    assert direction_vector("front up") == pytest.approx((2**-0.5, 0, 2**-0.5))
    with pytest.raises(ValueError, match="cancels itself"):
        direction_vector("up down")
