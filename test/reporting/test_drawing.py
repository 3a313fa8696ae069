# SPDX-License-Identifier: Apache-2.0
"""Colours of edges follow the sides that the names of keypoints say."""

from __future__ import annotations

import pytest

from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import HUMAN25
from deep_nrsfm_ros.reporting.drawing import COLOURS, MIDDLE, edge_colours

LEFT, RIGHT = COLOURS["left"], COLOURS["right"]


@pytest.mark.parametrize(
    ("a", "b", "colour"),
    [
        ("left_hip", "left_knee", LEFT),
        ("Shoulder_right", "Paw_right", RIGHT),
        ("Ear_L", "Nose", LEFT),  # the only edge of the left side at this keypoint
        ("Nose", "EarRight", RIGHT),
        ("left_hip", "right_hip", MIDDLE),
        ("Nose", "Tail_0", MIDDLE),
    ],
)
def test_an_edge_has_the_colour_of_its_side(a: str, b: str, colour: str) -> None:
    assert edge_colours(KeypointLayout("thing", (a, b), edges=((a, b),))) == [colour]


def test_an_edge_from_the_middle_to_a_limb_is_of_no_side() -> None:
    colours = dict(zip(HUMAN25.edges, edge_colours(HUMAN25), strict=True))
    assert {colours[edge] for edge in colours if {"neck", "mid_hip"} & set(edge)} == {MIDDLE}
    assert colours["left_shoulder", "left_elbow"] == LEFT
