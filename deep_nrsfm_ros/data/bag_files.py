"""The serialised messages of a bag, also of a damaged one.

A recording that was cut off (power failure, full disk, killed recorder) has no index, no metadata
or an incomplete page at its end. Its readable part is read, and a warning says what is lost.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Any, NamedTuple, Protocol

import yaml
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.storage_mcap import McapReader

SUFFIXES = (".db3", ".mcap")


class BagError(ValueError):
    """A bag cannot be read or written; the message names the bag and the remedy."""


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: e.g. "/keypoints".
        type: e.g. "sensor_msgs/msg/PointCloud2".
        total: number of messages; of a damaged bag, as far as it is known.
        definition: definition of the type in .msg or .idl format; "" if the bag has none.
    """

    name: str
    type: str
    total: int
    definition: str = ""

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
        for storage in storages:
            for topic in storage.topics():
                if not isinstance(topic.name, str) or not isinstance(topic.type, str):
                    continue  # a damaged table may have lost either
                counts[topic.name, topic.type] += topic.total
                definitions[topic.type] = definitions.get(topic.type) or topic.definition
        recorded = _recorded_counts(path)
        self.topics = [
            Topic(name, kind, max(count, recorded.get(name, 0)), definitions[kind])
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

    def warning(self, topic: Topic) -> str:
        """Return a sentence on the lost messages of a topic after reading it; "" if none is."""
        if not self._problem:
            return ""
        read, lost = self._read[topic.name], topic.total - self._read[topic.name]
        loss = f"{lost} of {topic.total} messages are lost" if lost > 0 else "its end may be lost"
        return f"bag {self.path} is damaged ({self._problem}); read {read} messages, {loss}"

    def close(self) -> None:
        """Close the files."""
        for storage in self._storages:
            storage.close()


def open_bag(path: Path) -> BagFile:
    """Open a bag, sound or damaged.

    Args:
        path: bag folder, or a single .db3 or .mcap file.

    Raises:
        BagError: the bag is missing, is no bag, or nothing of it can be read.
    """
    if not path.exists():
        raise BagError(f"bag {path} does not exist")
    try:
        return BagFile(path, [_Sound(path)], "")
    except Exception as error:  # a damaged bag makes rosbags raise exceptions of many types
        problem = str(error)
    files = sorted(f for f in path.iterdir() if f.suffix in SUFFIXES) if path.is_dir() else [path]
    storages: list[_Storage] = []
    for file in files:
        for kind in (_Sound, _CutSqlite if file.suffix == ".db3" else _CutMcap):
            with suppress(Exception):
                storages.append(kind(file))
                break
    bag = BagFile(path, storages, problem)
    if not bag.topics:
        bag.close()
        raise BagError(f"bag {path} cannot be read: {problem}; is it a rosbag2 recording?")
    return bag


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
    return Topic(connection.topic, connection.msgtype, total, connection.msgdef.data)


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
