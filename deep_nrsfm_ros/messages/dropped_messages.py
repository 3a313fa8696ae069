"""Messages that never came, told by the numbers that their publisher gives them."""

from __future__ import annotations

from collections.abc import Iterable


class DroppedMessages:
    """Counts the gaps in the numbers of the messages on a topic.

    What a full queue or the network drops, DDS drops in silence. But every publisher numbers its
    messages from 1. They do not tell which publisher they are of, so gaps count only while there
    has been one.
    """

    def __init__(self) -> None:
        """Begin with no message and no publisher."""
        self._last: int | None = None
        self._missed = 0
        self._publishers: frozenset[bytes] = frozenset()

    def received(self, number: int | None) -> None:
        """Note the number of a message that came; None where the middleware tells none."""
        if number is not None and self._last is not None:
            self._missed += max(number - self._last - 1, 0)
        self._last = number

    def take_count(self, publishers: Iterable[bytes]) -> int:
        """Return how many messages have not come since the last call, as far as can be told.

        publishers: identities of those that are there now.
        """
        before, self._publishers = self._publishers, frozenset(publishers)
        missed, self._missed = self._missed, 0
        if not self._publishers:  # the next one counts anew
            self._last = None
        return missed if len(before | self._publishers) == 1 else 0
