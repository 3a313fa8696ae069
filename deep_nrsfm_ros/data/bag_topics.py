"""The topics of a bag that carry keypoints, and how their messages are read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from deep_nrsfm_ros.data.bag_files import BagError, BagFile, Topic, lifter_topics
from deep_nrsfm_ros.messages.decoding import INPUT_TYPES, InputType
from deep_nrsfm_ros.messages.field_mapping import FieldMapping
from deep_nrsfm_ros.messages.topics import WILDCARD, match

_STORE = get_typestore(Stores.ROS2_JAZZY)
_IDL = "=" * 80 + "\nIDL: "  # first characters of a definition in .idl format


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


def keypoint_topics(bag: BagFile, name: str, mapping: FieldMapping | None) -> list[KeypointTopic]:
    """Return the topics with keypoints to read from a bag.

    Args:
        bag: an open bag.
        name: name of a topic, or of several by a `*`; "" = the only topic of a supported type, or
            of the mapping's type if there is a mapping.
        mapping: makes its type a supported one.

    Raises:
        BagError: there is no such topic, or more than one without a `*`. It lists the topics.
    """
    kinds: dict[str, InputType] = {kind: kind for kind in INPUT_TYPES}
    if mapping:
        kinds[mapping.type] = mapping
    listing = ", ".join(f"{t.name} [{t.input_type}]" for t in bag.topics) or "no topics"
    if name:
        chosen = [t for t in bag.topics if match(name, t.name) is not None]
    else:
        wanted = [mapping.type] if mapping else INPUT_TYPES
        lifted = {points.name for points, _ in lifter_topics(bag)}  # 3D points, not keypoints
        chosen = [t for t in bag.topics if t.input_type in wanted and t.name not in lifted]
    if not chosen or len(chosen) > 1 and WILDCARD not in name:
        many = f"{len(chosen)} topics called {name}" if name else f"{len(chosen)} keypoint topics"
        raise BagError(f"bag {bag.path} has {many}; name one of: {listing}")
    for topic in chosen:
        if topic.input_type not in kinds:
            raise BagError(
                f"topic {topic.name} of bag {bag.path} has type {topic.input_type}; "
                f"it must be one of {', '.join(kinds)}, or come with a field mapping"
            )
    return [KeypointTopic(t, kinds[t.input_type], _decoder(bag, t)) for t in chosen]


def _decoder(bag: BagFile, topic: Topic) -> Callable[[bytes], Any]:
    """Return the decoder of the messages of a topic, by the type definition in the bag."""
    store, text = _STORE, topic.definition
    if topic.type not in store.types:
        if not text:
            raise BagError(
                f"bag {bag.path} does not carry the definition of {topic.input_type}: record it "
                "with ROS 2 Iron or later, or as mcap"
            )
        store = get_typestore(Stores.ROS2_JAZZY)  # another bag may define the type differently
        try:
            idl = text.startswith(_IDL)
            types = get_types_from_idl(text) if idl else get_types_from_msg(text, topic.type)
            store.register({k: v for k, v in types.items() if k not in store.types})
            if topic.type not in store.types:
                raise ValueError("it defines other types")
        except Exception as error:  # a damaged definition fails in many ways
            raise BagError(
                f"bag {bag.path} has no readable definition of {topic.input_type}: {error!r}"
            ) from None
    return lambda raw: store.deserialize_cdr(raw, topic.type)
