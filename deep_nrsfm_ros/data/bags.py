"""Bags to datasets and keypoints to bags: rosbag2, both storages, no ROS needed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from deep_nrsfm_ros.data.bag_files import BagError, open_bag
from deep_nrsfm_ros.data.bag_topics import keypoint_topics
from deep_nrsfm_ros.data.dataset import Dataset, DatasetBuilder
from deep_nrsfm_ros.layouts.keypoint_map import KeypointMap
from deep_nrsfm_ros.layouts.layout import KeypointLayout
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.decoding import (
    MULTI_ARRAY,
    POINT_CLOUD,
    POINT_FIELDS,
    POINT_STEP,
    POLYGON,
    count_keypoints,
    may_omit_keypoints,
    pack_points,
    read_observation,
)
from deep_nrsfm_ros.messages.field_mapping import FieldMapping, Size
from deep_nrsfm_ros.messages.serialised import MessageReader

STORAGES = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
Progress = Callable[[int, int], None]
"""Called with the number of messages read so far and the number there are."""

_SAMPLE = 256  # messages of a bag that tell how many keypoints there are
_STORE = get_typestore(Stores.ROS2_JAZZY)


class BagReading(NamedTuple):
    """What `read_bags` found.

    dataset: every object of every readable message is a frame.
    messages: how many messages the topic gave, the unreadable ones among them.
    unreadable: how many of them were dropped; `reason` says why, for the first of them.
    warnings: one sentence for each bag of which a part is lost.
    """

    dataset: Dataset
    messages: int
    unreadable: int
    reason: str
    warnings: tuple[str, ...]


def read_bags(
    paths: Sequence[Path],
    topic: str,
    source: KeypointLayout,
    target: KeypointLayout,
    min_confidence: float = 0.0,
    on_progress: Progress | None = None,
    max_frames: int | None = None,
    mapping: FieldMapping | None = None,
    size: Size | None = None,
) -> BagReading:
    """Read the keypoints of all bags into one dataset in the layout `target`.

    paths: bag folders or single .db3 or .mcap files.
    topic: name of the topic, or of several by a `*` (see `topics.match`); "" takes the only one of
        the mapping's type, or of a type in `messages.INPUT_TYPES`.
    source: the layout in which the detector wrote the messages.
    max_frames: more than these raise BagError.
    mapping: how messages of its type are read. size: of the image, for normalised keypoints.
    Memory stays within about twice the dataset. Raises BagError naming the bag when one is
    missing, damaged beyond reading or without such a topic, or when no message is readable.
    """
    frames, warnings = DatasetBuilder(KeypointMap(source, target), min_confidence), []
    messages, unreadable, reason = 0, 0, ""
    if not paths:
        raise BagError("no bag to read; name at least one")
    for path in paths:
        with closing(open_bag(Path(path))) as bag:
            for chosen, kind, decode in keypoint_topics(bag, topic, mapping):
                done, reader = messages, MessageReader(kind, decode)
                for raw in bag.messages(chosen):
                    messages += 1
                    try:
                        if make := reader.find_format(raw, len(source)):
                            frames.take(make, raw)
                        else:
                            frames.add(reader(raw, len(source), min_confidence, size)[1])
                    except Exception as error:  # whatever bytes a bag holds, others still count
                        unreadable += 1
                        reason = reason or _text(error)
                    if max_frames is not None and frames.count > max_frames:
                        raise BagError(
                            f"bag {path} brings the frames above {max_frames}, the most that are "
                            "read (max_frames); name fewer bags, or allow more"
                        )
                    if on_progress and messages % 256 == 0:
                        on_progress(messages, max(messages, done + chosen.total))
                if warning := bag.warning(chosen):
                    warnings.append(warning)
    names = ", ".join(path.name for path in map(Path, paths))
    if messages == unreadable:
        raise BagError(f"no readable message in {names} ({messages} found); {reason or 'empty'}")
    if on_progress:
        on_progress(messages, messages)
    dataset = frames.dataset(f"bags {names}")
    return BagReading(dataset, messages, unreadable, reason, tuple(warnings))


def most_keypoints(paths: Sequence[Path], topic: str, mapping: FieldMapping | None = None) -> int:
    """Return how many keypoints the objects in the bags have, for an object nobody has described.

    Looks at the first messages of each bag and takes the number that most of them have, since a
    detector may send others while it sees nothing; or the highest, of a detector that leaves out
    what it does not see. Raises BagError if no message tells.
    """
    counts: Counter[int] = Counter()
    reason, partial = "", False
    for path in paths:
        with closing(open_bag(Path(path))) as bag:
            for chosen, kind, decode in keypoint_topics(bag, topic, mapping):
                partial |= may_omit_keypoints(kind)
                for raw in islice(bag.messages(chosen), _SAMPLE):
                    try:
                        message = decode(raw)
                        count = count_keypoints(message, kind)
                        if count:
                            read_observation(
                                message, kind, count, size=(1, 1)
                            )  # a damaged one says anything
                            counts[count] += 1
                    except Exception as error:  # as in read_bags
                        reason = reason or _text(error)
    if not counts:
        names = ", ".join(path.name for path in map(Path, paths))
        raise BagError(f"no message in {names} tells how many keypoints there are; {reason}")
    return max(counts) if partial else counts.most_common(1)[0][0]


def _text(error: Exception) -> str:
    """Return why a message is unreadable."""
    return str(error) if isinstance(error, MessageError) else f"cannot be decoded: {error!r}"


class Frame(NamedTuple):
    """One message to write: n objects of q keypoints.

    stamp: ns. points: (n, q, 2). confidence: (n, q), 0 where missing. frame_id: the camera.
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
    """Yield one frame each of points (f, q, 2) and confidence (f, q), `rate` a second.

    start: stamp of the first frame in ns. A `Dataset` gives `points` and, as confidence,
    `visible`.
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
    """Write the frames as messages of `input_type` into a new bag; return how many.

    storage: "sqlite3" or "mcap". A missing keypoint is written as NaN with confidence 0.
    Raises BagError if `path` exists.
    """
    if path.exists():
        raise BagError(f"bag {path} exists already; choose another name or remove it")
    kind, count = input_type.replace("/", "/msg/"), 0
    with Writer(path, version=9, storage_plugin=STORAGES[storage]) as writer:
        connection = writer.add_connection(topic, kind, typestore=_STORE)
        for frame in frames:
            message = _ENCODERS[input_type](frame)
            writer.write(connection, frame.stamp, _STORE.serialize_cdr(message, kind))
            count += 1
    return count


def _make(kind: str, *values: Any) -> Any:
    """Return a message of the type `kind`, fields in order."""
    return _STORE.types[kind](*values)


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
    """Return points (n, q, 2 or 3) with confidence (n, q) as a PointCloud2 for a bag."""
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
    """Return the frame, of one object, as a PolygonStamped."""
    (triples,) = _triples(frame).tolist()
    points = [_make("geometry_msgs/msg/Point32", *triple) for triple in triples]
    polygon = _make("geometry_msgs/msg/Polygon", points)
    return _make("geometry_msgs/msg/PolygonStamped", _header(frame), polygon)


_ENCODERS: dict[str, Callable[[Frame], Any]] = {
    POINT_CLOUD: _point_cloud,
    MULTI_ARRAY: _multi_array,
    POLYGON: _polygon,
}
