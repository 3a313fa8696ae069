# SPDX-License-Identifier: Apache-2.0
"""Subscriptions to the keypoint topics: their types, and publishers that cannot be received."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.qos import (
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from deep_nrsfm_ros.lifting.tracking import Tracker
from deep_nrsfm_ros.messages.decoding import INPUT_TYPES, InputType, resolve_input_type, type_name
from deep_nrsfm_ros.messages.dropped_messages import DroppedMessages
from deep_nrsfm_ros.messages.mapping_file import shipped_mappings
from deep_nrsfm_ros.messages.options import AUTO, InputOptions
from deep_nrsfm_ros.messages.serialised import MessageReader
from deep_nrsfm_ros.messages.stamps import TopicClock
from deep_nrsfm_ros.messages.topics import WILDCARD, match
from deep_nrsfm_ros.node.message_types import decoder, message_class

DEFAULT_TOPIC = "keypoints"
SENSOR_INPUT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort, depth 1: messages that arrive during a lift are dropped."""

_WAITING_PERIOD = 0.1  # seconds between two looks for the first publisher
_POLICIES: dict[str, Callable[[str], Any]] = {
    "history": HistoryPolicy.get_from_short_key,
    "reliability": ReliabilityPolicy.get_from_short_key,
}

LOG_PERIOD = 2.0
"""Seconds between two log entries of the same kind."""


@dataclass(frozen=True)
class KeypointTopic:
    """State of a subscribed topic.

    Attributes:
        topic: its resolved name.
        reader: reads its messages.
        tracker: gives identities to its objects.
        dropped: counts its dropped messages.
        clock: gives its messages their times.
    """

    topic: str
    reader: MessageReader
    tracker: Tracker
    dropped: DroppedMessages
    clock: TopicClock = field(default_factory=TopicClock)


