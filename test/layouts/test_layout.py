# SPDX-License-Identifier: Apache-2.0
"""Layouts are consistent: they name only keypoints that they have."""

from __future__ import annotations

import pytest

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN17


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"keypoints": ("a", "b", "a")}, "a more than once"),
        ({"edges": (("a", "x"),)}, "no keypoint 'x'"),
        ({"rigid": (("a", "x"),)}, "no keypoint 'x'"),
        ({"rigid": (("b", "b"),)}, "rigid pair .* repeats a name"),
        ({"handedness": (("a", "b", "c", "x"),)}, "no keypoint 'x'"),
        ({"handedness": ("a", "b", "c", "x")}, "handedness 'a' must be 4 names"),
        ({"reference": ("x", "a")}, "no keypoint 'x'"),
        ({"derived": {"x": ("a", "b")}}, "no keypoint 'x'"),
        ({"derived": {"a": ()}}, "'a' is a mean of no names"),
        ({"edges": (("a", "a"),)}, "repeats a name"),
        ({"reference_length": 1.0}, "name reference"),
        ({"reference": ("a", "b"), "reference_length": -1.0}, "-1.0, not above 0 m"),
    ],
)
def test_a_layout_names_what_it_has(fields: dict[str, tuple[str, ...]], complaint: str) -> None:
    with pytest.raises(ValueError, match=f"'thing'.*{complaint}"):
        KeypointLayout(**({"name": "thing", "keypoints": ("a", "b", "c")} | fields))  # type: ignore[arg-type]


def test_only_a_layout_without_handedness_warns() -> None:
    assert HUMAN17.warning == ""
    assert "'points3' names no handedness" in KeypointLayout.numbered(3).warning


def test_unknown_keypoints_have_no_place() -> None:
    with pytest.raises(KeyError, match="points3.*'tail'"):
        KeypointLayout.numbered(3).index("tail")


def test_the_mirror_image_exchanges_left_and_right() -> None:
    names = ("left_hand", "nose", "right_hand", "left_over", "leftovers")
    handed = ("left_hand", "right_hand", "nose", "left_over")
    assert KeypointLayout("x", names, handedness=(handed,)).partners() == [2, 1, 0, 3, 4]
    assert KeypointLayout("x", names).partners() is None
    one_sided = KeypointLayout("x", names[1:], handedness=(names[1:],))
    assert one_sided.partners() is None
    partners = HUMAN17.partners()
    assert partners is not None and [partners[i] for i in partners] == list(range(17))


@pytest.mark.parametrize(
    ("left", "right", "exchanged"),
    [
        ("right_wing", "left_wing", True),
        ("wing.R", "wing.L", True),
        ("WristR", "WristL", True),
        ("left_wing", "right_wing", False),
        ("left_wing", "beak", False),
        ("right_wing", "beak", False),  # one name alone may mean another side
        ("bright", "cleft", False),
    ],
)
def test_sides_against_the_names_of_the_keypoints_are_warned_of(
    left: str, right: str, exchanged: bool
) -> None:
    keypoints = (left, right, "back", "front")
    warning = KeypointLayout("bird", keypoints, handedness=(keypoints,)).warning
    assert bool(warning) == exchanged
    assert not exchanged or f"left: {left} and right: {right}" in warning
