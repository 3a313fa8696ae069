# SPDX-License-Identifier: Apache-2.0
"""The serialised messages of a bag of ROS 2 or ROS 1, also of a damaged one.

A recording that was cut off (power failure, full disk, killed recorder) has no index, no metadata
or an incomplete page at its end. Its readable part is read, and a warning says what is lost.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any, NamedTuple, Protocol

import yaml
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys.store import Typestore

from deep_nrsfm_ros.data.definitions import DefinitionError, ros1_types

SUFFIXES = (".db3", ".mcap", ".bag")
"""Suffixes of the files of bags: SQLite and MCAP of ROS 2, and .bag of ROS 1."""

_METADATA = "metadata.yaml"
_LARGE = 2**28  # bytes of a bag that take seconds to read
_ROS1_MAGIC = b"#ROSBAG V"
_NO_METADATA = "it has no metadata.yaml, as after a recorder that was killed"


class BagError(ValueError):
    """A bag cannot be read or written; the message names the bag and the remedy."""


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: e.g. "/keypoints".
        type: e.g. "sensor_msgs/msg/PointCloud2".
        total: number of messages; of a damaged bag, as far as it is known.
        definition: definition of the type in .msg or .idl format; "" if the bag has none.
        type_hash: hash of the recorded definition (RIHS01); "" if unknown.
    """

    name: str
    type: str
    total: int
    definition: str = ""
    type_hash: str = ""

    @property
    def input_type(self) -> str:
        """Return the type as `messages.INPUT_TYPES` have it, e.g. "sensor_msgs/PointCloud2"."""
        return self.type.replace("/msg/", "/")


class Record(NamedTuple):
    """A recorded message: time of recording in ns, and serialised bytes."""

    time: int
    raw: bytes


class _Storage(Protocol):
    """A reader of a bag or of one of its files."""

    def topics(self) -> list[Topic]:
        """Return the topics."""

    def records(self, name: str) -> Iterator[Record]:
        """Yield the records of a topic; raise any exception where the file is damaged."""

    def close(self) -> None:
        """Close the file."""


class BagFile:
    """An open bag; close it after use.

    Attributes:
        path: bag folder or file.
        topics: all topics.
    """

    def __init__(self, path: Path, storages: list[_Storage], problem: str) -> None:
        """Take over open storages; `problem` says what is damaged, "" if nothing is."""
        self.path, self._storages, self._problem = path, storages, problem
        counts: Counter[tuple[str, str]] = Counter()
        definitions: dict[str, str] = {}
        hashes: dict[str, str] = {}
        for storage in storages:
            for topic in storage.topics():
                if not isinstance(topic.name, str) or not isinstance(topic.type, str):
                    continue  # a damaged table may have lost either
                counts[topic.name, topic.type] += topic.total
                definitions[topic.type] = definitions.get(topic.type) or topic.definition
                hashes[topic.type] = hashes.get(topic.type) or topic.type_hash
        recorded = _recorded_counts(path)
        self.topics = [
            Topic(name, kind, max(count, recorded.get(name, 0)), definitions[kind], hashes[kind])
            for (name, kind), count in counts.items()
        ]
        self._read: Counter[str] = Counter()  # messages read so far, by topic

    def messages(self, topic: Topic) -> Iterator[bytes]:
        """Yield the serialised messages of a topic, in order of time within each file."""
        return (record.raw for record in self.records(topic))

    def records(self, topic: Topic) -> Iterator[Record]:
        """Yield the records of a topic, in order of time within each file.

        Where a file is damaged it ends without an exception; see `warning`.
        """
        for storage in self._storages:
            try:
                for record in storage.records(topic.name):
                    self._read[topic.name] += 1
                    yield record
            except GeneratorExit:
                raise
            except Exception as error:  # a damaged file fails in many ways; keep what was read
                self._problem = self._problem or str(error)

    def sample(self, topic: Topic) -> Iterator[bytes]:
        """Yield messages of a topic that do not count as read; end where a file is damaged."""
        for storage in self._storages:
            with suppress(Exception):
                yield from (record.raw for record in storage.records(topic.name))

    def has_messages(self, topic: Topic) -> bool:
        """Return whether there is a message of a topic; a damaged bag may not have counted them."""
        return bool(topic.total) or next(self.sample(topic), None) is not None

    def warning(self, topic: Topic) -> str:
        """Return a sentence on the lost messages of a topic after reading it; "" if none is."""
        if not self._problem:
            return ""
        read, lost = self._read[topic.name], topic.total - self._read[topic.name]
        loss = f"{lost} of {topic.total} messages are lost" if lost > 0 else "its end may be lost"
        state = "is incomplete" if self._problem == _NO_METADATA else "is damaged"
        return f"bag {self.path} {state} ({self._problem}); read {read} messages, {loss}"

    def close(self) -> None:
        """Close the files."""
        for storage in self._storages:
            storage.close()


