# SPDX-License-Identifier: Apache-2.0
"""Detections of yolo_ros with lifted keypoints, by the definitions of its messages.

yolo_msgs is not on PyPI: messages are made, written and read by rosbags, by the definitions of
yolo_ros 4.6.
"""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN17
from deep_nrsfm_ros.lifting.lifter import Lifted
from deep_nrsfm_ros.lifting.options import LiftingOptions
from deep_nrsfm_ros.lifting.smoothing import SmoothingOptions
from deep_nrsfm_ros.messages.detections_3d import Lifted3D, add_keypoints
from deep_nrsfm_ros.messages.field_mapping import YOLO
from deep_nrsfm_ros.messages.options import InputOptions
from deep_nrsfm_ros.messages.pipeline import Pipeline
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.model_files.model_file import load_model
from test.fixtures.detector_messages import Detectors

KIND = "yolo_msgs/msg/DetectionArray"
SEEN = range(17)


def people() -> list[dict[str, Any]]:
    """Return two people, a chair without keypoints and a person of low score between them."""
    rng = np.random.default_rng(0)

    def person(name: str, seen: Any, score: float = 0.9) -> dict[str, Any]:
        points = np.column_stack([rng.uniform(50, 600, (17, 2)), np.full(17, 0.8)])
        return {"id": name, "points": points, "seen": seen, "score": score}

    return [person("7", SEEN), person("", ()), person("8", SEEN, 0.2), person("9", range(5, 17))]


def make_keypoint(recorded: Detectors) -> Any:
    """Return a KeyPoint3D of zeros, as rclpy makes it."""
    return recorded.make("yolo_msgs/KeyPoint3D")


def shapes(n: int, p: int) -> Lifted:
    rng = np.random.default_rng(1)
    return Lifted(
        (rng.standard_normal((n, p, 3)) + [0, 0, 4]).astype(np.float32),
        np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)),
        np.ones(n, np.float32),
        np.zeros((n, 2), np.float32),
        np.zeros(n, np.float32),
        rng.uniform(0.2, 1, (n, p)).astype(np.float32),
        np.zeros((n, p), np.bool_),
    )


def test_each_object_is_put_into_the_detection_that_it_was_lifted_from(recorded: Detectors) -> None:
    model = load_model("human17")
    pipeline = Pipeline(
        model, COCO17, InputOptions(min_score=0.5), LiftingOptions(), SmoothingOptions()
    )
    raw = bytes(recorded.store.serialize_cdr(recorded.detections(people()), KIND))
    decode: Any = partial(recorded.store.deserialize_cdr, typename=KIND)
    _, observation = pipeline.read(raw, MessageReader(YOLO.type, decode))
    assert observation.places == (0, 3) and observation.identities == ("7", "9")

    message, lifted = decode(raw), shapes(3, len(HUMAN17))  # smoothing keeps a third one
    found = Lifted3D("map", lifted, observation.places, pipeline.shared_keypoints)
    add_keypoints(message, found, partial(make_keypoint, recorded))
    sent = decode(bytes(recorded.store.serialize_cdr(message, KIND)))
    assert [d.id for d in sent.detections] == ["7", "9"]
    shared = [name for name in COCO17.keypoints if name in HUMAN17.keypoints]
    assert len(shared) > 10
    for row, detection in enumerate(sent.detections):
        assert detection.keypoints3d.frame_id == detection.bbox3d.frame_id == "map"
        assert len(detection.keypoints.data) == len(people()[3 * row]["seen"])  # as they came
        points = detection.keypoints3d.data
        assert [COCO17.keypoints[p.id - 1] for p in points] == shared
        ours = [HUMAN17.index(name) for name in shared]
        xyz = [(p.point.x, p.point.y, p.point.z) for p in points]
        np.testing.assert_array_equal(xyz, lifted.shapes[row, ours])
        np.testing.assert_array_equal([p.score for p in points], lifted.confidence[row, ours])
        centre, size = detection.bbox3d.center.position, detection.bbox3d.size
        middle = np.array([getattr(centre, k) for k in "xyz"])
        half = np.array([getattr(size, k) for k in "xyz"]) / 2
        np.testing.assert_allclose(middle - half, lifted.shapes[row].min(0), rtol=1e-6)
        np.testing.assert_allclose(middle + half, lifted.shapes[row].max(0), rtol=1e-6)


@pytest.mark.parametrize("lifted", [0, 1])
def test_detections_without_a_place_are_dropped(recorded: Detectors, lifted: int) -> None:
    message, objects = recorded.detections(people()), shapes(2, len(HUMAN17))
    objects.shapes[lifted:] = np.nan
    found = Lifted3D("map", objects, (0, 3), [(0, 0)])
    add_keypoints(message, found, partial(make_keypoint, recorded))
    assert [d.id for d in message.detections] == ["7"][:lifted]


def test_a_message_of_nobody_stays_empty() -> None:
    message = SimpleNamespace(detections=[])
    add_keypoints(message, Lifted3D("map", shapes(0, 17), (), []), SimpleNamespace)
    assert message.detections == []
