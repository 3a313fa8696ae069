# SPDX-License-Identifier: Apache-2.0
"""Real bags in both storages: round trips, several at once, and everything that can be wrong."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, Writer
from rosbags.typesys import Stores, get_typestore

from deep_nrsfm_ros.data.bag_files import BagError
from deep_nrsfm_ros.data.bags import (
    STORAGES,
    Frame,
    check_confidence,
    frames,
    keypoint_count,
    read_bags,
    write_bag,
)
from deep_nrsfm_ros.data.read_options import ReadOptions
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.layouts.presets import BODY25, COCO17, HUMAN17
from deep_nrsfm_ros.messages.decoding import MULTI_ARRAY, POINT_CLOUD, POLYGON

STORE = get_typestore(Stores.ROS2_JAZZY)
TOPIC = "/keypoints"
WRITTEN = [POINT_CLOUD, MULTI_ARRAY, POLYGON]


def detections(
    f: int, layout: KeypointLayout = BODY25, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (f, q, 2) and confidence (f, q), a fifth of them missing."""
    random = np.random.default_rng(seed)
    points = random.uniform(1, 1000, (f, len(layout), 2)).astype(np.float32)
    confidence = random.uniform(0.1, 1, points.shape[:2]).astype(np.float32)
    missing = random.random(confidence.shape) < 0.2
    points[missing] = confidence[missing] = 0
    return points, confidence


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("input_type", WRITTEN)
def test_round_trip(tmp_path: Path, storage: str, input_type: str) -> None:
    points, confidence = detections(50)
    bag = tmp_path / "bag"
    assert write_bag(bag, TOPIC, frames(points, confidence), storage, input_type) == len(points)
    (file,) = (f for f in bag.iterdir() if f.suffix != ".yaml")
    for path, topic in ((bag, TOPIC), (bag, ""), (file, TOPIC)):
        reading = read_bags([path], BODY25, BODY25, ReadOptions(topic))
        np.testing.assert_array_equal(reading.dataset.points, points)
        np.testing.assert_array_equal(reading.dataset.visible, confidence > 0)
        assert reading[1:5] == (len(points), 0, "", ())


def test_points_come_in_the_layout_of_the_model(tmp_path: Path) -> None:
    points, confidence = detections(20)
    write_bag(tmp_path / "bag", TOPIC, frames(points, confidence))
    dataset = read_bags([tmp_path / "bag"], BODY25, HUMAN17, ReadOptions(TOPIC)).dataset
    mapped, sure = KeypointMap(BODY25, HUMAN17)(points, confidence)
    np.testing.assert_array_equal(dataset.points, mapped)
    np.testing.assert_array_equal(dataset.visible, sure > 0)
    assert dataset.layout is HUMAN17


def test_several_bags_and_several_objects(tmp_path: Path) -> None:
    points, confidence = detections(12)
    pairs = (Frame(i, points[2 * i : 2 * i + 2], confidence[2 * i : 2 * i + 2]) for i in range(6))
    write_bag(tmp_path / "a", TOPIC, pairs, "mcap")
    write_bag(tmp_path / "b", TOPIC, frames(points, confidence), "sqlite3")
    seen: list[tuple[int, int]] = []
    reading = read_bags(
        [tmp_path / "a", tmp_path / "b"],
        BODY25,
        BODY25,
        ReadOptions(TOPIC),
        on_progress=lambda *p: seen.append(p),
    )
    np.testing.assert_array_equal(reading.dataset.points, np.concatenate([points, points]))
    assert reading.messages == 18
    assert "a, b" in reading.dataset.source
    assert all(done <= total for done, total in seen)


@pytest.mark.parametrize("input_type", [MULTI_ARRAY, POINT_CLOUD])
def test_many_blocks_of_frames_keep_their_order(tmp_path: Path, input_type: str) -> None:
    points, confidence = detections(5000, COCO17)
    write_bag(tmp_path / "bag", TOPIC, frames(points, confidence), "mcap", input_type)
    dataset = read_bags([tmp_path / "bag"], COCO17, COCO17, ReadOptions(TOPIC)).dataset
    np.testing.assert_array_equal(dataset.points, points)
    np.testing.assert_array_equal(dataset.visible, confidence > 0)