def open_bag(path: Path) -> BagFile:
    """Open a bag, sound or damaged.

    Args:
        path: bag folder, or a single .db3, .mcap or .bag file. A folder without metadata.yaml is
            read file by file, as the parts of a ROS 1 recording are.

    Raises:
        BagError: the bag is missing, is no bag, or nothing of it can be read.
    """
    if not path.exists():
        raise BagError(f"bag {path} does not exist")
    folder = path.is_dir()
    if not folder and is_ros1(path):
        try:
            return BagFile(path, [_Ros1(path)], "")
        except Exception as error:  # rosbags raises exceptions of many types
            raise BagError(_ros1_problem(path, error)) from None
    try:
        return BagFile(path, [_Sound(path)], "")
    except Exception as error:  # a damaged bag makes rosbags raise exceptions of many types
        problem = _NO_METADATA if folder and not (path / _METADATA).exists() else str(error)
        not_allowed = isinstance(error, PermissionError)
    files = sorted(f for f in path.iterdir() if f.suffix in SUFFIXES) if folder else [path]
    files = [file for file in files if not file.name.startswith("._")]  # macOS's companions
    storages: list[_Storage] = []
    for file in files:
        for kind in _readers_of(file):
            try:
                storages.append(kind(file))
                if kind is not _Sound and kind is not _Ros1 and problem == _NO_METADATA:
                    problem = f"{file.name} was cut off"
                break
            except Exception as error:  # try the next reader, and the next file
                if problem == _NO_METADATA:
                    problem = f"{file.name}: {error}"
    if (
        files
        and all(isinstance(storage, _Ros1) for storage in storages)
        and (problem == _NO_METADATA)
    ):
        problem = ""  # a recording of ROS 1 has none
    bag = BagFile(path, storages, problem)
    if not bag.topics:
        bag.close()
        raise BagError(f"bag {path} cannot be read: {problem}{_advice(path, not_allowed)}")
    return bag


def opens_quickly(path: Path) -> bool:
    """Return whether `open_bag` takes milliseconds, not the time to read all of the bag.

    It does not where files are compressed as a whole, or large and without a readable index.
    """
    files = list(path.iterdir()) if path.is_dir() else [path]
    if sum(file.stat().st_size for file in files if file.is_file()) < _LARGE:
        return True
    with suppress(Exception):
        if path.is_dir() and "compression_mode: file" in (path / _METADATA).read_text().lower():
            return False
        (_Ros1 if is_ros1(path) else _Sound)(path).close()
        return True
    return False


def _readers_of(file: Path) -> tuple[Callable[[Path], _Storage], ...]:
    """Return the readers to try on a file, the one for a sound file first."""
    if is_ros1(file):
        return (_Ros1,)
    return (_Sound, _CutSqlite if file.suffix == ".db3" else _CutMcap)


def is_ros1(file: Path) -> bool:
    """Return whether a file begins as a bag of ROS 1, whatever its suffix."""
    with suppress(OSError), file.open("rb") as content:
        return content.read(len(_ROS1_MAGIC)) == _ROS1_MAGIC
    return False


def _ros1_problem(path: Path, error: Exception) -> str:
    """Return why a bag of ROS 1 cannot be read, and the remedy."""
    text = f"bag {path} of ROS 1 cannot be read: {error}"
    if isinstance(error, OSError):
        return text
    return f"{text}; if its recording was cut off, `rosbag reindex` of ROS 1 restores its index"


def _advice(path: Path, not_allowed: bool) -> str:
    """Return a remedy for a bag of which nothing can be read; "" where there is none."""
    if not_allowed:
        return ""
    if path.is_file():
        if not path.stat().st_size:
            return "; the file is empty"
        if path.suffix == ".bag":
            return "; it does not begin as a bag of ROS 1 does"
    return "; is it a recording of rosbag2?"


def lifter_topics(bag: BagFile) -> list[tuple[Topic, Topic]]:
    """Return the pair of topics `points` and `camera_rotation` of every recorded lifter."""
    topics = {topic.name: topic for topic in bag.topics}
    pairs = []
    for name, points in topics.items():
        rotation = topics.get(f"{name.removesuffix('points')}camera_rotation")
        if name.endswith("/points") and rotation:
            pairs.append((points, rotation))
    return pairs


def _recorded_counts(path: Path) -> dict[str, int]:
    """Return the number of messages per topic in metadata.yaml; {} if it is missing or damaged."""
    with suppress(Exception):
        text = (path / "metadata.yaml").read_text()
        topics = yaml.safe_load(text)["rosbag2_bagfile_information"]
        return {
            str(t["topic_metadata"]["name"]): int(t["message_count"])
            for t in topics["topics_with_message_count"]
        }
    return {}


def _topic(connection: Any, total: int) -> Topic:
    """Return a connection of rosbags as a topic with `total` messages."""
    text, type_hash = connection.msgdef.data, connection.digest or ""
    if not type_hash.startswith("RIHS01_"):
        type_hash = ""
    return Topic(connection.topic, connection.msgtype, total, text, type_hash)


