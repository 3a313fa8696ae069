"""The raw messages of a bag, as far as they can be read.

A recording that was cut off (power lost, disk full, recorder killed) has no index, no metadata or
half a page at its end. Its readable part is given, with a warning that says what is lost.
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
    """A bag that cannot be read or written: names the bag and the mend."""


class Topic(NamedTuple):
    """A topic of a bag: its name, type ("sensor_msgs/msg/PointCloud2") and number of messages.

    definition: of the type, in the words of a .msg or .idl file; "" if the bag has none.
    """

    name: str
    type: str
    total: int
    definition: str = ""

    @property
    def input_type(self) -> str:
        """Return the type as `messages.INPUT_TYPES` write it."""
        return self.type.replace("/msg/", "/")


class Record(NamedTuple):
    """A message as it was recorded: when, in ns, and its serialised bytes."""

    time: int
    raw: bytes


class _Storage(Protocol):
    """What reads one bag or one of its files."""

    def topics(self) -> list[Topic]:
        """Return what is there."""

    def records(self, name: str) -> Iterator[Record]:
        """Yield the records of a topic; raise anything where the file is damaged."""

    def close(self) -> None:
        """Free the file."""


class BagFile:
    """An open bag. Close it after use."""

    def __init__(self, path: Path, storages: list[_Storage], problem: str) -> None:
        """Take over open storages; `problem` says what was wrong when they were opened."""
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
        self._given: Counter[str] = Counter()

    def messages(self, topic: Topic) -> Iterator[bytes]:
        """Yield the serialised messages of `topic`, by time within each file."""
        return (record.raw for record in self.records(topic))

    def records(self, topic: Topic) -> Iterator[Record]:
        """Yield the messages of `topic` with their times, by time within each file."""
        for storage in self._storages:
            try:
                for record in storage.records(topic.name):
                    self._given[topic.name] += 1
                    yield record
            except GeneratorExit:
                raise
            except Exception as error:  # damaged files fail in many ways; what was read counts
                self._problem = self._problem or str(error)

    def warning(self, topic: Topic) -> str:
        """Return what is lost of `topic` once it has been read, or "" for a sound bag."""
        if not self._problem:
            return ""
        given, lost = self._given[topic.name], topic.total - self._given[topic.name]
        share = f"{lost} of {topic.total} messages are lost" if lost > 0 else "its end may be lost"
        return f"bag {self.path} is damaged ({self._problem}); read {given} messages, {share}"

    def close(self) -> None:
        """Free the files."""
        for storage in self._storages:
            storage.close()


def open_bag(path: Path) -> BagFile:
    """Open a bag folder or a single .db3 or .mcap file, sound or cut off.

    Raises BagError when the bag is missing, is no bag, or nothing of it can be read.
    """
    if not path.exists():
        raise BagError(f"bag {path} does not exist")
    try:
        return BagFile(path, [_Sound(path)], "")
    except Exception as error:  # rosbags raises many kinds for a damaged bag
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
    """Return the topics `points` and `camera_rotation` of every lifter that was recorded."""
    topics = {topic.name: topic for topic in bag.topics}
    pairs = []
    for name, points in topics.items():
        rotation = topics.get(f"{name.removesuffix('points')}camera_rotation")
        if name.endswith("/points") and rotation:
            pairs.append((points, rotation))
    return pairs


def _recorded_counts(path: Path) -> dict[str, int]:
    """Return the messages per topic that metadata.yaml speaks of, if it is there and sound."""
    with suppress(Exception):
        text = (path / "metadata.yaml").read_text()
        topics = yaml.safe_load(text)["rosbag2_bagfile_information"]
        return {
            str(t["topic_metadata"]["name"]): int(t["message_count"])
            for t in topics["topics_with_message_count"]
        }
    return {}


def _topic(connection: Any, total: int) -> Topic:
    """Return a connection of rosbags as a topic."""
    return Topic(connection.topic, connection.msgtype, total, connection.msgdef.data)


class _Sound:
    """A bag, or a file of one, that rosbags can read."""

    def __init__(self, path: Path) -> None:
        """Open; raise what rosbags raises."""
        self._reader = Reader(path)
        self._reader.open()
        self.close = self._reader.close

    def topics(self) -> list[Topic]:
        """Return what is there."""
        return [_topic(c, c.msgcount) for c in self._reader.connections]

    def records(self, name: str) -> Iterator[Record]:
        """Yield the records of a topic."""
        connections = [c for c in self._reader.connections if c.topic == name]
        for _, time, raw in self._reader.messages(connections) if connections else ():
            yield Record(time, raw)


class _CutMcap:
    """An mcap file without its end: records are read one after the other up to the cut."""

    def __init__(self, path: Path) -> None:
        """Find the topics; raise ValueError when even the beginning is missing."""
        self._reader: Any = McapReader(path)
        with suppress(Exception):
            self._reader.open()  # fails for want of the index, after finding the first record
        self._reader.bio, self._reader.data_end = path.open("rb"), path.stat().st_size
        self.close = self._reader.close
        if not self._reader.data_start:
            self.close()
            raise ValueError("not the beginning of an mcap file")
        with suppress(Exception):
            self._reader.meta_scan()

    def topics(self) -> list[Topic]:
        """Return what is there; how many messages is unknown."""
        return [_topic(c, 0) for c in self._reader.connections]

    def records(self, name: str) -> Iterator[Record]:
        """Yield the records of a topic up to the cut."""
        connections = [c for c in self._reader.connections if c.topic == name]
        for _, time, raw in self._reader.messages_scan(connections):
            yield Record(time, raw)


class _CutSqlite:
    """An sqlite3 file without its end."""

    def __init__(self, path: Path) -> None:
        """Find the topics; raise sqlite3.Error when even they are missing."""
        self._copy = _whole_pages(path)
        uri = Path(self._copy.name).absolute().as_uri()
        self._file = sqlite3.connect(f"{uri}?immutable=1", uri=True)
        # Otherwise sqlite refuses a file shorter than its header says.
        self._file.execute("PRAGMA writable_schema = ON")
        self._topics = self._file.execute("SELECT id, name, type FROM topics").fetchall()
        self._definitions: dict[str, str] = {}
        with suppress(sqlite3.Error):  # older bags have none
            found = "SELECT topic_type, encoded_message_definition FROM message_definitions"
            self._definitions = dict(self._file.execute(found).fetchall())

    def topics(self) -> list[Topic]:
        """Return what is there; how many messages is unknown."""
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
        """Free the file."""
        self._file.close()
        self._copy.close()


def _whole_pages(path: Path) -> IO[bytes]:
    """Return the open sqlite3 file, or a temporary copy without the torn page at its end.

    sqlite would take the missing part of a torn page for zeros and give a message half empty.
    """
    file = path.open("rb")
    page, size = int.from_bytes(file.read(18)[16:], "big"), path.stat().st_size
    page = 65536 if page == 1 else page  # as the format has it
    if not page or size % page == 0:
        return file
    copy = NamedTemporaryFile(suffix=path.suffix)  # noqa: SIM115 - the caller closes it
    with file:
        file.seek(0)
        shutil.copyfileobj(file, copy)
    copy.truncate(size - size % page)
    copy.flush()
    return copy
