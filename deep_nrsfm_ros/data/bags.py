# SPDX-License-Identifier: Apache-2.0
"""Bags to datasets, and keypoints to bags: rosbag2 with both storages, without ROS."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer

from deep_nrsfm_ros.batched import Progress
from deep_nrsfm_ros.data.bag_files import BagError, open_bag
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.data.dataset import Dataset, DatasetBuilder
from deep_nrsfm_ros.data.definitions import ros2_types
from deep_nrsfm_ros.data.read_options import DEFAULT_READ_OPTIONS, ReadOptions
from deep_nrsfm_ros.data.share import WHOLE_SHARE, Share
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import (
    MessageError,
    Observation,
    left_out_sentences,
    without_value,
)
from deep_nrsfm_ros.lifting.sanity import Finding, confidence_scale
from deep_nrsfm_ros.messages.decoding import (
    MULTI_ARRAY,
    POINT_CLOUD,
    POINT_FIELDS,
    POINT_STEP,
    POLYGON,
    count_keypoints,
    may_omit_keypoints,
    pack_points,
    read_confidence,
    read_observation,
)
from deep_nrsfm_ros.messages.serialised import MessageReader

STORAGES = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}

NO_SCORES = "gives no object a score (a field mapping can name it): leave out min_score"
"""Why `min_score` cannot act on a bag."""

_SAMPLE = 256  # messages with objects of a topic, or objects, that are looked at
_STEP = 4  # messages next to each other are alike


class TooManyFramesError(BagError):
    """The bags have more frames than may be read."""


class BagReading(NamedTuple):
    """The result of `read_bags`.

    Attributes:
        dataset: a frame for every object of every readable message, in the order of the bags.
        messages: number of messages of the share, readable or not.
        unreadable: number of them that could not be read.
        reason: why the first unreadable message could not be read; "" if all could.
        warnings: a sentence for each damaged bag that says what is missing, and for each bag that
            was left out, since nothing of it can be used.
        starts: each bag that was read, with the index of its first frame.
    """

    dataset: Dataset
    messages: int
    unreadable: int
    reason: str
    warnings: tuple[str, ...]
    starts: tuple[tuple[Path, int], ...]


def read_bags(
    paths: Sequence[Path],
    source: KeypointLayout,
    target: KeypointLayout,
    options: ReadOptions = DEFAULT_READ_OPTIONS,
    on_progress: Progress | None = None,
    share: Share = WHOLE_SHARE,
) -> BagReading:
    """Return the keypoints of all bags as one dataset; memory stays below about twice its size.

    Args:
        paths: bag folders, or single .db3 or .mcap files.
        source: layout in which the detector wrote the messages.
        target: layout of the dataset.
        options: topic, mapping and limits.
        on_progress: called after every 256 messages.
        share: the part of the messages to read; others are not decoded.

    Raises:
        BagError: every bag is missing, damaged beyond reading or without such a topic; no message
            is readable; or there are more frames than `options.max_frames`. It names the bag.
    """
    builder, warnings = DatasetBuilder(KeypointMap(source, target), options.min_confidence), []
    messages, unreadable, reason = 0, 0, ""
    left_out: list[str] = []
    has_scores = False
    if not paths:
        raise BagError("no bag to read; name at least one")
    failures: list[BagError] = []
    read: list[str] = []
    starts: list[tuple[Path, int]] = []
    for path in map(Path, paths):
        with ExitStack() as stack:
            try:
                bag = stack.enter_context(closing(open_bag(path)))
                topics = keypoint_topics(bag, options.topic, options.mapping, len(source))
            except BagError as error:
                failures.append(error)
                continue
            read.append(path.name)
            starts.append((path, builder.count))
            for topic, input_type, decode in topics:
                before, reader = messages, MessageReader(input_type, decode)
                builder.begin_sequence()
                for raw in share.of(bag.messages(topic), len(read) - 1):
                    messages += 1
                    try:
                        read_one = _add(builder, reader, raw, len(source), options)
                        left_out += read_one.left_out
                        has_scores |= bool(read_one.scores)
                    except Exception as error:  # damaged bytes fail in many ways; read the others
                        unreadable += 1
                        reason = reason or _reason(error)
                    if options.max_frames is not None and builder.count > options.max_frames:
                        raise TooManyFramesError(
                            f"bag {path} brings the frames above {options.max_frames}, the most "
                            "that are read (max_frames); name fewer bags, or allow more"
                        )
                    if on_progress and messages % 256 == 0:
                        total = before + topic.total // share.size
                        on_progress(messages, max(messages, total))
                if warning := bag.warning(topic):
                    warnings.append(warning)
    if not read:
        raise failures[0]
    warnings += [f"left out: {failure}" for failure in failures]
    names = ", ".join(read)
    if messages == unreadable:
        raise BagError(
            f"no readable message in {names} ({messages} found); {reason or 'its end is lost'}"
        )
    if options.min_score and not has_scores:
        raise BagError(f"bag {names} {NO_SCORES}")
    warnings += left_out_sentences(left_out)
    if on_progress:
        on_progress(messages, messages)
    dataset = builder.dataset(f"bags {names}")
    return BagReading(dataset, messages, unreadable, reason, tuple(warnings), tuple(starts))


def _add(
    builder: DatasetBuilder, reader: MessageReader, raw: bytes, keypoints: int, options: ReadOptions
) -> Observation:
    """Add the objects of a serialised message of `keypoints` keypoints to a dataset.

    Returns:
        The message as it was read; without objects where it is of a known format.
    """
    known_format = reader.find_format(raw, keypoints)
    if known_format and options.missing_value is None:
        builder.add_serialised(known_format, raw)
        return _NOTHING
    _, observation = reader(raw, keypoints, options.min_confidence, options.image_size)
    builder.add(without_value(observation.above(options.min_score), options.missing_value))
    return observation


_NOTHING = Observation(np.empty((0, 0, 2), np.float32), np.empty((0, 0), np.float32))


def keypoint_count(paths: Sequence[Path], options: ReadOptions = DEFAULT_READ_OPTIONS) -> int:
    """Return the number of keypoints of the objects in bags, for an object without a layout.

    It looks at the first 256 messages with objects of each bag and takes the most frequent number,
    since a detector may write another number when it detects nothing. For detectors that omit
    missing keypoints it takes the largest number.

    Args:
        paths: bag folders, or single .db3 or .mcap files.
        options: topic and mapping.

    Raises:
        BagError: no message has keypoints.
    """
    counts: Counter[int] = Counter()
    reason, may_omit = "", False
    for path in paths:
        with ExitStack() as stack:
            try:
                bag = stack.enter_context(closing(open_bag(Path(path))))
                topics = keypoint_topics(bag, options.topic, options.mapping)
            except BagError as error:  # the others may do
                reason = reason or str(error)
                continue
            for topic, input_type, decode in topics:
                may_omit |= may_omit_keypoints(input_type)
                counted = 0
                for raw in bag.sample(topic):
                    if counted == _SAMPLE:
                        break
                    try:
                        message = decode(raw)
                        count = count_keypoints(message, input_type)
                        if count:
                            # Only a readable message counts: damaged ones have any number.
                            read_observation(message, input_type, count, size=(1, 1))
                            counts[count] += 1
                            counted += 1
                    except Exception as error:  # as in read_bags
                        reason = reason or _reason(error)
    if not counts:
        names = ", ".join(path.name for path in map(Path, paths))
        nobody = "none of its messages has an object"
        raise BagError(
            f"no message in {names} tells how many keypoints there are; {reason or nobody}"
        )
    return max(counts) if may_omit else counts.most_common(1)[0][0]


def check_confidence(
    path: Path, keypoints: int, options: ReadOptions = DEFAULT_READ_OPTIONS
) -> list[Finding]:
    """Return whether the confidences in a bag are on another scale than 0 to 1.

    `read_bags` cuts them off at 1. Some hundred objects at the beginning of the bag are looked at.

    Args:
        path: bag folder, or a single .db3 or .mcap file.
        keypoints: of an object.
        options: topic and mapping.

    Raises:
        BagError: the bag cannot be read, or has no such topic.
    """
    given, count = list[NDArray[np.floating]]([np.empty(0)]), 0
    with closing(open_bag(path)) as bag:
        for topic, input_type, decode in keypoint_topics(
            bag, options.topic, options.mapping, keypoints
        ):
            for raw in islice(bag.sample(topic), None, None, _STEP):
                with suppress(Exception):  # damaged bytes fail in many ways; read the others
                    size = options.image_size or (1, 1)
                    found = read_confidence(decode(raw), input_type, keypoints, size)
                    given.append(found.ravel())
                    count += len(found)
                if count >= _SAMPLE:
                    break
    return confidence_scale(np.concatenate(given))


def _reason(error: Exception) -> str:
    """Return in words why a message is unreadable."""
    return str(error) if isinstance(error, MessageError) else f"cannot be decoded: {error!r}"


class Frame(NamedTuple):
    """One message to write: n objects of q keypoints.

    Attributes:
        stamp: time in ns.
        points: (n, q, 2) in pixels, x right and y down.
        confidence: (n, q) in [0, 1], 0 where missing.
        frame_id: name of the camera.
    """

    stamp: int
    points: NDArray[np.floating]
    confidence: NDArray[np.floating]
    frame_id: str = "camera"


def frames(
    points: NDArray[np.floating],
    confidence: NDArray[np.floating],
    rate: float = 30.0,
    frame_id: str = "camera",
    start: int = 0,
) -> Iterator[Frame]:
    """Yield a frame with one object for each row of the arrays.

    Args:
        points: (f, q, 2), e.g. `points` of a `Dataset`.
        confidence: (f, q), 0 where missing, e.g. `visible` of a `Dataset`.
        rate: frames per second.
        frame_id: name of the camera.
        start: stamp of the first frame in ns.
    """
    for i in range(len(points)):
        yield Frame(
            start + round(i * 1e9 / rate), points[i : i + 1], confidence[i : i + 1], frame_id
        )


def write_bag(
    path: Path,
    topic: str,
    frames: Iterable[Frame],
    storage: str = "sqlite3",
    input_type: str = POINT_CLOUD,
) -> int:
    """Write frames into a new bag and return the number of messages.

    A missing keypoint is written as NaN with confidence 0.

    Args:
        path: folder of the new bag.
        topic: name of its only topic.
        frames: the messages, in order of time.
        storage: "sqlite3" or "mcap".
        input_type: type of the messages, one of `messages.INPUT_TYPES`.

    Raises:
        BagError: `path` exists.
    """
    if path.exists():
        raise BagError(f"bag {path} exists already; choose another name or remove it")
    kind, count = input_type.replace("/", "/msg/"), 0
    with Writer(path, version=9, storage_plugin=STORAGES[storage]) as writer:
        connection = writer.add_connection(topic, kind, typestore=ros2_types())
        for frame in frames:
            message = _ENCODERS[input_type](frame)
            writer.write(connection, frame.stamp, ros2_types().serialize_cdr(message, kind))
            count += 1
    return count


def _make(kind: str, *values: Any) -> Any:
    """Return a message of type `kind` with the values of its fields, in order."""
    return ros2_types().types[kind](*values)


def _header(frame: Frame) -> Any:
    """Return the header of a frame."""
    stamp = _make("builtin_interfaces/msg/Time", *divmod(frame.stamp, 1_000_000_000))
    return _make("std_msgs/msg/Header", stamp, frame.frame_id)


def _triples(frame: Frame) -> NDArray[np.float32]:
    """Return (n, q, 3) rows of x, y, confidence, NaN where missing."""
    points = np.where(frame.confidence[..., None] > 0, frame.points, np.nan)
    triples: NDArray[np.float32] = np.concatenate(
        [points, frame.confidence[..., None]], -1, dtype=np.float32
    )
    return triples


def _point_cloud(frame: Frame) -> Any:
    """Return the frame as a PointCloud2."""
    values = _triples(frame)
    return point_cloud(_header(frame), values[..., :2], values[..., 2])


def point_cloud(header: Any, points: NDArray[np.floating], confidence: NDArray[np.floating]) -> Any:
    """Return points (n, q, 2 or 3) and confidence (n, q) as a PointCloud2 to write to a bag."""
    n, q = confidence.shape
    fields = [_make("sensor_msgs/msg/PointField", name, at, 7, 1) for name, at in POINT_FIELDS]
    data = np.frombuffer(pack_points(points, confidence), np.uint8)
    size = (POINT_STEP, POINT_STEP * q)
    return _make("sensor_msgs/msg/PointCloud2", header, n, q, fields, False, *size, data, False)


def _multi_array(frame: Frame) -> Any:
    """Return the frame as a Float32MultiArray of n x q x 3."""
    values = _triples(frame)
    labels = zip(("objects", "keypoints", "x y confidence"), values.shape, strict=True)
    dimensions = [
        _make("std_msgs/msg/MultiArrayDimension", label, size, int(np.prod(values.shape[i:])))
        for i, (label, size) in enumerate(labels)
    ]
    layout = _make("std_msgs/msg/MultiArrayLayout", dimensions, 0)
    return _make("std_msgs/msg/Float32MultiArray", layout, values.ravel())


def _polygon(frame: Frame) -> Any:
    """Return a frame with one object as a PolygonStamped."""
    (triples,) = _triples(frame).tolist()
    points = [_make("geometry_msgs/msg/Point32", *triple) for triple in triples]
    polygon = _make("geometry_msgs/msg/Polygon", points)
    return _make("geometry_msgs/msg/PolygonStamped", _header(frame), polygon)


_ENCODERS: dict[str, Callable[[Frame], Any]] = {
    POINT_CLOUD: _point_cloud,
    MULTI_ARRAY: _multi_array,
    POLYGON: _polygon,
}
