# SPDX-License-Identifier: Apache-2.0
"""Names of keypoints are matched whatever their spelling; equal ones come first."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS
from deep_nrsfm_ros.layouts.spelling import match_names

SPELLINGS = ("left_ear", "EarL", "Ear_L", "ear_left", "Left Ear", "earLeft", "LEar", "left-ear")


@pytest.mark.parametrize(("name", "wanted"), list(itertools.permutations(SPELLINGS, 2)))
def test_spellings_of_one_name_match(name: str, wanted: str) -> None:
    assert match_names(["nose", name], ["tail", wanted]) == {wanted: 1}


@pytest.mark.parametrize(
    ("names", "wanted", "expected"),
    [
        (["left_wrist", "wristL"], ["wristL", "left_wrist"], {"wristL": 1, "left_wrist": 0}),
        (["wrist_l"], ["left_wrist", "wristL"], {"wristL": 0}),
        (["rear", "front"], ["left_ear", "right_ear"], {}),
        (["Haunch_left"], ["left_haunch"], {"left_haunch": 0}),
        (["l_sho"], ["left_shoulder"], {"left_shoulder": 0}),
        (["finger_1_2"], ["finger_12"], {}),
        (["finger1_2"], ["Finger_1_2"], {"Finger_1_2": 0}),
        (["鼻"], ["耳"], {}),
        (["Öhr L"], ["öhr_l"], {"öhr_l": 0}),
        (["+", "-"], ["*", "/"], {}),
        (["left", "right"], ["links", "rechts"], {}),
        (["ear_l", "EarL"], ["left_ear"], {}),
    ],
)
def test_only_what_is_clear_matches(
    names: list[str], wanted: list[str], expected: dict[str, int]
) -> None:
    assert match_names(names, wanted) == expected


def test_between_presets_equal_names_are_all() -> None:
    for source, target in itertools.permutations(LAYOUTS.values(), 2):
        found = match_names(source.keypoints, target.keypoints)
        other = set(found) - set(source.keypoints)
        assert other <= {"upper_neck", "upperneck"}  # of cmu31, which no detector gives


def test_a_map_reads_the_spelling_of_the_detector() -> None:
    mouse = KeypointLayout(
        "mouse", ("Nose", "EarL", "EarR", "Tail", "Mid"), derived={"Mid": ("EarL", "EarR")}
    )
    detector = KeypointLayout("detector", ("tail", "left_ear", "right_ear", "nose"))
    points = np.arange(8, dtype=np.float32).reshape(1, 4, 2) + 1
    mapped, sure = KeypointMap(detector, mouse)(points, np.ones((1, 4), np.float32))
    assert sure.all()
    np.testing.assert_array_equal(mapped[0, :4], points[0, [3, 1, 2, 0]])
    np.testing.assert_array_equal(mapped[0, 4], points[0, [1, 2]].mean(0))
