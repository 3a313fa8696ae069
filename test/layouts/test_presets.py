"""Presets are what they were written from, in the order that detectors publish."""

from __future__ import annotations

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
    "cmu31": "0 root 1 lhipjoint 5 ltoes 6 rhipjoint 10 rtoes 11 lowerback 16 head 17 lclavicle "
    "20 lwrist 23 lthumb 24 rclavicle 27 rwrist 30 rthumb",
    "human17": "0 left_shoulder 1 right_shoulder 12 neck 13 mid_hip 14 nose 15 left_big_toe",
}
COUNTS = {"human17": 17, "cmu31": 31, "coco17": 17, "body25": 25, "body25b": 25}
COUNTS |= {"openpose18": 18, "rep155": 18, "mediapipe33": 33}


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
    assert sorted(swapped) == sorted(layout.keypoints) and swapped != list(layout.keypoints)
    edges = {frozenset(edge) for edge in layout.edges}
    assert edges == {frozenset(map(other_side, edge)) for edge in edges}
    for left, right, _, _ in layout.handedness:
        assert other_side(left) == right
    assert all(first[0].startswith("l") for first in layout.handedness[:1])


@every_preset
def test_edges_are_pairs_of_places(layout: KeypointLayout) -> None:
    pairs = layout.edge_indices()
    assert pairs and len(set(map(frozenset, pairs))) == len(pairs)
    for (a, b), edge in zip(pairs, layout.edges, strict=True):
        assert a != b and (layout.keypoints[a], layout.keypoints[b]) == edge
    bones = layout.bone_indices()
    assert bones[: len(pairs)] == pairs and len(set(map(frozenset, bones))) == len(bones)
    assert len(bones) == len(pairs) + len(layout.rigid)


@pytest.mark.parametrize("name", ["human17", "cmu31"])
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
    assert layout == KeypointLayout(layout.name, **fields)


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
