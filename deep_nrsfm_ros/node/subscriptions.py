"""Which topics the lifter listens to, of which type, and what keeps it from hearing anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from deep_nrsfm_ros.lifting.tracking import Tracker
from deep_nrsfm_ros.messages.decoding import INPUT_TYPES, InputType, resolve_input_type, type_name
from deep_nrsfm_ros.messages.dropped_messages import DroppedMessages
from deep_nrsfm_ros.messages.pipeline import AUTO, InputOptions
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.messages.topics import WILDCARD, match
from deep_nrsfm_ros.node.message_types import decoder, message_class

DEFAULT_TOPIC = "keypoints"
SENSOR_INPUT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

LOG_PERIOD = 2.0
"""Seconds in which the same complaint is logged once."""


@dataclass(frozen=True)
class KeypointTopic:
    """A topic that is heard: how its messages are read, and who is who in them."""

    topic: str
    reader: MessageReader
    tracker: Tracker
    dropped: DroppedMessages


class KeypointSubscriptions:
    """Subscribes to the topics of `InputOptions`, to some as soon as they are there."""

    def __init__(
        self,
        node: Node,
        inputs: InputOptions,
        on_message: Callable[[KeypointTopic, bytes], None],
        on_trouble: Callable[[str], None],
        on_missed: Callable[[int], None],
    ) -> None:
        """Listen to what is known by now; call `look` now and then for the rest.

        on_trouble: is told of publishers that cannot be heard, and of the mend. on_missed: is told
        how many messages have not come since the last `look`. Raises ValueError if the type of
        the messages is none, or its package is not here.
        """
        self._node, self._on_message, self._on_trouble = node, on_message, on_trouble
        self._on_missed = on_missed
        self._log = node.get_logger()
        self._type: InputType | None = None
        if inputs.input_type != AUTO:
            self._type = resolve_input_type("input_type", inputs.input_type)
            message_class(type_name(self._type))
        self._own = f"{node.get_fully_qualified_name()}/"
        wanted = map(self._resolve, inputs.topics or (DEFAULT_TOPIC,))
        self.topics = tuple(dict.fromkeys(wanted))
        self._heard: dict[str, tuple[KeypointTopic, Subscription]] = {}
        for topic in self.topics:
            if self._type and WILDCARD not in topic:
                self._listen(topic, self._type)
        self.look(idle=False)
        for topic in self.topics:
            if not any(match(topic, heard) is not None for heard in self._heard):
                self._log.info(f"waiting for a publisher on {topic}")

    @property
    def heard(self) -> str:
        """Return the topics that are heard, with their types, in words."""
        sources = (source for source, _ in self._heard.values())
        return (
            ", ".join(f"{s.topic} ({type_name(s.reader.input_type)})" for s in sources)
            or "none yet"
        )

    def look(self, *, idle: bool) -> None:
        """Find what was missed, and topics that have come and gone. Call it once a second.

        idle: nothing has come lately, so see if there are publishers that cannot be heard.
        """
        for source, _ in self._heard.values():
            there = self._node.get_publishers_info_by_topic(source.topic)
            self._on_missed(source.dropped.take_count(bytes(one.endpoint_gid) for one in there))
        for pattern in self.topics:
            if WILDCARD in pattern:
                for topic in self._matching(pattern):
                    self._meet(topic, idle)
            elif pattern not in self._heard:
                self._meet(pattern, idle)
        if idle:
            for source, _ in list(self._heard.values()):
                self._check(source)

    def _matching(self, pattern: str) -> list[str]:
        """Return the topics that a pattern stands for, those of the lifter itself aside."""
        names = (name for name, _ in self._node.get_topic_names_and_types())
        return [n for n in names if match(pattern, n) is not None and not n.startswith(self._own)]

    def _meet(self, topic: str, idle: bool) -> None:
        """Listen to a topic if somebody publishes there, and no longer if nobody does."""
        types = self._types(topic)
        usable = [kind for kind in types if kind in self._usable]
        if topic in self._heard:
            if not types:
                self._leave(topic)
        elif len(usable) == 1:
            try:
                self._listen(topic, self._type or resolve_input_type("input_type", usable[0]))
            except ValueError as problem:
                self._complain(f"cannot listen to {topic}: {problem}")
        elif types and idle:  # what does not hinder others is no trouble
            mend = (
                "start the lifter with one as input_type"
                if usable
                else "change the publisher, or start the lifter with another input_type, which may "
                "be the path of a field mapping"
            )
            expected = "one type" if usable else " or ".join(self._usable)
            self._complain(f"{topic} carries {', '.join(types)}; expected {expected}: {mend}")

    def _check(self, source: KeypointTopic) -> None:
        """Say so if messages of another type are published where the lifter listens.

        DDS keeps such publishers apart and reports nothing.
        """
        types, expected = self._types(source.topic), type_name(source.reader.input_type)
        if not self._type and types and expected not in types:
            self._leave(source.topic)  # another detector: its type is read at the next look
        elif others := [kind for kind in types if kind != expected]:
            self._complain(
                f"{source.topic} carries {', '.join(others)}; expected {expected}: change the "
                "publisher, or start the lifter with another input_type"
            )

    def _listen(self, topic: str, input_type: InputType) -> None:
        """Subscribe to a topic; raise ValueError if its type cannot be imported."""
        names = [match(pattern, topic) for pattern in self.topics]
        several = len(self.topics) > 1
        name = next(filter(None, names), topic.strip("/") if several else "")
        kind = type_name(input_type)
        source = KeypointTopic(
            topic, MessageReader(input_type, decoder(kind)), Tracker(name), DroppedMessages()
        )
        subscription = self._node.create_subscription(
            message_class(kind),
            topic,
            partial(self._take, source),
            SENSOR_INPUT,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=partial(self._mend_qos, topic)
            ),
            # Topics that come and go would leave parameters behind.
            qos_overriding_options=QoSOverridingOptions.with_default_policies()
            if topic in self.topics
            else None,
        )
        self._heard[topic] = source, subscription
        self._log.info(f"listening to {topic} ({kind})")

    def _take(self, source: KeypointTopic, raw: bytes, info: Mapping[str, Any]) -> None:
        """Pass a message on, serialised as it came."""
        source.dropped.received(info["publication_sequence_number"])
        self._on_message(source, raw)

    def _leave(self, topic: str) -> None:
        """Listen to a topic no longer."""
        _, subscription = self._heard.pop(topic)
        self._node.destroy_subscription(subscription)
        self._log.info(f"no longer listening to {topic}")

    @property
    def _usable(self) -> tuple[str, ...]:
        """Return the types that would be heard."""
        return (type_name(self._type),) if self._type else INPUT_TYPES

    def _types(self, topic: str) -> list[str]:
        """Return the types that are published on a topic."""
        found = self._node.get_publishers_info_by_topic(topic)
        return sorted({info.topic_type.replace("/msg/", "/") for info in found})

    def _resolve(self, name: str) -> str:
        """Return the whole name of a topic; raise ValueError if it is none.

        rclpy knows no `*`, so that what has one is not remapped.
        """
        if WILDCARD not in name:
            try:
                return str(self._node.resolve_topic_name(name))
            except RuntimeError:  # of rcl, with a place in its source
                raise ValueError(f"topics names {name!r}, which is no name of a topic") from None
        return name if name.startswith("/") else f"{self._node.get_namespace().rstrip('/')}/{name}"

    def _mend_qos(self, topic: str, event: Any) -> None:
        """Say how to hear a publisher whose quality of service does not fit."""
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        parameter = f"qos_overrides.{topic}.subscription.{policy.split('_')[0].lower()}"
        reason = (
            f"a publisher on {topic} offers a {policy} that does not fit: nothing comes from "
            f"it; start the lifter without -p {parameter}, or change the publisher"
        )
        self._on_trouble(reason)
        self._log.error(reason)

    def _complain(self, reason: str) -> None:
        """Tell of a publisher that cannot be heard."""
        self._on_trouble(reason)
        self._log.error(reason, throttle_duration_sec=LOG_PERIOD)
