# SPDX-License-Identifier: Apache-2.0
"""The field mappings in config/mappings read messages and bags of their detectors' definitions."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Writer

from deep_nrsfm_ros.data.bags import keypoint_count, read_bags
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, OPENPOSE18
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.decoding import count_keypoints, may_omit_keypoints, read_observation
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from deep_nrsfm_ros.messages.mapping_file import read_mapping

FOLDER = Path(__file__).parents[2] / "config" / "mappings"
SIDE = ("Shoulder", "Elbow", "Wrist")
LEG = ("Hip", "Knee", "Ankle")
JSK = (
    ["Nose", "Neck"]
    + [side + part for parts in (SIDE, LEG) for side in "RL" for part in parts]
    + ["REye", "LEye", "REar", "LEar"]
)


def shipped(name: str) -> FieldMapping:
    """Return a mapping of config/mappings."""
    return read_mapping(FOLDER / f"{name}.yaml")


def person(q: int, seed: int = 0) -> np.ndarray:
    """Return (q, 3) pixels with confidence."""
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(1, 900, (q, 2)), random.uniform(0.5, 1, q)])


def body(
    points: np.ndarray, code: int, identity: int = 1, available: bool = True
) -> dict[str, Any]:
    """Return a person of `Detectors.zed`."""
    return {"id": identity, "format": code, "points": points, "available": available}


@pytest.mark.parametrize(("code", "q"), [(0, 18), (1, 34), (2, 38)])
def test_zed_fills_as_many_places_as_the_format_says(detectors: Any, code: int, q: int) -> None:
    seen, other = person(q), person(q, 1)
    other[3, :2] = -1, -1
    other[4, :2] = 20, -7  # out of the picture
    nobody = body(np.zeros((q, 3)), code, available=False)
    message = detectors.zed([body(seen, code, 4), nobody, body(other, code, -1)])
    observation = read_observation(message, shipped("zed"), q)
    assert observation.identities == ("4", None)
    np.testing.assert_allclose(observation.points[0], seen[:, :2], rtol=1e-6)
    assert observation.confidence[0].all()
    np.testing.assert_array_equal(np.flatnonzero(observation.confidence[1] == 0), [3, 4])
    assert count_keypoints(message, shipped("zed")) == q and not may_omit_keypoints(shipped("zed"))
    with pytest.raises(MessageError, match=rf"{q} keypoints .* the keypoint layout has 17"):
        read_observation(message, shipped("zed"), 17)
    assert not len(read_observation(detectors.zed([nobody]), shipped("zed"), q).points)


def test_a_format_of_zed_that_is_unknown_is_named(detectors: Any) -> None:
    message = detectors.zed([body(person(18), 7)])
    with pytest.raises(MessageError, match=r"body_format is 7; counts .* has 0 \(18 keypoints\), "):
        read_observation(message, shipped("zed"), 18)


def test_one_body_of_another_format_does_not_refuse_the_others(detectors: Any) -> None:
    message = detectors.zed([body(person(34), 1, 5), body(person(18), 0, 6)])
    observation = read_observation(message, shipped("zed"), 18)
    assert observation.identities == ("6",)
    (reason,) = observation.left_out
    assert reason.startswith("an object is left out: message has 34 keypoints")


def test_the_confidence_of_zed_as_its_comment_says(detectors: Any, tmp_path: Path) -> None:
    lines = (FOLDER / "zed.yaml").read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("# x: "))
    kept = [line for line in lines[:start] if not line.startswith(("x:", "y:", "keypoints:"))]
    path = tmp_path / "zed.yaml"
    path.write_text("\n".join(kept + [line.removeprefix("# ") for line in lines[start:]]))
    seen = person(34)
    observation = read_observation(detectors.zed([body(seen, 1)]), read_mapping(path), 34)
    np.testing.assert_allclose(observation.points[0], seen[:, :2], rtol=1e-6)
    np.testing.assert_allclose(observation.confidence[0], seen[:, 2], rtol=1e-6)


def test_a_field_for_each_keypoint_of_trt_pose(detectors: Any) -> None:
    seen = person(18)
    seen[5, :2] = np.nan
    observation = read_observation(detectors.trt_pose(seen), shipped("ros2_trt_pose"), 18)
    np.testing.assert_array_equal(np.flatnonzero(observation.confidence[0] == 0), [5])
    np.testing.assert_allclose(observation.points[0, 6:], seen[6:, :2], rtol=1e-6)
    assert observation.identities == (None,)
    with pytest.raises(MessageError, match="18 keypoints .*layout has 17"):
        read_observation(detectors.trt_pose(seen), shipped("ros2_trt_pose"), 17)


def test_names_and_scores_of_jsk_in_lists_of_their_own(detectors: Any) -> None:
    seen = person(18)
    first = dict(zip(JSK, seen, strict=True))
    second = {"LEar": seen[17], "RHand3": seen[0], "Nose": seen[0]}
    message = detectors.people_poses([first, {}, second])
    observation = read_observation(message, shipped("jsk_people_pose"), 18)
    np.testing.assert_allclose(observation.points[0], seen[:, :2], rtol=1e-6)
    np.testing.assert_allclose(observation.confidence[0], seen[:, 2], rtol=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(observation.confidence[1]), [0, 17])
    np.testing.assert_allclose(observation.points[1, 17], seen[17, :2], rtol=1e-6)
    assert any("'RHand3'" in reason for reason in observation.left_out)
    with pytest.raises(MessageError, match="limb_names is 'left eye'; the mapping names Nose"):
        read_observation(
            detectors.people_poses([{"left eye": seen[0]}]), shipped("jsk_people_pose"), 18
        )


def test_yolov8_is_read_as_yolo(detectors: Any) -> None:
    seen = person(17)
    people = [{"id": "7", "points": seen, "seen": [0, 16]}]
    message = detectors.detections(people, "yolov8_msgs")
    observation = read_observation(message, shipped("yolov8"), 17)
    np.testing.assert_array_equal(np.flatnonzero(observation.confidence[0]), [0, 16])
    np.testing.assert_allclose(observation.points[0, 16], seen[16, :2], rtol=1e-6)
    assert observation.identities == ("7",)


@pytest.mark.parametrize("name", ["zed", "ros2_trt_pose", "jsk_people_pose", "yolov8"])
def test_bags_that_carry_the_definitions(tmp_path: Path, recorded: Any, name: str) -> None:
    layout = {"yolov8": COCO17, "zed": KeypointLayout("zed34", tuple(f"k{i}" for i in range(34)))}
    detector = layout.get(name, OPENPOSE18)
    people = [person(len(detector), seed) for seed in range(4)]
    mapping, kind = shipped(name), shipped(name).type.replace("/", "/msg/")
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/people", kind, typestore=recorded.store)
        for i, seen in enumerate(people):
            message = {
                "zed": lambda seen=seen: recorded.zed([body(seen, 1)]),
                "ros2_trt_pose": lambda seen=seen: recorded.trt_pose(seen),
                "jsk_people_pose": lambda seen=seen: recorded.people_poses(
                    [dict(zip(JSK, seen, strict=True))]
                ),
                "yolov8": lambda seen=seen: recorded.detections(
                    [{"id": "1", "points": seen, "seen": range(17)}], "yolov8_msgs"
                ),
            }[name]()
            writer.write(connection, i, recorded.store.serialize_cdr(message, kind))
    options = ReadOptions(mapping=mapping)
    reading = read_bags([tmp_path / "bag"], detector, detector, options)
    np.testing.assert_allclose(reading.dataset.points, np.stack(people)[..., :2], rtol=1e-5)
    assert keypoint_count([tmp_path / "bag"], options) == len(detector)