def test_messages_of_several_makes_keep_their_order(tmp_path: Path) -> None:
    points, confidence = detections(300)
    ends = np.random.default_rng(0).integers(0, 4, 400).cumsum().clip(0, 300)
    cameras = ("left", "a much longer name", "")
    seen = (
        Frame(i, points[start:end], confidence[start:end], cameras[i // 7 % 3])
        for i, (start, end) in enumerate(zip([0, *ends], ends, strict=False))
    )
    assert write_bag(tmp_path / "bag", TOPIC, seen) == 400
    reading = read_bags([tmp_path / "bag"], BODY25, BODY25, ReadOptions(TOPIC, min_confidence=0.3))
    np.testing.assert_array_equal(reading.dataset.visible, confidence >= 0.3)
    sure = np.where(reading.dataset.visible[..., None], points, 0)
    np.testing.assert_array_equal(reading.dataset.points, sure)
    assert (reading.messages, reading.unreadable) == (400, 0)


def test_progress_counts_to_the_total(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", TOPIC, frames(*detections(600)))
    seen: list[tuple[int, int]] = []
    read_bags([tmp_path / "bag"], BODY25, BODY25, on_progress=lambda *p: seen.append(p))
    assert seen == [(256, 600), (512, 600), (600, 600)]


def test_low_confidence_is_missing(tmp_path: Path) -> None:
    points, confidence = detections(10)
    write_bag(tmp_path / "bag", TOPIC, frames(points, confidence))
    dataset = read_bags(
        [tmp_path / "bag"], BODY25, BODY25, ReadOptions(TOPIC, min_confidence=0.5)
    ).dataset
    np.testing.assert_array_equal(dataset.visible, confidence >= 0.5)


def write_raw(path: Path, topics: dict[str, tuple[str, list[bytes]]]) -> None:
    """Write a bag of serialised messages: topic -> (type, messages)."""
    with Writer(path, version=9) as writer:
        for topic, (kind, messages) in topics.items():
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for i, raw in enumerate(messages):
                writer.write(connection, i, raw)


def raw_messages(count: int) -> list[bytes]:
    """Return serialised PointCloud2 messages of BODY25 keypoints."""
    with TemporaryDirectory() as folder:
        write_bag(Path(folder) / "bag", TOPIC, frames(*detections(count)))
        with Reader(Path(folder) / "bag") as reader:
            return [raw for _, _, raw in reader.messages()]


def test_unreadable_messages_are_counted_not_fatal(tmp_path: Path) -> None:
    good, random = raw_messages(10), np.random.default_rng(0)
    bad = [b"", good[0][:40], random.bytes(300), good[0][:-8], b"\0\1\0\0" + b"\xff" * 200]
    mixed = [m for pair in zip(good[:5], bad, strict=True) for m in pair] + good[5:]
    write_raw(tmp_path / "bag", {TOPIC: ("sensor_msgs/msg/PointCloud2", mixed)})
    reading = read_bags([tmp_path / "bag"], BODY25, BODY25, ReadOptions(TOPIC))
    assert (len(reading.dataset), reading.messages, reading.unreadable) == (10, 15, 5)
    assert "cannot be decoded" in reading.reason
    np.testing.assert_array_equal(reading.dataset.points, detections(10)[0])


def test_wrong_layout_says_why_nothing_is_readable(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", TOPIC, frames(*detections(3)))
    with pytest.raises(BagError, match=r"bag \(3 found\).*25 keypoints.*has 17"):
        read_bags([tmp_path / "bag"], COCO17, HUMAN17, ReadOptions(TOPIC))


def test_wrong_topics_list_what_is_there(tmp_path: Path) -> None:
    cloud, text = "sensor_msgs/msg/PointCloud2", "std_msgs/msg/String"
    topics = {"/a": (cloud, raw_messages(1)), "/b": (cloud, []), "/c": (text, [b"\0\1\0\0"])}
    write_raw(tmp_path / "bag", topics)
    listing = r"/a \[sensor_msgs/PointCloud2\], /b .*, /c \[std_msgs/String\]"
    for topic, expected in (
        ("/d", f"no topic called /d; its topics are: {listing}"),
        ("/c", "topic /c of bag .* has type std_msgs/String; it must be one of sensor_msgs"),
        ("/b", r"has no message on /b .*; topics with messages: /a .*, /c \[std_msgs/String\]"),
    ):
        with pytest.raises(BagError, match=expected):
            read_bags([tmp_path / "bag"], BODY25, BODY25, ReadOptions(topic))


def test_missing_and_foreign_bags_are_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="bag .*nowhere does not exist"):
        read_bags([tmp_path / "nowhere"], BODY25, BODY25, ReadOptions(TOPIC))
    (tmp_path / "empty").mkdir()
    for name in ("text.txt", "text.db3", "text.mcap"):
        (tmp_path / name).write_text("no bag\n" * 100)
    for name in ("empty", "text.txt", "text.db3", "text.mcap"):
        with pytest.raises(BagError, match=f"bag .*{name} cannot be read"):
            read_bags([tmp_path / name], BODY25, BODY25, ReadOptions(TOPIC))
    with pytest.raises(BagError, match="at least one"):
        read_bags([], BODY25, BODY25, ReadOptions(TOPIC))


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_compressed_bag_is_read_as_any_other(tmp_path: Path, mode: CompressionMode) -> None:
    points, confidence = detections(50)
    write_bag(tmp_path / "plain", TOPIC, frames(points, confidence))
    writer = Writer(tmp_path / "bag", version=9)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with Reader(tmp_path / "plain") as plain, writer:
        (topic,) = plain.connections
        copy = writer.add_connection(topic.topic, topic.msgtype, typestore=STORE)
        for _, time, raw in plain.messages():
            writer.write(copy, time, raw)
    reading = read_bags([tmp_path / "bag"], BODY25, BODY25)
    np.testing.assert_array_equal(reading.dataset.points, points)
    assert reading[1:5] == (len(points), 0, "", ())


@pytest.mark.parametrize("storage", STORAGES)
def test_a_split_bag_is_read_from_its_first_file_to_its_last(tmp_path: Path, storage: str) -> None:
    points, confidence = detections(50)
    bag, rest = tmp_path / "bag", tmp_path / "rest"
    write_bag(bag, TOPIC, frames(points[:30], confidence[:30]), storage)
    write_bag(rest, TOPIC, frames(points[30:], confidence[30:]), storage)
    (file,) = (f for f in rest.iterdir() if f.suffix != ".yaml")
    file.rename(bag / file.name)
    described = yaml.safe_load((bag / "metadata.yaml").read_text())
    about = described["rosbag2_bagfile_information"]
    about["relative_file_paths"].append(file.name)
    about["message_count"] = about["topics_with_message_count"][0]["message_count"] = 50
    (bag / "metadata.yaml").write_text(yaml.safe_dump(described))
    reading = read_bags([bag], BODY25, BODY25, ReadOptions(TOPIC))
    np.testing.assert_array_equal(reading.dataset.points, points)
    assert reading[1:5] == (len(points), 0, "", ())


@pytest.mark.parametrize("metadata", [True, False], ids=["metadata", "no metadata"])
@pytest.mark.parametrize("storage", STORAGES)
def test_cut_off_bag_gives_its_readable_part(tmp_path: Path, storage: str, metadata: bool) -> None:
    count = 1000 if storage == "sqlite3" else 8000  # an mcap file is lost by chunks of 1 MiB
    points, confidence = detections(count)
    bag = tmp_path / "bag"
    write_bag(bag, TOPIC, frames(points, confidence), storage)
    (file,) = (f for f in bag.iterdir() if f.suffix != ".yaml")
    if not metadata:
        (bag / "metadata.yaml").unlink()
    whole = file.read_bytes()
    for share in (0.9, 0.6, 0.3):
        file.write_bytes(whole[: int(share * len(whole))])
        dataset, messages, unreadable, _, warnings, _ = read_bags(
            [bag], BODY25, BODY25, ReadOptions(TOPIC)
        )
        assert (share - 0.3) * count < len(dataset) < count
        assert unreadable == 0 and messages == len(dataset)
        np.testing.assert_array_equal(dataset.points, points[:messages])
        (warning,) = warnings
        lost = f"{count - messages} of {count} messages are lost" if metadata else "may be lost"
        assert str(bag) in warning and f"read {messages} messages" in warning and lost in warning
    for share in (0.001, 0):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(BagError, match="bag"):
            read_bags([bag], BODY25, BODY25, ReadOptions(TOPIC))


@pytest.mark.parametrize("column", ["name", "type"])
def test_a_topic_that_has_lost_its_name_or_type_is_none(tmp_path: Path, column: str) -> None:
    bag = tmp_path / "bag"
    write_bag(bag, TOPIC, frames(*detections(30)), "sqlite3")
    (bag / "metadata.yaml").unlink()
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as tables:
        tables.execute("CREATE TABLE damaged AS SELECT * FROM topics")
        tables.execute("INSERT INTO damaged SELECT * FROM topics")
        tables.execute(f"UPDATE damaged SET {column} = NULL, id = 99 WHERE rowid = 2")
        tables.execute("DROP TABLE topics")
        tables.execute("ALTER TABLE damaged RENAME TO topics")
    for path in (bag, file):
        assert len(read_bags([path], BODY25, BODY25).dataset) == 30


def test_bag_without_metadata_only_is_read_in_full(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", TOPIC, frames(*detections(30)))
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert len(read_bags([tmp_path / "bag"], BODY25, BODY25, ReadOptions(TOPIC)).dataset) == 30


def test_write_bag_never_overwrites(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="exists already"):
        write_bag(tmp_path, TOPIC, frames(*detections(1)))


def test_stamps_and_cameras_are_kept(tmp_path: Path) -> None:
    points, confidence = detections(3)
    write_bag(tmp_path / "bag", TOPIC, frames(points, confidence, 10, "cam02", start=10**9))
    with Reader(tmp_path / "bag") as reader:
        for i, (connection, stamp, raw) in enumerate(reader.messages()):
            message: Any = STORE.deserialize_cdr(raw, connection.msgtype)
            header = message.header
            assert stamp == header.stamp.sec * 10**9 + header.stamp.nanosec == 10**9 + i * 10**8
            assert header.frame_id == "cam02"
        assert i == 2


def test_float_array_bag_needs_no_layout_of_its_own(tmp_path: Path) -> None:
    kind = MULTI_ARRAY.replace("/", "/msg/")
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    flat = np.arange(1, 35, dtype=np.float32)
    raw = STORE.serialize_cdr(STORE.types[kind](layout, flat), kind)
    write_raw(tmp_path / "bag", {TOPIC: (kind, [bytes(raw)])})
    dataset = read_bags([tmp_path / "bag"], COCO17, COCO17).dataset
    np.testing.assert_array_equal(dataset.points, flat.reshape(1, 17, 2))


@pytest.mark.parametrize("input_type", WRITTEN)
def test_bags_tell_how_many_keypoints_there_are(tmp_path: Path, input_type: str) -> None:
    for name, layout, count in (("a", COCO17, 3), ("b", BODY25, 5)):
        found = frames(*detections(count, layout))
        write_bag(tmp_path / name, TOPIC, found, input_type=input_type)
    assert keypoint_count([tmp_path / "a"], ReadOptions(TOPIC)) == 17
    assert keypoint_count([tmp_path / "a", tmp_path / "b"]) == 25  # what most messages have


def test_messages_without_objects_or_sense_do_not_count(tmp_path: Path) -> None:
    nobody = Frame(0, np.zeros((0, 4, 2)), np.zeros((0, 4)))
    write_bag(tmp_path / "empty", TOPIC, [nobody] * 5)
    with pytest.raises(BagError, match="no message in empty tells how many keypoints"):
        keypoint_count([tmp_path / "empty"], ReadOptions(TOPIC))
    (good,) = raw_messages(1)
    width = good.index(b"\x19\0\0\0")  # 25
    huge = good[:width] + b"\xff\xff\xff\x7f" + good[width + 4 :]
    write_raw(tmp_path / "bag", {TOPIC: ("sensor_msgs/msg/PointCloud2", [huge, b"", huge, good])})
    assert keypoint_count([tmp_path / "empty", tmp_path / "bag"], ReadOptions(TOPIC)) == 25
    write_raw(tmp_path / "huge", {TOPIC: ("sensor_msgs/msg/PointCloud2", [huge])})
    with pytest.raises(BagError, match="no message in huge tells .*points need"):
        keypoint_count([tmp_path / "huge"], ReadOptions(TOPIC))


def test_more_frames_than_allowed_are_refused_before_they_fill_the_memory(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    points, confidence = np.ones((300, 17, 2)), np.ones((300, 17))
    write_bag(path, "/k", frames(points, confidence))
    with pytest.raises(BagError, match=r"above 299.*\(max_frames\)"):
        read_bags([path], HUMAN17, HUMAN17, ReadOptions("/k", max_frames=299))
    assert (
        len(read_bags([path], HUMAN17, HUMAN17, ReadOptions("/k", max_frames=300)).dataset) == 300
    )


@pytest.mark.parametrize("input_type", WRITTEN)
def test_confidences_of_another_scale_are_found(input_type: str, tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(1, 900, (40, 17, 2))
    for name, scale in (("right", 1), ("percent", 100)):
        given = frames(points, np.full((40, 17), 0.9 * scale))
        write_bag(tmp_path / name, "/keypoints", given, input_type=input_type)
    assert not check_confidence(tmp_path / "right", 17)
    (finding,) = check_confidence(tmp_path / "percent", 17)
    assert "confidence up to 90: " in finding.message and "divide it by 100" in finding.message