class _Sound:
    """A sound bag or bag file, read by rosbags."""

    def __init__(self, path: Path) -> None:
        """Open the bag; raise what rosbags raises."""
        self._reader = Reader(path)
        self._reader.open()
        self.close = self._reader.close

    def topics(self) -> list[Topic]:
        """Return the topics."""
        return [_topic(c, c.msgcount) for c in self._reader.connections]

    def records(self, name: str) -> Iterator[Record]:
        """Yield the records of a topic."""
        connections = [c for c in self._reader.connections if c.topic == name]
        for _, time, raw in self._reader.messages(connections) if connections else ():
            yield Record(time, raw)


class _Ros1:
    """A bag file of ROS 1; its messages are converted to those of ROS 2."""

    def __init__(self, path: Path) -> None:
        """Open the bag; raise what rosbags raises."""
        self._reader = Ros1Reader(path)
        self._reader.open()
        self.close = self._reader.close
        self._stores: dict[tuple[str, str], Typestore] = {}
        for connection in self._reader.connections:
            with suppress(DefinitionError):  # the messages of a type that nobody defines
                key = connection.msgtype, connection.msgdef.data
                self._stores[key] = self._stores.get(key) or ros1_types(*key)

    def topics(self) -> list[Topic]:
        """Return the topics, with definitions of ROS 2."""
        topics = []
        for connection in self._reader.connections:
            kind, text = connection.msgtype, connection.msgdef.data
            if store := self._stores.get((kind, text)):
                text = store.generate_msgdef(kind, ros_version=2)[0]
            topics.append(Topic(connection.topic, kind, connection.msgcount, text))
        return topics

    def records(self, name: str) -> Iterator[Record]:
        """Yield the records of a topic; a message that cannot be converted remains as it is."""
        connections = [c for c in self._reader.connections if c.topic == name]
        for connection, time, raw in self._reader.messages(connections) if connections else ():
            kind, converted = connection.msgtype, raw
            if store := self._stores.get((kind, connection.msgdef.data)):
                with suppress(Exception):  # damaged bytes fail in many ways
                    converted = bytes(store.ros1_to_cdr(raw, kind))
            yield Record(time, converted)


class _CutMcap:
    """An mcap file without its end; records are scanned one by one up to the cut."""

    def __init__(self, path: Path) -> None:
        """Find the topics; raise ValueError if the beginning is missing."""
        self._reader: Any = McapReader(path)
        with suppress(Exception):
            self._reader.open()  # fails without an index, but has found the first record
        self._reader.bio, self._reader.data_end = path.open("rb"), path.stat().st_size
        self.close = self._reader.close
        if not self._reader.data_start:
            self.close()
            raise ValueError("not the beginning of an mcap file")
        with suppress(Exception):
            self._reader.meta_scan()

    def topics(self) -> list[Topic]:
        """Return the topics; the number of messages is unknown."""
        return [_topic(c, 0) for c in self._reader.connections]

    def records(self, name: str) -> Iterator[Record]:
        """Yield the records of a topic up to the cut."""
        connections = [c for c in self._reader.connections if c.topic == name]
        for _, time, raw in self._reader.messages_scan(connections):
            yield Record(time, raw)


class _CutSqlite:
    """An sqlite3 file without its end."""

    def __init__(self, path: Path) -> None:
        """Find the topics; raise sqlite3.Error if they are missing."""
        self._copy = _whole_pages(path)
        uri = Path(self._copy.name).absolute().as_uri()
        self._file = sqlite3.connect(f"{uri}?immutable=1", uri=True)
        # Without it SQLite refuses a file that is shorter than its header says.
        self._file.execute("PRAGMA writable_schema = ON")
        self._topics = self._file.execute("SELECT id, name, type FROM topics").fetchall()
        self._definitions: dict[str, str] = {}
        with suppress(sqlite3.Error):  # older bags have no definitions
            query = "SELECT topic_type, encoded_message_definition FROM message_definitions"
            self._definitions = dict(self._file.execute(query).fetchall())

    def topics(self) -> list[Topic]:
        """Return the topics; the number of messages is unknown."""
        return [
            Topic(name, kind, 0, self._definitions.get(kind, "")) for _, name, kind in self._topics
        ]

    def records(self, name: str) -> Iterator[Record]:
        """Yield the records of a topic up to the cut."""
        wanted = {number for number, topic, _ in self._topics if topic == name}
        rows = self._file.execute("SELECT topic_id, timestamp, data FROM messages")
        for number, time, raw in rows:
            if number in wanted:
                yield Record(time, raw)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._copy.close()


def _whole_pages(path: Path) -> IO[bytes]:
    """Return the open sqlite3 file, or a temporary copy without the torn page at its end.

    SQLite would read the missing part of a torn page as zeros and return half a message.
    """
    file = path.open("rb")
    page, size = int.from_bytes(file.read(18)[16:], "big"), path.stat().st_size
    page = 65536 if page == 1 else page  # the SQLite format encodes 65536 as 1
    if not page or size % page == 0:
        return file
    copy = NamedTemporaryFile(suffix=path.suffix)  # noqa: SIM115 - the caller closes it
    with file:
        file.seek(0)
        shutil.copyfileobj(file, copy)
    copy.truncate(size - size % page)
    copy.flush()
    return copy
