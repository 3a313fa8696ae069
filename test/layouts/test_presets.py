# SPDX-License-Identifier: Apache-2.0
"""Presets are what they were written from, in the order that detectors publish."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from deep_nrsfm_ros.layouts import presets
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.layout_file import read_layout
from deep_nrsfm_ros.layouts.presets import HUMAN17, LAYOUTS, preset

every_preset = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
FOLDER = Path(presets.__file__).parent
EXPECTED = json.loads(Path(__file__).with_name("presets.json").read_text())

# Places that the detectors document.
PLACES = {
    "coco17": "0 nose 1 left_eye 4 right_ear 5 left_shoulder 6 right_shoulder 9 left_wrist "
    "11 left_hip 14 right_knee 16 right_ankle",
    "body25": "0 nose 1 neck 2 right_shoulder 4 right_wrist 5 left_shoulder 7 left_wrist 8 mid_hip "
    "9 right_hip 11 right_ankle 12 left_hip 14 left_ankle 15 right_eye 16 left_eye 17 right_ear "
    "18 left_ear 19 left_big_toe 20 left_small_toe 21 left_heel 22 right_big_toe 24 right_heel",
    "openpose18": "0 nose 1 neck 2 right_shoulder 4 right_wrist 5 left_shoulder 8 right_hip "
    "10 right_ankle 11 left_hip 13 left_ankle 14 right_eye 15 left_eye 16 right_ear 17 left_ear",
    "rep155": "0 nose 1 neck 2 right_shoulder 4 right_wrist 5 left_shoulder 8 right_hip "
    "10 right_ankle 11 left_hip 13 left_ankle 14 left_eye 15 right_eye 16 left_ear 17 right_ear",
    "body25b": "0 nose 1 left_eye 4 right_ear 5 left_shoulder 6 right_shoulder 7 left_elbow "
    "9 left_wrist 10 right_wrist 11 left_hip 12 right_hip 13 left_knee 16 right_ankle "
    "17 upper_neck 18 head_top 19 left_big_toe 21 left_heel 22 right_big_toe 24 right_heel",
    "mediapipe33": "0 nose 2 left_eye 5 right_eye 7 left_ear 8 right_ear 9 left_mouth "
    "11 left_shoulder 12 right_shoulder 13 left_elbow 16 right_wrist 17 left_pinky 19 left_index "
    "22 right_thumb 23 left_hip 24 right_hip 25 left_knee 28 right_ankle 29 left_heel "
    "30 right_heel 31 left_big_toe 32 right_big_toe",
    "mediapipe75": "0 nose 11 left_shoulder 32 right_big_toe 33 left_hand_wrist 37 left_thumb_tip "
    "54 right_hand_wrist 74 right_pinky_tip",
    "cmu31": "0 root 1 lhipjoint 5 ltoes 6 rhipjoint 10 rtoes 11 lowerback 16 head 17 lclavicle "
    "20 lwrist 23 lthumb 24 rclavicle 27 rwrist 30 rthumb",
    "halpe26": "0 nose 1 left_eye 5 left_shoulder 10 right_wrist 16 right_ankle 17 head_top "
    "18 neck 19 mid_hip 20 left_big_toe 21 right_big_toe 22 left_small_toe 24 left_heel "
    "25 right_heel",
    "halpe136": "0 nose 19 mid_hip 25 right_heel 26 right_jaw_1 34 chin 42 left_jaw_1 "
    "56 nose_tip 62 right_eye_outer 71 left_eye_outer 93 right_inner_lower_lip 94 left_hand_wrist "
    "95 left_thumb_cmc 114 left_pinky_tip 115 right_hand_wrist 119 right_thumb_tip "
    "135 right_pinky_tip",
    "coco_wholebody133": "0 nose 16 right_ankle 17 left_big_toe 18 left_small_toe 19 left_heel "
    "20 right_big_toe 22 right_heel 23 right_jaw_1 31 chin 39 left_jaw_1 40 right_brow_1 "
    "49 left_brow_1 53 nose_tip 59 right_eye_outer 68 left_eye_outer 71 right_mouth 77 left_mouth "
    "91 left_hand_wrist 92 left_thumb_cmc 96 left_index_mcp 111 left_pinky_tip "
    "112 right_hand_wrist 132 right_pinky_tip",
    "mpii16": "0 right_ankle 2 right_hip 3 left_hip 5 left_ankle 6 pelvis 7 thorax 8 upper_neck "
    "9 head_top 10 right_wrist 12 right_shoulder 13 left_shoulder 15 left_wrist",
    "h36m17": "0 pelvis 1 right_hip 3 right_ankle 4 left_hip 6 left_ankle 7 spine 8 thorax "
    "9 neck_base 10 head 11 left_shoulder 13 left_wrist 14 right_shoulder 16 right_wrist",
    "crowdpose14": "0 left_shoulder 1 right_shoulder 4 left_wrist 6 left_hip 11 right_ankle "
    "12 head_top 13 neck",
    "openpose135": "0 nose 9 left_wrist 17 upper_neck 18 head_top 24 right_heel 25 left_thumb_cmc "
    "44 left_pinky_tip 45 right_thumb_cmc 64 right_pinky_tip 65 right_jaw_1 73 chin "
    "132 right_inner_lower_lip 133 right_pupil 134 left_pupil",
    "hand21": "0 wrist 1 thumb_cmc 4 thumb_tip 5 index_mcp 8 index_tip 12 middle_tip 16 ring_tip "
    "17 pinky_mcp 20 pinky_tip",
    "ap10k17": "0 left_eye 1 right_eye 2 nose 3 neck 4 tail_root 5 left_front_shoulder "
    "7 left_front_paw 8 right_front_shoulder 10 right_front_paw 11 left_back_hip 13 left_back_paw "
    "14 right_back_hip 16 right_back_paw",
    "posetrack15": "0 right_ankle 2 right_hip 3 left_hip 5 left_ankle 6 right_wrist "
    "8 right_shoulder 9 left_shoulder 11 left_wrist 12 upper_neck 13 nose 14 head_top",
    "posetrack18_17": "0 nose 1 upper_neck 2 head_top 3 left_ear 5 left_shoulder 16 right_ankle",
    "zed18": "0 nose 1 neck 2 right_shoulder 5 left_shoulder 8 right_hip 13 left_ankle "
    "14 right_eye 15 left_eye 17 left_ear",
    "zed34": "0 pelvis 3 neck 4 left_clavicle 5 left_shoulder 7 left_wrist 10 left_thumb "
    "11 right_clavicle 17 right_thumb 18 left_hip 21 left_foot 22 right_hip 25 right_foot 26 head "
    "27 nose 28 left_eye 29 left_ear 30 right_eye 31 right_ear 32 left_heel 33 right_heel",
    "zed38": "0 pelvis 3 spine_3 4 neck 5 nose 6 left_eye 9 right_ear 10 left_clavicle "
    "12 left_shoulder 17 right_wrist 18 left_hip 23 right_ankle 24 left_big_toe 29 right_heel "
    "30 left_thumb_tip 32 left_index_mcp 34 left_middle_tip 37 right_pinky_mcp",
    "human17": "0 left_shoulder 1 right_shoulder 12 neck 13 mid_hip 14 nose 15 left_big_toe",
    "human25": "0 left_shoulder 12 neck 16 right_big_toe 17 left_eye 19 left_ear 21 left_heel "
    "24 right_small_toe",
}
COUNTS = {"human17": 17, "human25": 25, "cmu31": 31, "coco17": 17, "body25": 25, "body25b": 25}
COUNTS |= {"openpose18": 18, "rep155": 18, "mediapipe33": 33, "mediapipe75": 75}
COUNTS |= {"halpe26": 26, "halpe136": 136, "coco_wholebody133": 133, "mpii16": 16, "h36m17": 17}
COUNTS |= {"crowdpose14": 14, "openpose135": 135, "hand21": 21, "ap10k17": 17, "posetrack15": 15}
COUNTS |= {"posetrack18_17": 17, "zed18": 18, "zed34": 34, "zed38": 38}

# Pairs of the 68 points of a face that change places in a mirror, as MMPose documents them.
FACE_PAIRS = {i: 16 - i for i in range(17)} | {i: 43 - i for i in range(17, 27)}
FACE_PAIRS |= {i: i for i in range(27, 31)} | {i: 66 - i for i in range(31, 36)}
FACE_PAIRS |= {36: 45, 37: 44, 38: 43, 39: 42, 40: 47, 41: 46}
FACE_PAIRS |= {i: 102 - i for i in range(48, 55)} | {i: 114 - i for i in range(55, 60)}
FACE_PAIRS |= {i: 124 - i for i in range(60, 65)} | {i: 132 - i for i in range(65, 68)}


@every_preset
def test_presets_are_in_the_order_that_detectors_publish(layout: KeypointLayout) -> None:
    assert len(layout) == COUNTS[layout.name]
    words = PLACES[layout.name].split()
    for place, name in zip(words[::2], words[1::2], strict=True):
        assert layout.keypoints[int(place)] == name
        assert layout.index(name) == int(place)


@every_preset
def test_presets_have_both_sides_of_everything(layout: KeypointLayout) -> None:
    sides = {"left_": "right_", "right_": "left_"}
    if layout.name == "cmu31":
        sides = {"l": "r", "r": "l"}
    central = {"root", "lowerback", "lowerneck"}

    def other_side(name: str) -> str:
        for prefix, replacement in sides.items():
            if name.startswith(prefix) and name not in central:
                return replacement + name.removeprefix(prefix)
        return name

    swapped = [other_side(name) for name in layout.keypoints]
    assert sorted(swapped) == sorted(layout.keypoints)
    assert (swapped != list(layout.keypoints)) == (layout.name != "hand21")  # of either side
    edges = {frozenset(edge) for edge in layout.edges}
    assert edges == {frozenset(map(other_side, edge)) for edge in edges}
    if layout.name == "hand21":  # of one side; its left is the little finger
        return
    for left, right, _, _ in layout.handedness:
        assert other_side(left) == right
    assert all(first[0].startswith("l") for first in layout.handedness[:1])


@pytest.mark.parametrize(
    ("name", "start"), [("halpe136", 26), ("coco_wholebody133", 23), ("openpose135", 65)]
)
def test_faces_are_in_the_order_of_68_points(name: str, start: int) -> None:
    face = preset(name).keypoints[start : start + 68]
    for i, j in FACE_PAIRS.items():
        mirrored = {"left": "right", "right": "left"}.get(face[i].split("_")[0], "")
        assert face[j] == (f"{mirrored}_{face[i].partition('_')[2]}" if mirrored else face[i])
    assert all(face[i].startswith("right_") for i in (*range(8), *range(17, 22), *range(36, 42)))


def test_layouts_that_contain_others() -> None:
    assert preset("halpe136").keypoints[:26] == preset("halpe26").keypoints
    assert preset("coco_wholebody133").keypoints[:17] == preset("coco17").keypoints
    assert preset("halpe26").keypoints[:17] == preset("coco17").keypoints
    assert preset("human25").keypoints[:17] == preset("human17").keypoints
    assert set(preset("human25").keypoints) == set(preset("body25").keypoints)
    assert preset("openpose135").keypoints[:25] == preset("body25b").keypoints
    assert preset("zed18").keypoints == preset("openpose18").keypoints
    hand = preset("hand21").keypoints[1:]
    for name, starts in {"halpe136": (95, 116), "coco_wholebody133": (92, 113)}.items():
        for side, start in zip(("left", "right"), starts, strict=True):
            fingers = tuple(f"{side}_{keypoint}" for keypoint in hand)
            assert preset(name).keypoints[start : start + 20] == fingers


def test_the_example_of_a_layout_file_is_the_preset_of_a_hand() -> None:
    example = read_layout(Path(__file__).parents[2] / "config" / "layouts" / "hand.yaml")
    assert example.keypoints == preset("hand21").keypoints
    assert example.edges == preset("hand21").edges
    assert example.handedness and example.reference_length


@every_preset
def test_edges_are_pairs_of_places(layout: KeypointLayout) -> None:
    pairs = layout.edge_indices()
    assert pairs and len(set(map(frozenset, pairs))) == len(pairs)
    for (a, b), edge in zip(pairs, layout.edges, strict=True):
        assert a != b and (layout.keypoints[a], layout.keypoints[b]) == edge
    bones = layout.bone_indices()
    assert bones[: len(pairs)] == pairs and len(set(map(frozenset, bones))) == len(bones)
    assert len(bones) == len(pairs) + len(layout.rigid)


@pytest.mark.parametrize("name", ["human17", "human25", "cmu31"])
def test_layouts_of_models_know_their_hand_and_their_length(name: str) -> None:
    assert preset(name).handedness and preset(name).reference


def test_presets_go_by_name() -> None:
    assert all(preset(name).name == name for name in LAYOUTS)
    with pytest.raises(ValueError, match=r"'coco18'.*coco17"):
        preset("coco18")


def tuples(value: object) -> object:
    return tuple(map(tuples, value)) if isinstance(value, list) else value


@every_preset
def test_a_preset_says_all_that_it_should(layout: KeypointLayout) -> None:
    fields: dict[str, Any] = {name: tuples(value) for name, value in EXPECTED[layout.name].items()}
    derived = EXPECTED[layout.name]["derived"].items()
    fields["derived"] = {name: tuple(parts) for name, parts in derived}
    assert dataclasses.replace(layout, joints=()) == KeypointLayout(layout.name, **fields)


@every_preset
def test_every_person_has_a_kinematic_tree(layout: KeypointLayout) -> None:
    names = [joint.name for joint in layout.joints]
    angles = [name for joint in layout.joints for name, _ in joint.angles]
    person = {"left_hip", "left_wrist"} <= set(layout.keypoints)
    assert person == ("left_elbow" in names) == ("l_elbow" in angles) == ("r_y_hip" in angles)
    assert ("y_head" in angles) == (person and "nose" in layout.keypoints)
    assert ("l_p_foot" in angles) == (person and "left_big_toe" in layout.keypoints)


def test_every_file_is_a_preset_and_explains_itself() -> None:
    files = {path.stem: path for path in FOLDER.glob("*.yaml")}
    assert set(files) == set(LAYOUTS) == set(EXPECTED)
    for name, path in files.items():
        assert read_layout(path) == LAYOUTS[name]
        header = path.read_text().split("name:")[0]
        assert all(line.startswith("# ") for line in header.splitlines())
        assert "keypoints" in header and "Source: " in header


def test_a_preset_is_one_object_whatever_gives_it() -> None:
    assert HUMAN17 is presets.HUMAN17 is preset("human17") is LAYOUTS["human17"]
    with pytest.raises(AttributeError, match="HUMAN18"):
        _ = presets.HUMAN18
    with pytest.raises(KeyError):
        LAYOUTS["human18"]
    assert "human18" not in LAYOUTS and len(LAYOUTS) == len(EXPECTED)


def test_no_file_is_read_before_its_preset_is_used() -> None:
    code = (
        "from deep_nrsfm_ros.layouts import presets; assert 'coco17' in presets.LAYOUTS\n"
        "list(presets.LAYOUTS); assert presets.preset.cache_info().currsize == 0\n"
        "presets.COCO17; assert presets.preset.cache_info().currsize == 1"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
