"""Which topics of a bag carry keypoints, and how their messages are read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from deep_nrsfm_ros.data.bag_files import BagError, BagFile, Topic, lifter_topics
from deep_nrsfm_ros.messages.decoding import INPUT_TYPES, InputType
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from deep_nrsfm_ros.messages.topics import WILDCARD, match

_STORE = get_typestore(Stores.ROS2_JAZZY)
_IDL = "=" * 80 + "\nIDL: "  # how a definition in the words of .idl begins


class KeypointTopic(NamedTuple):
    """A topic with keypoints, how `read_observation` reads it, and what makes messages of bytes."""

    topic: Topic
    input_type: InputType
    decode: Callable[[bytes], Any]


def keypoint_topics(bag: BagFile, name: str, mapping: FieldMapping | None) -> list[KeypointTopic]:
    """Return the topics called `name`, which may have a `*`, or the only one of a supported type.

    mapping: makes its type a supported one; "" then means a topic of that type. Raises BagError
    that lists the topics.
    """
    kinds: dict[str, InputType] = {kind: kind for kind in INPUT_TYPES}
    if mapping:
        kinds[mapping.type] = mapping
    listing = ", ".join(f"{t.name} [{t.input_type}]" for t in bag.topics) or "no topics"
    if name:
        found = [t for t in bag.topics if match(name, t.name) is not None]
    else:
        wanted = [mapping.type] if mapping else INPUT_TYPES
        answers = {points.name for points, _ in lifter_topics(bag)}  # of such a type, but not meant
        found = [t for t in bag.topics if t.input_type in wanted and t.name not in answers]
    if not found or len(found) > 1 and WILDCARD not in name:
        many = f"{len(found)} topics called {name}" if name else f"{len(found)} keypoint topics"
        raise BagError(f"bag {bag.path} has {many}; name one of: {listing}")
    for topic in found:
        if topic.input_type not in kinds:
            raise BagError(
                f"topic {topic.name} of bag {bag.path} has type {topic.input_type}; "
                f"it must be one of {', '.join(kinds)}, or come with a field mapping"
            )
    return [KeypointTopic(t, kinds[t.input_type], _decoder(bag, t)) for t in found]


def _decoder(bag: BagFile, topic: Topic) -> Callable[[bytes], Any]:
    """Return what makes messages of `topic` from bytes, by the definition that the bag carries."""
    store, text = _STORE, topic.definition
    if topic.type not in store.types:
        if not text:
            raise BagError(
                f"bag {bag.path} does not carry the definition of {topic.input_type}: record it "
                "with ROS 2 Iron or later, or as mcap"
            )
        store = get_typestore(Stores.ROS2_JAZZY)  # for this bag: others may define it otherwise
        try:
            idl = text.startswith(_IDL)
            types = get_types_from_idl(text) if idl else get_types_from_msg(text, topic.type)
            store.register({k: v for k, v in types.items() if k not in store.types})
            if topic.type not in store.types:
                raise ValueError("it defines other types")
        except Exception as error:  # damaged in any way, as all in a bag may be
            raise BagError(
                f"bag {bag.path} has no readable definition of {topic.input_type}: {error!r}"
            ) from None
    return lambda raw: store.deserialize_cdr(raw, topic.type)
