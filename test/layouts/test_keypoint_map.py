# SPDX-License-Identifier: Apache-2.0
"""Keypoints go from one layout to another by name."""

from __future__ import annotations

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import LAYOUTS

NOT_OF_HUMAN17 = {"cmu31", "hand21", "ap10k17"}
every_preset = pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)


def detections(source: KeypointLayout, n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points = rng.uniform(1, 1000, (n, len(source), 2)).astype(np.float32)
    confidence = rng.uniform(0.1, 1, points.shape[:2]).astype(np.float32)
    return points, confidence


@pytest.mark.parametrize("name", sorted(set(LAYOUTS) - NOT_OF_HUMAN17))
def test_maps_go_by_name(name: str) -> None:
    source = LAYOUTS[name]
    target = LAYOUTS["human17"]
    points, confidence = detections(source)
    mapped, sure = KeypointMap(source, target)(points, confidence)
    assert mapped.shape == (5, 17, 2) and mapped.dtype == sure.dtype == np.float32
    for t, keypoint in enumerate(target.keypoints):
        parts = target.derived.get(keypoint, ())
        if keypoint in source.keypoints:
            np.testing.assert_array_equal(mapped[:, t], points[:, source.index(keypoint)])
            np.testing.assert_array_equal(sure[:, t], confidence[:, source.index(keypoint)])
        elif parts:  # neck and mid-hip
            a, b = (source.index(part) for part in parts)
            np.testing.assert_allclose(mapped[:, t], (points[:, a] + points[:, b]) / 2)
            expected = np.minimum(confidence[:, a], confidence[:, b])
            np.testing.assert_array_equal(sure[:, t], expected)
        else:  # toes
            assert not sure[:, t].any() and not mapped[:, t].any()
    filled = {target.keypoints[t] for t in np.flatnonzero(sure.any(0))}
    assert set(KeypointMap(source, target).filled) == filled


def test_a_derived_point_is_missing_with_any_of_its_parts() -> None:
    source, target = LAYOUTS["coco17"], LAYOUTS["human17"]
    points, confidence = detections(source)
    hidden = source.index("left_hip")
    points[0, hidden] = confidence[0, hidden] = 0
    mapped, sure = KeypointMap(source, target)(points, confidence)
    at = target.index("mid_hip")
    assert sure[0, at] == 0 and not mapped[0, at].any()
    assert (sure[1:, at] > 0).all() and (sure[:, target.index("neck")] > 0).all()


def test_a_derived_point_needs_its_parts_in_the_source() -> None:
    source = KeypointLayout("headless", ("left_hip", "left_knee", "left_ankle", "nose"))
    mapped, sure = KeypointMap(source, LAYOUTS["human17"])(*detections(source))
    seen = {LAYOUTS["human17"].keypoints[t] for t in np.flatnonzero(sure.all(0))}
    assert seen == set(source.keypoints)


@pytest.mark.parametrize(
    ("source", "shown", "count"),
    [
        ("coco17", "nose left_shoulder right_shoulder", 3),
        ("coco17", "left_eye right_eye left_ear left_hip right_hip left_knee", 3),
        ("body25", "nose neck left_shoulder right_shoulder", 3),
        ("body25", "nose neck left_shoulder left_wrist", 4),
        ("human17", "nose neck mid_hip right_knee", 4),
    ],
)
def test_a_keypoint_that_follows_from_visible_ones_does_not_count(
    source: str, shown: str, count: int
) -> None:
    keypoint_map = KeypointMap(LAYOUTS[source], LAYOUTS["human17"])
    confidence = np.array([[name in shown.split() for name in LAYOUTS[source].keypoints]])
    points = np.ones((1, len(LAYOUTS[source]), 2), np.float32)
    _, mapped = keypoint_map(points, confidence.astype(np.float32))
    assert keypoint_map.detected_count(mapped > 0).tolist() == [count]


def test_a_keypoint_derived_from_what_the_target_lacks_does_not_count() -> None:
    target = KeypointLayout("t", (*"abcd", "head"), derived={"head": ("ear", "eye")})
    source = KeypointLayout("s", (*"abcd", "ear", "eye"))
    points, confidence = np.ones((1, 6, 2), np.float32), np.ones((1, 6), np.float32)
    keypoint_map = KeypointMap(source, target)
    assert keypoint_map.detected_count(keypoint_map(points, confidence)[1] > 0).tolist() == [4]


@every_preset
def test_points_of_the_same_layout_pass_unchanged(layout: KeypointLayout) -> None:
    points, confidence = detections(layout)
    mapped, sure = KeypointMap(layout, layout)(points, confidence)
    assert mapped is points and sure is confidence


@pytest.mark.parametrize("shared", [0, 3, 4])
def test_a_map_needs_four_shared_keypoints(shared: int) -> None:
    names = (*LAYOUTS["human17"].keypoints[2 : 2 + shared], "tail", "wing", "fin", "horn")  # limbs
    source = KeypointLayout("chimera", names)
    if shared < 4:
        with pytest.raises(ValueError, match=rf"'chimera'.*'human17'.*share {shared} "):
            KeypointMap(source, LAYOUTS["human17"])
    else:
        assert KeypointMap(source, LAYOUTS["human17"])(*detections(source))[1].any(0).sum() == 4
