# SPDX-License-Identifier: Apache-2.0
"""Bags of detectors' own messages, read by the definitions that they carry."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.convert.converter import migrate_message
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from deep_nrsfm_ros.data.bag_files import BagError
from deep_nrsfm_ros.data.bags import keypoint_count, point_cloud, read_bags
from deep_nrsfm_ros.data.definitions import find_types
from deep_nrsfm_ros.data.keypoint_files import read_keypoints
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import COCO17, HUMAN17, REP155
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from test.fixtures.detector_messages import DEFINITIONS

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


def write_undefined(path: Path, maker: Any, kind: str, messages: list[Any], **made: Any) -> Path:
    """Write a bag of one topic whose type has an empty definition, or the one in `made`."""
    name, text = kind.replace("/", "/msg/"), made.pop("text", "")
    type_hash = made.pop("type_hash", None) or maker.store.hash_rihs01(name)
    with Writer(path, version=9, **made) as writer:
        connection = writer.add_connection("/topic", name, msgdef=text, rihs01=type_hash)
        for i, message in enumerate(messages):
            writer.write(connection, i, maker.store.serialize_cdr(message, name))
    return path


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("text", ["", "float64 ("])
def test_a_type_of_a_known_detector_needs_no_definition_in_the_bag(
    tmp_path: Path, recorded: Any, storage: StoragePlugin, text: str
) -> None:
    given = people(5, 17)
    messages = [recorded.detections([{"id": "1", "points": p, "seen": range(17)}]) for p in given]
    bag = write_undefined(
        tmp_path / "bag",
        recorded,
        "yolo_msgs/DetectionArray",
        messages,
        storage_plugin=storage,
        text=text,
    )
    (file,) = (f for f in bag.iterdir() if f.suffix != ".yaml")
    for path in (bag, file):
        reading = read_bags([path], COCO17, COCO17)
        assert not reading.warnings and not reading.unreadable
        np.testing.assert_allclose(reading.dataset.points, given[..., :2], rtol=1e-6)


def test_an_installed_definition_is_used(
    tmp_path: Path, recorded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    joints = {"paw": (1.0, 2.0), "head": (3.0, 4.0), "tail": (5.0, 6.0), "ear": (7.0, 8.0)}
    messages = [recorded.animals([(1, joints)])] * 3
    bag = write_undefined(tmp_path / "bag", recorded, "my_msgs/Animals", messages)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "nowhere"))
    with pytest.raises(BagError, match="my_msgs is not installed here: source a workspace"):
        read_bags([bag], ANIMAL, ANIMAL, ReadOptions(mapping=MAPPING))
    for name, text in DEFINITIONS.items():
        if name.startswith("my_msgs"):
            file = tmp_path / "install" / "share" / f"{name}.msg"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    dataset = read_bags([bag], ANIMAL, ANIMAL, ReadOptions(mapping=MAPPING)).dataset
    np.testing.assert_array_equal(dataset.points, [[[3, 4], [5, 6], [1, 2], [7, 8]]] * 3)


def test_another_definition_than_the_recorded_one_is_refused(tmp_path: Path, recorded: Any) -> None:
    kind, message = "yolo_msgs/DetectionArray", recorded.detections([])
    bag = write_undefined(tmp_path / "bag", recorded, kind, [message], type_hash="RIHS01_0")
    with pytest.raises(BagError, match="its hash differs; source the version of yolo_msgs"):
        read_bags([bag], COCO17, COCO17)
    for path in bag.glob("*.db3"):  # without a hash the bytes show it
        with closing(sqlite3.connect(path)) as database:
            for table in ("message_definitions", "topics"):
                database.execute(f"UPDATE {table} SET type_description_hash = ''")
            database.execute("UPDATE messages SET data = x'00010000' || zeroblob(40)")
            database.commit()
        with pytest.raises(BagError, match="by the definition of yolo_msgs/DetectionArray that"):
            read_bags([path], COCO17, COCO17)


def test_no_error_advises_what_was_done_already(tmp_path: Path, recorded: Any) -> None:
    message = recorded.animals([])
    for storage in StoragePlugin:
        bag = write_undefined(
            tmp_path / storage.name,
            recorded,
            "my_msgs/Animals",
            [message],
            storage_plugin=storage,
        )
        with pytest.raises(BagError, match="does not carry the definition") as error:
            read_bags([bag], ANIMAL, ANIMAL, ReadOptions(mapping=MAPPING))
        assert "mcap" not in str(error.value).replace(str(bag), "") and "Iron" not in str(error)


def test_topics_without_messages_do_not_count(tmp_path: Path, recorded: Any) -> None:
    given = people(3, 17)
    messages = [recorded.detections([{"id": "1", "points": p, "seen": range(17)}]) for p in given]
    kind = "yolo_msgs/DetectionArray"
    bag = write(tmp_path / "bag", recorded, {"/off": (kind, []), "/on": (kind, messages)})
    assert len(read_bags([bag], COCO17, COCO17).dataset) == 3
    assert len(read_bags([bag], COCO17, COCO17, ReadOptions("/*")).dataset) == 3
    empty = write(tmp_path / "empty", recorded, {"/off": (kind, [])})
    for topic in ("", "/off", "/*"):
        with pytest.raises(BagError, match=r"no message on /off .*nothing was published on it$"):
            read_bags([empty], COCO17, COCO17, ReadOptions(topic))


def test_the_only_topic_with_that_number_of_keypoints_is_taken(
    tmp_path: Path, recorded: Any
) -> None:
    bag, kind = tmp_path / "bag", "sensor_msgs/PointCloud2"
    given: np.ndarray = people(4, 17).astype(np.float32)
    clouds = {
        topic: [recorded_cloud(points[None]) for points in values]
        for topic, values in (("/lidar", people(4, 900)), ("/keypoints", given))
    }
    write(bag, recorded, {topic: (kind, messages) for topic, messages in clouds.items()})
    dataset = read_bags([bag], COCO17, COCO17).dataset
    np.testing.assert_array_equal(dataset.points, given[..., :2])
    with pytest.raises(BagError, match=r"2 keypoint topics; name one of: /lidar \[sensor_msgs/Poi"):
        read_bags([bag], REP155, REP155)


def recorded_cloud(values: np.ndarray) -> Any:
    """Return a PointCloud2 of (n, q, 3) x, y, confidence."""
    store = get_typestore(Stores.ROS2_JAZZY)
    stamp = store.types["builtin_interfaces/msg/Time"](1, 0)
    header = store.types["std_msgs/msg/Header"](stamp, "camera")
    return point_cloud(header, values[..., :2], values[..., 2])


def write_ros1(path: Path, maker: Any, topics: dict[str, tuple[str, list[Any]]]) -> Path:
    """Write a bag of ROS 1: topic -> (its type, messages of ROS 2)."""
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    with Ros1Writer(path) as writer:
        for topic, (kind, messages) in topics.items():
            name = kind.replace("/", "/msg/")
            connection = writer.add_connection(topic, name, typestore=store)
            for i, message in enumerate(messages):
                as_ros1 = migrate_message(maker.store, store, name, name, {}, message)
                writer.write(connection, 10**9 * (i + 1), store.serialize_ros1(as_ros1, name))
    return path


def test_bags_of_ros_1(tmp_path: Path, recorded: Any) -> None:
    given: np.ndarray = people(6, 17).astype(np.float32)
    messages = [recorded_cloud(points[None]) for points in given]
    kind = "sensor_msgs/PointCloud2"
    whole = write_ros1(
        tmp_path / "whole.bag", recorded, {"/off": (kind, []), "/on": (kind, messages)}
    )
    parts = tmp_path / "parts"
    parts.mkdir()
    write_ros1(parts / "a_0.bag", recorded, {"/on": (kind, messages[:3])})
    write_ros1(parts / "a_1.bag", recorded, {"/on": (kind, messages[3:])})
    other = whole.with_suffix(".db3")
    other.write_bytes(whole.read_bytes())
    for path in (whole, parts, other):
        reading = read_bags([path], COCO17, COCO17)
        assert reading[1:5] == (6, 0, "", ())
        np.testing.assert_array_equal(reading.dataset.points, given[..., :2])
    detections = read_keypoints(whole)
    assert detections.stamps.tolist() == [10**9] * 6 and detections.frame_id == "camera"
    cut = tmp_path / "cut.bag"
    cut.write_bytes(whole.read_bytes()[:-300])
    with pytest.raises(BagError, match=r"cut.bag of ROS 1 cannot be read: .*rosbag reindex"):
        read_bags([cut], COCO17, COCO17)


def test_types_of_detectors_in_bags_of_ros_1(tmp_path: Path, recorded: Any) -> None:
    given = people(3, 18) / [1000, 1000, 1]
    kind = "hri_msgs/Skeleton2D"
    messages = [recorded.skeleton(points) for points in given]
    bag = write_ros1(tmp_path / "a.bag", recorded, {"/body": (kind, messages)})
    dataset = read_bags([bag], REP155, REP155, ReadOptions(image_size=(640, 480))).dataset
    np.testing.assert_allclose(dataset.points, given[..., :2] * [640, 480], rtol=1e-5)


def test_the_type_of_messages_implies_the_layout(tmp_path: Path, recorded: Any) -> None:
    given = people(4, 17)
    bag = yolo_bag(tmp_path / "bag", recorded, given)
    found = read_keypoints(bag)
    assert found.layout is COCO17 and found.points.shape[1:] == (17, 2)
    assert read_keypoints(bag, ReadOptions(layout=HUMAN17)).layout is HUMAN17


def test_scores_of_objects_in_a_bag(tmp_path: Path, recorded: Any) -> None:
    """`min_score` leaves out objects, for `lift` and `train`; the largest is no ghost."""
    big, small = people(1, 17)[0], people(1, 17)[0]
    small[:, :2] = small[:, :2] / 4 + 300
    found = [
        {"id": "1", "points": big, "seen": range(17), "score": 0.2},
        {"id": "2", "points": small, "seen": range(17), "score": 0.9},
    ]
    messages = [recorded.detections(found)] * 3
    bag = write(tmp_path / "bag", recorded, {"/yolo": ("yolo_msgs/DetectionArray", messages)})
    every = read_keypoints(bag, ReadOptions())
    assert every.scores.tolist() == [np.float32(0.2), np.float32(0.9)] * 3
    assert every.largest().identities.tolist() == ["2"] * 3
    kept = read_keypoints(bag, ReadOptions(min_score=0.5))
    assert kept.identities.tolist() == ["2"] * 3
    assert kept.warnings == ("left out: 3 objects with a score below --min-score 0.5",)
    to_human = KeypointMap(COCO17, HUMAN17)
    reading = read_bags([bag], to_human.source, to_human.target, ReadOptions(min_score=0.5))
    assert len(reading.dataset) == 3
    cloud = point_cloud_bag(tmp_path / "cloud", recorded)
    with pytest.raises(ValueError, match="gives no object a score .*: leave out min_score"):
        read_keypoints(cloud, ReadOptions(min_score=0.5, layout=COCO17))
    with pytest.raises(BagError, match="gives no object a score"):
        read_bags([cloud], COCO17, HUMAN17, ReadOptions(min_score=0.5))


def test_marks_of_missing_keypoints_in_a_bag(tmp_path: Path, recorded: Any) -> None:
    points = people(4, 17)
    points[:, 3, :2] = -1
    bag = write(
        tmp_path / "bag",
        recorded,
        {"/k": ("sensor_msgs/PointCloud2", [cloud_of(recorded, p) for p in points])},
    )
    for read in (
        read_keypoints(bag, ReadOptions(layout=COCO17, missing_value=-1)).confidence > 0,
        read_bags([bag], COCO17, COCO17, ReadOptions(missing_value=-1)).dataset.visible,
    ):
        assert not read[:, 3].any() and read[:, :3].all()


def test_objects_that_are_left_out_are_said(tmp_path: Path, recorded: Any) -> None:
    found = [
        {"id": "1", "points": people(1, 17)[0], "seen": range(17)},
        {"id": "2", "points": people(1, 25)[0], "seen": range(25)},
    ]
    messages = [recorded.detections(found)] * 3
    bag = write(tmp_path / "bag", recorded, {"/yolo": ("yolo_msgs/DetectionArray", messages)})
    reading = read_bags([bag], COCO17, COCO17)
    expected = "an object is left out: id of a keypoint is 25; the 17 of the keypoint layout are"
    assert any(text.startswith(expected) and "(3 times)" in text for text in reading.warnings)
    assert any(text.startswith(expected) for text in read_keypoints(bag).warnings)


def cloud_of(maker: Any, points: np.ndarray) -> Any:
    """Return a PointCloud2 of one object (q, 3)."""
    header = maker.make("std_msgs/Header")
    return point_cloud(header, points[None, :, :2], points[None, :, 2])


def point_cloud_bag(path: Path, maker: Any) -> Path:
    """Write a bag of one person, whose messages have no score of the person."""
    messages = [cloud_of(maker, p) for p in people(3, 17)]
    return write(path, maker, {"/k": ("sensor_msgs/PointCloud2", messages)})


def test_a_type_that_a_shipped_mapping_reads_is_said(tmp_path: Path, recorded: Any) -> None:
    message = recorded.detections([], package="yolov8_msgs")
    bag = write(tmp_path / "bag", recorded, {"/d": ("yolov8_msgs/DetectionArray", [message])})
    with pytest.raises(BagError, match=r"no keypoint topic; .*yolov8\.yaml is a field mapping"):
        read_keypoints(bag)
    with pytest.raises(BagError, match=r"has type yolov8_msgs.*yolov8\.yaml is a field mapping"):
        read_keypoints(bag, ReadOptions(topic="/d"))


def test_a_type_has_a_store_for_each_of_its_definitions() -> None:
    texts = ("float32 x", "float64 x", "float32 x")
    first, other, again = (find_types("my_msgs/msg/Point", text, "")[0] for text in texts)
    assert first is again
    assert first.fielddefs["my_msgs/msg/Point"] != other.fielddefs["my_msgs/msg/Point"]
