# SPDX-License-Identifier: Apache-2.0
"""Count of dropped messages, from the sequence numbers of a topic's publisher."""

from __future__ import annotations

from collections.abc import Iterable


class DroppedMessages:
    """Counts the messages of one topic that were sent and not received.

    A full queue or the network drops messages, and DDS does not report it. Every publisher numbers
    its messages from 1, so a gap in the numbers counts the dropped ones. The numbers do not name
    their publisher, so gaps count only while the topic has a single publisher.
    """

    def __init__(self) -> None:
        """Start without messages and publishers."""
        self._last_number: int | None = None
        self._dropped = 0
        self._publishers: frozenset[bytes] = frozenset()

    def received(self, number: int | None) -> None:
        """Record the sequence number of a received message; None: the middleware has none."""
        if number is not None and self._last_number is not None:
            self._dropped += max(number - self._last_number - 1, 0)
        self._last_number = number

    def take_count(self, publishers: Iterable[bytes]) -> int:
        """Return the number of messages dropped since the last call; 0 with several publishers.

        Args:
            publishers: identifiers of the topic's present publishers.
        """
        previous, self._publishers = self._publishers, frozenset(publishers)
        dropped, self._dropped = self._dropped, 0
        if not self._publishers:  # the next publisher numbers its messages from 1 again
            self._last_number = None
        return dropped if len(previous | self._publishers) == 1 else 0