class KeypointSubscriptions:
    """Subscribes to the topics of `InputOptions`, to patterns as their topics appear.

    Attributes:
        topics: resolved names and patterns.
    """

    def __init__(
        self,
        node: Node,
        inputs: InputOptions,
        on_message: Callable[[KeypointTopic, bytes], None],
        on_problem: Callable[[str], None],
        on_dropped: Callable[[int], None],
    ) -> None:
        """Subscribe to the topics whose type is known; call `update` periodically for the others.

        Args:
            node: owns the subscriptions.
            inputs: topics and type of the messages.
            on_message: called with each serialised message.
            on_problem: called with the reason, and the remedy, why a publisher is not received.
            on_dropped: called with the number of messages dropped since the last `update`.

        Raises:
            ValueError: the type of the messages is unknown, or its package is not installed.
        """
        self._node, self._on_message, self._on_problem = node, on_message, on_problem
        self._on_dropped = on_dropped
        self._log = node.get_logger()
        self._type: InputType | None = None
        if inputs.input_type != AUTO:
            self._type = resolve_input_type("input_type", inputs.input_type)
            message_class(type_name(self._type))
        self._own = f"{node.get_fully_qualified_name()}/"
        names = inputs.topics or (DEFAULT_TOPIC,)
        self.topics = tuple(dict.fromkeys(map(self._resolve, names)))
        self._names = {self._resolve(name): name for name in names if WILDCARD not in name}
        self._subscribed: dict[str, tuple[KeypointTopic, Subscription]] = {}
        for topic in self.topics:
            if self._type and WILDCARD not in topic:
                self._subscribe(topic, self._type)
        self.update(idle=False)
        for topic in self.topics:
            if not any(match(topic, name) is not None for name in self._subscribed):
                self._log.info(f"waiting for a publisher on {topic}")
        # A publisher that appears later is found within a second by the reports.
        self._waiting = node.create_timer(
            _WAITING_PERIOD, self._wait, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    @property
    def description(self) -> str:
        """The subscribed topics with their types, as text."""
        subscribed = (topic for topic, _ in self._subscribed.values())
        return (
            ", ".join(f"{t.topic} ({type_name(t.reader.input_type)})" for t in subscribed)
            or "none yet"
        )

    def update(self, *, idle: bool) -> None:
        """Count dropped messages and follow topics that appear and vanish; call it once a second.

        Args:
            idle: no message has been received since the last call: look for publishers that cannot
                be received.
        """
        for topic, _ in self._subscribed.values():
            publishers = self._node.get_publishers_info_by_topic(topic.topic)
            gids = (bytes(publisher.endpoint_gid) for publisher in publishers)
            self._on_dropped(topic.dropped.take_count(gids))
        for pattern in self.topics:
            if WILDCARD in pattern:
                for name in self._matching(pattern):
                    self._update_topic(name, idle)
            elif pattern not in self._subscribed:
                self._update_topic(pattern, idle)
        if idle:
            for topic, _ in list(self._subscribed.values()):
                self._check_types(topic)

    def close(self) -> None:
        """Unsubscribe from all topics."""
        self._node.destroy_timer(self._waiting)
        for _, subscription in self._subscribed.values():
            self._node.destroy_subscription(subscription)
        self._subscribed.clear()

    def _wait(self) -> None:
        """Subscribe to the topics whose type the first publisher shows, soon after it appears."""
        if self._subscribed:
            self._waiting.cancel()
        else:
            self.update(idle=False)

    def _quality(self, topic: str) -> QoSProfile:
        """Return the quality of service of a topic.

        rclpy takes overrides under the name that the topic has after remapping. These are those
        under its own name, /keypoints, so that a remapping does not silently drop them.
        """
        profile = QoSProfile(depth=SENSOR_INPUT.depth, reliability=SENSOR_INPUT.reliability)
        name = self._names.get(topic, "")
        if not name:
            return profile
        own = expand_topic_name(name, self._node.get_name(), self._node.get_namespace())
        if own == topic:
            return profile
        prefix = f"qos_overrides.{own}.subscription"
        for policy, convert in _POLICIES.items():
            default = getattr(profile, policy).short_key
            word = self._declared(f"{prefix}.{policy}", default)
            try:
                setattr(profile, policy, convert(word))
            except (KeyError, TypeError, AttributeError):
                raise ValueError(f"{prefix}.{policy} is {word!r}; it is no such policy") from None
        profile.depth = self._declared(f"{prefix}.depth", profile.depth)
        return profile

    def _declared(self, name: str, default: Any) -> Any:
        """Return the value of a parameter that is declared at the first call."""
        if self._node.has_parameter(name):
            return self._node.get_parameter(name).value
        descriptor = ParameterDescriptor(read_only=True)
        return self._node.declare_parameter(name, default, descriptor).value

    def _matching(self, pattern: str) -> list[str]:
        """Return the topics that match a pattern, except those of the lifter itself."""
        names = (name for name, _ in self._node.get_topic_names_and_types())
        return [n for n in names if match(pattern, n) is not None and not n.startswith(self._own)]

    def _update_topic(self, topic: str, idle: bool) -> None:
        """Subscribe to a topic that has a publisher; unsubscribe from one that has none."""
        types = self._types(topic)
        usable = [kind for kind in types if kind in self._usable_types]
        if topic in self._subscribed:
            if not types:
                self._unsubscribe(topic)
        elif len(usable) == 1:
            try:
                self._subscribe(topic, self._type or resolve_input_type("input_type", usable[0]))
            except (ValueError, RuntimeError) as problem:
                self._report(f"cannot subscribe to {topic}: {problem}")
        elif types and idle:  # while other topics are lifted, this is no problem
            remedy = (
                "start the lifter with one as input_type"
                if usable
                else "change the publisher, or start the lifter with another input_type, which may "
                "be the path of a field mapping"
                + "".join(f", as {path}" for kind in types for path in shipped_mappings(kind)[:1])
            )
            expected = "one type" if usable else " or ".join(self._usable_types)
            self._report(f"{topic} carries {', '.join(types)}; expected {expected}: {remedy}")

    def _check_types(self, source: KeypointTopic) -> None:
        """Report publishers of another type on a subscribed topic: DDS does not report them."""
        types, expected = self._types(source.topic), type_name(source.reader.input_type)
        if not self._type and types and expected not in types:
            # Another detector publishes; the next update subscribes with its type.
            self._unsubscribe(source.topic)
        elif others := [kind for kind in types if kind != expected]:
            self._report(
                f"{source.topic} carries {', '.join(others)}; expected {expected}: change the "
                "publisher, or start the lifter with another input_type"
            )

    def _subscribe(self, topic: str, input_type: InputType) -> None:
        """Subscribe to a topic; raise ValueError if its type cannot be imported."""
        wildcards = [match(pattern, topic) for pattern in self.topics]
        several = len(self.topics) > 1
        prefix = next(filter(None, wildcards), topic.strip("/") if several else "")
        kind = type_name(input_type)
        reader = MessageReader(input_type, decoder(kind))
        source = KeypointTopic(topic, reader, Tracker(prefix), DroppedMessages())
        subscription = self._node.create_subscription(
            message_class(kind),
            topic,
            partial(self._receive, source),
            self._quality(topic),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=partial(self._report_qos, topic)
            ),
            # Topics of a pattern come and go, and their parameters would stay.
            qos_overriding_options=QoSOverridingOptions.with_default_policies()
            if topic in self.topics
            else None,
        )
        self._subscribed[topic] = source, subscription
        self._log.info(f"subscribed to {topic} ({kind})")

    def _receive(self, source: KeypointTopic, raw: bytes, info: Mapping[str, Any]) -> None:
        """Pass a serialised message on."""
        source.dropped.received(info["publication_sequence_number"])
        self._on_message(source, raw)

    def _unsubscribe(self, topic: str) -> None:
        """Unsubscribe from a topic."""
        _, subscription = self._subscribed.pop(topic)
        self._node.destroy_subscription(subscription)
        self._log.info(f"unsubscribed from {topic}: it has no usable publisher")

    @property
    def _usable_types(self) -> tuple[str, ...]:
        """The message types that can be received."""
        return (type_name(self._type),) if self._type else INPUT_TYPES

    def _types(self, topic: str) -> list[str]:
        """Return the types that are published on a topic."""
        publishers = self._node.get_publishers_info_by_topic(topic)
        return sorted({info.topic_type.replace("/msg/", "/") for info in publishers})

    def _resolve(self, name: str) -> str:
        """Return the full name of a topic or pattern; raise ValueError for an invalid name.

        rclpy does not accept `*`, so a pattern is not remapped.
        """
        if WILDCARD not in name:
            try:
                return str(self._node.resolve_topic_name(name))
            except RuntimeError:  # rcl's text is about its own source
                raise ValueError(f"topics names {name!r}, which is no name of a topic") from None
        return name if name.startswith("/") else f"{self._node.get_namespace().rstrip('/')}/{name}"

    def _report_qos(self, topic: str, event: Any) -> None:
        """Report a publisher whose quality of service does not fit, and the remedy."""
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        parameter = f"qos_overrides.{topic}.subscription.{policy.split('_')[0].lower()}"
        reason = (
            f"a publisher on {topic} offers an incompatible {policy}: its messages are not "
            f"received; start the lifter without -p {parameter}, or change the publisher"
        )
        self._on_problem(reason)
        self._log.error(reason)

    def _report(self, reason: str) -> None:
        """Report a publisher that cannot be received."""
        self._on_problem(reason)
        self._log.error(reason, throttle_duration_sec=LOG_PERIOD)
