"""Layouts are consistent, presets are in the order that detectors publish, maps go by name."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.keypoint_layout import (
    HUMAN17,
    LAYOUTS,
    KeypointLayout,
    KeypointMap,
    layout,
)

every_preset = pytest.mark.parametrize("preset", LAYOUTS.values(), ids=LAYOUTS)

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
def test_presets_are_in_the_order_that_detectors_publish(preset: KeypointLayout) -> None:
    assert len(preset) == COUNTS[preset.name]
    words = PLACES[preset.name].split()
    for place, name in zip(words[::2], words[1::2], strict=True):
        assert preset.keypoints[int(place)] == name
        assert preset.index(name) == int(place)


@every_preset
def test_presets_have_both_sides_of_everything(preset: KeypointLayout) -> None:
    sides = {"left_": "right_", "right_": "left_"}
    if preset.name == "cmu31":
        sides = {"l": "r", "r": "l"}
    central = {"root", "lowerback", "lowerneck"}

    def other_side(name: str) -> str:
        for prefix, replacement in sides.items():
            if name.startswith(prefix) and name not in central:
                return replacement + name.removeprefix(prefix)
        return name

    swapped = [other_side(name) for name in preset.keypoints]
    assert sorted(swapped) == sorted(preset.keypoints) and swapped != list(preset.keypoints)
    edges = {frozenset(edge) for edge in preset.edges}
    assert edges == {frozenset(map(other_side, edge)) for edge in edges}
    for left, right, _, _ in preset.handedness:
        assert other_side(left) == right
    assert all(first[0].startswith("l") for first in preset.handedness[:1])


@every_preset
def test_edges_are_pairs_of_places(preset: KeypointLayout) -> None:
    pairs = preset.edge_indices()
    assert pairs and len(set(map(frozenset, pairs))) == len(pairs)
    for (a, b), edge in zip(pairs, preset.edges, strict=True):
        assert a != b and (preset.keypoints[a], preset.keypoints[b]) == edge
    bones = preset.bone_indices()
    assert bones[: len(pairs)] == pairs and len(set(map(frozenset, bones))) == len(bones)
    assert len(bones) == len(pairs) + len(preset.rigid)


@pytest.mark.parametrize("name", ["human17", "cmu31"])
def test_layouts_of_models_know_their_hand_and_their_length(name: str) -> None:
    assert layout(name).handedness and layout(name).reference


def test_presets_go_by_name() -> None:
    assert all(layout(name).name == name for name in LAYOUTS)
    with pytest.raises(ValueError, match=r"'coco18'.*coco17"):
        layout("coco18")


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
    assert layout("human17").warning == ""
    assert "'points3' names no handedness" in KeypointLayout.numbered(3).warning


def test_unknown_keypoints_have_no_place() -> None:
    with pytest.raises(KeyError, match="points3.*'tail'"):
        KeypointLayout.numbered(3).index("tail")


def detections(source: KeypointLayout, n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points = rng.uniform(1, 1000, (n, len(source), 2)).astype(np.float32)
    confidence = rng.uniform(0.1, 1, points.shape[:2]).astype(np.float32)
    return points, confidence


@pytest.mark.parametrize("name", sorted(set(LAYOUTS) - {"cmu31"}))
def test_maps_go_by_name(name: str) -> None:
    preset = layout(name)
    target = layout("human17")
    points, confidence = detections(preset)
    mapped, sure = KeypointMap(preset, target)(points, confidence)
    assert mapped.shape == (5, 17, 2) and mapped.dtype == sure.dtype == np.float32
    for t, keypoint in enumerate(target.keypoints):
        parts = target.derived.get(keypoint, ())
        if keypoint in preset.keypoints:
            np.testing.assert_array_equal(mapped[:, t], points[:, preset.index(keypoint)])
            np.testing.assert_array_equal(sure[:, t], confidence[:, preset.index(keypoint)])
        elif parts:  # neck and mid-hip
            a, b = (preset.index(part) for part in parts)
            np.testing.assert_allclose(mapped[:, t], (points[:, a] + points[:, b]) / 2)
            expected = np.minimum(confidence[:, a], confidence[:, b])
            np.testing.assert_array_equal(sure[:, t], expected)
        else:  # toes
            assert not sure[:, t].any() and not mapped[:, t].any()


def test_a_derived_point_is_missing_with_any_of_its_parts() -> None:
    source, target = layout("coco17"), layout("human17")
    points, confidence = detections(source)
    hidden = source.index("left_hip")
    points[0, hidden] = confidence[0, hidden] = 0
    mapped, sure = KeypointMap(source, target)(points, confidence)
    at = target.index("mid_hip")
    assert sure[0, at] == 0 and not mapped[0, at].any()
    assert (sure[1:, at] > 0).all() and (sure[:, target.index("neck")] > 0).all()


def test_a_derived_point_needs_its_parts_in_the_source() -> None:
    source = KeypointLayout("headless", ("left_hip", "left_knee", "left_ankle", "nose"))
    mapped, sure = KeypointMap(source, layout("human17"))(*detections(source))
    seen = {layout("human17").keypoints[t] for t in np.flatnonzero(sure.all(0))}
    assert seen == set(source.keypoints)


@every_preset
def test_points_of_the_same_layout_pass_unchanged(preset: KeypointLayout) -> None:
    points, confidence = detections(preset)
    mapped, sure = KeypointMap(preset, preset)(points, confidence)
    assert mapped is points and sure is confidence


@pytest.mark.parametrize("shared", [0, 3, 4])
def test_a_map_needs_four_shared_keypoints(shared: int) -> None:
    names = (*layout("human17").keypoints[2 : 2 + shared], "tail", "wing", "fin", "horn")  # limbs
    source = KeypointLayout("chimera", names)
    if shared < 4:
        with pytest.raises(ValueError, match=rf"'chimera'.*'human17'.*share {shared} "):
            KeypointMap(source, layout("human17"))
    else:
        assert KeypointMap(source, layout("human17"))(*detections(source))[1].any(0).sum() == 4


def test_the_mirror_image_exchanges_left_and_right() -> None:
    names = ("left_hand", "nose", "right_hand", "left_over", "leftovers")
    handed = ("left_hand", "right_hand", "nose", "left_over")
    assert KeypointLayout("x", names, handedness=(handed,)).partners() == [2, 1, 0, 3, 4]
    assert KeypointLayout("x", names).partners() is None
    one_sided = KeypointLayout("x", names[1:], handedness=(names[1:],))
    assert one_sided.partners() is None
    partners = HUMAN17.partners()
    assert partners is not None and [partners[i] for i in partners] == list(range(17))
