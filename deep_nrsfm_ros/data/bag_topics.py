# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag that carry keypoints, and how their messages are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import islice
from typing import Any, NamedTuple

from deep_nrsfm_ros.data.bag_files import BagError, BagFile, Topic, lifter_topics
from deep_nrsfm_ros.data.definitions import DefinitionError, find_types
from deep_nrsfm_ros.lifting.observation import MessageError
from deep_nrsfm_ros.messages.decoding import INPUT_TYPES, InputType, read_observation
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from deep_nrsfm_ros.messages.mapping_file import shipped_mappings
from deep_nrsfm_ros.messages.topics import WILDCARD, match

_SAMPLE = 16  # messages of a topic that are read to see whether it fits


class KeypointTopic(NamedTuple):
    """A topic with keypoints.

    Attributes:
        topic: name, type and number of messages.
        input_type: what `read_observation` needs to read its messages.
        decode: returns the message of serialised bytes, or raises.
    """

    topic: Topic
    input_type: InputType
    decode: Callable[[bytes], Any]


def keypoint_topics(
    bag: BagFile, name: str, mapping: FieldMapping | None, keypoints: int | None = None
) -> list[KeypointTopic]:
    """Return the topics with keypoints to read from a bag; topics without messages do not count.

    Args:
        bag: an open bag.
        name: name of a topic, or of several by a `*`; "" = the only topic of a supported type, or
            of the mapping's type if there is a mapping.
        mapping: makes its type a supported one.
        keypoints: number q of keypoints of the detector's layout; where no name is given and
            several topics are of a supported type, the only one with q keypoints is taken. None:
            unknown.

    Raises:
        BagError: there is no such topic, none of them has a message, or there is more than one
            without a `*`. It lists the topics.
    """
    chosen = find_topics(bag, name, mapping)
    if len(chosen) > 1 and not name and keypoints is not None:
        fitting = [topic for topic in chosen if _fits(bag, topic, keypoints)]
        chosen = fitting if len(fitting) == 1 else chosen
    if len(chosen) > 1 and WILDCARD not in name:
        listing = ", ".join(map(_described, chosen))
        many = f"{len(chosen)} topics called {name}" if name else f"{len(chosen)} keypoint topics"
        raise BagError(f"bag {bag.path} has {many}; name one of: {listing}")
    return [KeypointTopic(*pair, _decoder(bag, pair[0])) for pair in chosen]


def find_topics(
    bag: BagFile, name: str, mapping: FieldMapping | None
) -> list[tuple[Topic, InputType]]:
    """Return the topics with messages that may be meant, and their types; none is read.

    Args:
        bag: an open bag.
        name: as in `keypoint_topics`.
        mapping: as in `keypoint_topics`.

    Raises:
        BagError: as in `keypoint_topics`, but for more than one topic.
    """
    kinds: dict[str, InputType] = {kind: kind for kind in INPUT_TYPES}
    if mapping:
        kinds[mapping.type] = mapping
    if name:
        chosen = [t for t in bag.topics if match(name, t.name) is not None]
    else:
        wanted = [mapping.type] if mapping else INPUT_TYPES
        lifted = {points.name for points, _ in lifter_topics(bag)}  # 3D points, not keypoints
        chosen = [t for t in bag.topics if t.input_type in wanted and t.name not in lifted]
    if not chosen:
        missing = f"no topic called {name}" if name else "no keypoint topic"
        if mapping and not name:
            missing = f"no topic of type {mapping.type}, that of the field mapping"
        listing = ", ".join(f"{t.name} [{t.input_type}]" for t in bag.topics)
        has = f"its topics are: {listing}" if listing else "it has no topics at all"
        raise BagError(f"bag {bag.path} has {missing}; {has}{_mapping_hint(bag.topics, mapping)}")
    filled = [topic for topic in chosen if bag.has_messages(topic)]
    if not filled:
        names = " and ".join(f"{t.name} [{t.input_type}]" for t in chosen)
        others = [f"{t.name} [{t.input_type}]" for t in bag.topics if t not in chosen and t.total]
        with_messages = f"; topics with messages: {', '.join(others)}" if others else ""
        raise BagError(
            f"bag {bag.path} has no message on {names}: the topic was recorded, but nothing was "
            f"published on it{with_messages}"
        )
    for topic in filled:
        if topic.input_type not in kinds:
            raise BagError(
                f"topic {topic.name} of bag {bag.path} has type {topic.input_type}; "
                f"it must be one of {', '.join(kinds)}, or come with a field mapping"
                + _mapping_hint([topic], mapping)
            )
    return [(topic, kinds[topic.input_type]) for topic in filled]


def _mapping_hint(topics: Iterable[Topic], mapping: FieldMapping | None) -> str:
    """Return which field mapping of the package reads one of some topics; "" if none does."""
    if mapping:
        return ""
    for topic in topics:
        if files := shipped_mappings(topic.input_type):
            return f"; {files[0]} is a field mapping of {topic.input_type} (--mapping)"
    return ""


def _described(pair: tuple[Topic, InputType]) -> str:
    """Return name, type and number of messages of a topic."""
    topic = pair[0]
    count = f", {topic.total} messages" if topic.total else ""
    return f"{topic.name} [{topic.input_type}{count}]"


def _fits(bag: BagFile, pair: tuple[Topic, InputType], keypoints: int) -> bool:
    """Return whether one of the first messages of a topic has objects of `keypoints` keypoints."""
    topic, input_type = pair
    with suppress(Exception):  # unknown definitions and damaged messages: it does not fit
        decode = _decoder(bag, topic)
        for raw in islice(bag.sample(topic), _SAMPLE):
            with suppress(Exception):
                found = read_observation(decode(raw), input_type, keypoints, size=(1, 1))
                if len(found.confidence):
                    return True
    return False


def _decoder(bag: BagFile, topic: Topic) -> Callable[[bytes], Any]:
    """Return the decoder of the messages of a topic; raise BagError if its type is unknown."""
    try:
        store, origin = find_types(topic.type, topic.definition, topic.type_hash)
    except DefinitionError as error:
        raise BagError(f"bag {bag.path} {error}") from None

    def decode(raw: bytes) -> Any:
        try:
            return store.deserialize_cdr(raw, topic.type)
        except Exception as error:  # damaged bytes fail in many ways
            if not origin:
                raise
            package = topic.type.split("/")[0]
            raise MessageError(
                f"cannot be decoded by the definition of {topic.input_type} {origin} ({error!r}); "
                f"the bag has none: source the version of {package} with which it was recorded"
            ) from None

    return decode
