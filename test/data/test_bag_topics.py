"""Bags of detectors' own messages, read by the definitions that they carry."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from deep_nrsfm_ros.data.bag_files import BagError
from deep_nrsfm_ros.data.bags import keypoint_count, read_bags
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN17, REP155
from deep_nrsfm_ros.messages.field_mapping import FieldMapping

ANIMAL = KeypointLayout("animal", ("head", "tail", "paw", "ear"))
MAPPING = FieldMapping(
    "my_msgs/Animals",
    objects="found",
    identity="number",
    keypoints="joints",
    x="place.u",
    y="place.v",
    keypoint_id="label",
    names=ANIMAL.keypoints,
)


def write(path: Path, maker: Any, topics: dict[str, tuple[str, list[Any]]], **made: Any) -> Path:
    """Write a bag: topic -> (type, messages)."""
    with Writer(path, version=9, **made) as writer:
        for topic, (kind, messages) in topics.items():
            name = kind.replace("/", "/msg/")
            connection = writer.add_connection(topic, name, typestore=maker.store)
            for i, message in enumerate(messages):
                writer.write(connection, i, maker.store.serialize_cdr(message, name))
    return path


def people(frames: int, q: int) -> np.ndarray:
    """Return (frames, q, 3) pixels with confidence."""
    random = np.random.default_rng(0)
    return np.concatenate(
        [random.uniform(1, 900, (frames, q, 2)), random.uniform(0.5, 1, (frames, q, 1))], -1
    )


def yolo_bag(path: Path, maker: Any, given: np.ndarray, **made: Any) -> Path:
    """Write detections that lack the last keypoint but in the first message."""
    messages = [
        maker.detections([{"id": "1", "points": p, "seen": range(17 if i == 0 else 16)}])
        for i, p in enumerate(given)
    ]
    return write(path, maker, {"/yolo": ("yolo_msgs/DetectionArray", messages)}, **made)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_detections_of_yolo(tmp_path: Path, recorded: Any, storage: StoragePlugin) -> None:
    given = people(20, 17)
    bag = yolo_bag(tmp_path / "bag", recorded, given, storage_plugin=storage)
    (file,) = (f for f in bag.iterdir() if f.suffix != ".yaml")
    for path in (bag, file):
        reading = read_bags([path], COCO17, HUMAN17)
        assert reading.unreadable == 0
        points, confidence = given[..., :2].astype(np.float32), given[..., 2].astype(np.float32)
        points[1:, 16] = confidence[1:, 16] = 0
        points, confidence = KeypointMap(COCO17, HUMAN17)(points, confidence)
        np.testing.assert_allclose(reading.dataset.points, points, rtol=1e-6)
        np.testing.assert_array_equal(reading.dataset.visible, confidence > 0)
    assert keypoint_count([bag], ReadOptions("/yolo")) == 17


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_bag_that_was_cut_off_keeps_its_definitions(
    tmp_path: Path, recorded: Any, storage: StoragePlugin
) -> None:
    bag = yolo_bag(tmp_path / "bag", recorded, people(400, 17), storage_plugin=storage)
    (file,) = (f for f in bag.iterdir() if f.suffix != ".yaml")
    # An mcap file of this size is one piece and an index.
    lost = 300 if storage == StoragePlugin.MCAP else file.stat().st_size // 3
    file.write_bytes(file.read_bytes()[:-lost])
    (bag / "metadata.yaml").unlink()
    reading = read_bags([bag], COCO17, HUMAN17, ReadOptions("/yolo"))
    assert 100 < len(reading.dataset) <= 400 and reading.warnings


def test_bodies_of_several_topics(tmp_path: Path, recorded: Any) -> None:
    given = people(6, 18) / [1000, 1000, 1]
    kind = "hri_msgs/Skeleton2D"
    topics = {
        f"/humans/bodies/{name}/skeleton2d": (kind, [recorded.skeleton(p) for p in part])
        for name, part in (("a", given[:4]), ("b", given[4:]))
    }
    bag = write(tmp_path / "bag", recorded, topics)
    pattern = "/humans/bodies/*/skeleton2d"
    reading = read_bags([bag], REP155, REP155, ReadOptions(pattern, image_size=(640, 480)))
    expected = given[..., :2] * [640, 480]
    np.testing.assert_allclose(reading.dataset.points, expected, rtol=1e-5)
    with pytest.raises(BagError, match="2 keypoint topics; name one of"):
        read_bags([bag], REP155, REP155)
    with pytest.raises(BagError, match="size of the image is needed"):
        read_bags([bag], REP155, REP155, ReadOptions(pattern))
    assert keypoint_count([bag], ReadOptions(pattern)) == 18


def test_a_type_of_ones_own_by_its_mapping(tmp_path: Path, recorded: Any) -> None:
    joints = {"paw": (1.0, 2.0), "head": (3.0, 4.0), "tail": (5.0, 6.0), "ear": (7.0, 8.0)}
    messages = [recorded.animals([(1, joints), (2, joints)])] * 3
    bag = write(tmp_path / "bag", recorded, {"/farm": ("my_msgs/Animals", messages)})
    for topic in ("", "/farm"):
        dataset = read_bags([bag], ANIMAL, ANIMAL, ReadOptions(topic, mapping=MAPPING)).dataset
        np.testing.assert_array_equal(dataset.points, [[[3, 4], [5, 6], [1, 2], [7, 8]]] * 6)
    assert keypoint_count([bag], ReadOptions(mapping=MAPPING)) == 4
    with pytest.raises(BagError, match=r"/farm .* type my_msgs/Animals; .* field mapping"):
        read_bags([bag], ANIMAL, ANIMAL, ReadOptions("/farm"))


def test_a_bag_without_the_definition_says_so(tmp_path: Path, recorded: Any) -> None:
    bag = tmp_path / "bag"
    with Writer(bag, version=9) as writer:
        kind = "yolo_msgs/msg/DetectionArray"
        for text in ("", "float64 ("):
            topic = f"/topic{len(text)}"
            connection = writer.add_connection(topic, kind, msgdef=text, rihs01="RIHS01_0")
            writer.write(connection, 0, b"\0\1\0\0")
    with pytest.raises(BagError, match="does not carry the definition of yolo_msgs/Det"):
        read_bags([bag], COCO17, COCO17, ReadOptions("/topic0"))
