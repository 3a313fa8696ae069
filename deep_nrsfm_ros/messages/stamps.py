# SPDX-License-Identifier: Apache-2.0
"""One clock for the messages of a topic: stamps that are 0 or of another clock are replaced.

A detector that starts before /clock stamps its first messages with 0 or with the wall clock. Such a
stamp is replaced by the time of receipt, moved to the clock of the topic's other stamps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deep_nrsfm_ros.lifting.sanity import Finding

MAX_LATE = 1.0
"""Seconds by which a stamp may be before an earlier message's; more: the stamps begin anew."""

_SECOND = 1_000_000_000  # ns
_ZERO_FITS = _SECOND // 50  # a stamp of 0 this near to the clock is the start of the clock
_OTHER_CLOCK = 1_000_000 * _SECOND  # two clocks that differ by more are not the same, 11 days
_SHORTEST, _LONGEST = 100_000, 3600 * _SECOND  # ns between messages: 10 kHz to one an hour
_ADOPTED = 10  # messages of another clock in sequence after which it is the topic's clock
_INTERVALS = 15  # of which the median is the period
_MAX_PERIOD = 10.0  # s


class Moment(NamedTuple):
    """The time of a message on the clock of its topic.

    Attributes:
        seconds: time, on the clock of the topic.
        period: typical interval between messages in seconds, a running median; 0: unknown.
        restarted: whether the stamps begin anew with this message, as in a looped bag.
    """

    seconds: float
    period: float = 0.0
    restarted: bool = False


class RateLimit:
    """Chooses which messages of a topic are sent, so that their mean rate has a limit."""

    def __init__(self, rate: float) -> None:
        """Start with no message chosen.

        Args:
            rate: limit in Hz, 10 typical; 0: all messages are chosen.
        """
        self._interval = 1 / rate if rate else 0.0
        self._next = -math.inf

    def is_due(self, moment: Moment) -> bool:
        """Return whether the message of a moment is chosen.

        A message up to half an interval early is in time: three intervals of a stream of 30 Hz may
        be a little shorter than 0.1 s. After a gap nothing is made up for, and where time jumps
        back the choice begins anew.
        """
        seconds, step = moment.seconds, self._interval
        if self._next - 2 * step < seconds < self._next - moment.period / 2:
            return False
        is_regular = self._next - step <= seconds <= self._next + step
        self._next = (self._next if is_regular else seconds) + step
        return True


class TopicClock:
    """Gives each message of a topic its time, as it arrives.

    Attributes:
        warning: a sentence about stamps that were replaced; "" as long as there are none.
    """

    def __init__(self) -> None:
        """Start without messages."""
        self.warning = ""
        self._offset = 0  # ns, from the time of receipt to the clock of the topic
        self._shift = 0  # ns, added to the stamps, so that no clock's end is a jump
        self._has_stamps = False
        self._other = 0  # messages of another clock in sequence
        self._last: int | None = None  # ns
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)

    def __call__(self, stamp: int, received: int) -> Moment:
        """Return the time of the next message.

        Args:
            stamp: of its header in ns; 0: none.
            received: when it was received, ns of any clock that is never set back.
        """
        now = self._on_topic_clock(stamp, received)
        interval = 0 if self._last is None else now - self._last
        if interval > 0:
            self._intervals.append(interval)
        period = self._period()
        restarted = interval < -int(_SECOND * MAX_LATE) and interval < -3 * _SECOND * period
        # A late message does not set the clock back.
        if self._last is None or restarted or interval > 0:
            self._last = now
        return Moment(1e-9 * now, period, restarted)

    def _on_topic_clock(self, stamp: int, received: int) -> int:
        """Return the stamp in ns, or what replaces it."""
        offset = stamp + self._shift - received
        if stamp and not self._has_stamps:
            if self._last is not None:  # messages without a stamp came first
                self._shift, offset = self._offset - (stamp - received), self._offset
            self._has_stamps, self._offset = True, offset
        is_other = abs(offset - self._offset) > _OTHER_CLOCK
        if stamp and is_other:
            self._other += 1
            if self._other >= _ADOPTED:
                self._shift = self._offset - (stamp - received)
                is_other, offset = False, self._offset
        if stamp and not is_other:
            self._offset, self._other = offset, 0
            return stamp + self._shift
        if stamp or self._has_stamps:
            self.warning = self.warning or (
                f"a stamp is {'of another clock' if stamp else '0'}: identities and smoothing take "
                "the time of receipt instead; does the publisher start before /clock?"
            )
        return received + self._offset

    def _period(self) -> float:
        """Return the median interval in seconds, 0 if there is none."""
        if not self._intervals:
            return 0.0
        median = sorted(self._intervals)[len(self._intervals) // 2]
        return min(1e-9 * median, _MAX_PERIOD)


def one_clock(
    stamps: Sequence[int] | NDArray[np.int64], received: ArrayLike
) -> tuple[NDArray[np.int64], list[str]]:
    """Return the stamps of recorded messages on one clock, and warnings about those changed.

    Stamps that are 0, or far from the clock of most stamps, are replaced by the time of receipt,
    moved to that clock. Where stamps go back by more than a second, as in a bag that was played
    in a loop, the later ones are moved so that they follow; the order of the messages stays.

    Args:
        stamps: (n,) of the headers in ns, in the order of receipt; 0: none.
        received: (n,) when the messages were received, ns of any clock.
    """
    result, arrived = np.array(stamps, np.int64), np.asarray(received, np.int64)
    has_stamp, warnings = result != 0, []
    if not has_stamp.any():
        return arrived.copy(), []
    offset = result - arrived
    clock = int(np.median(offset[has_stamp]))
    # The median of an even number may be between two clocks.
    clock = int(offset[has_stamp][np.abs(offset[has_stamp] - clock).argmin()])
    has_stamp |= np.abs(offset - clock) <= _ZERO_FITS
    other = has_stamp & (np.abs(offset - clock) > _OTHER_CLOCK)
    valid = np.flatnonzero(has_stamp & ~other)
    replaced = np.flatnonzero(~has_stamp | other)
    if len(replaced):
        after = np.minimum(np.searchsorted(valid, replaced), len(valid) - 1)
        result[replaced] = arrived[replaced] + offset[valid[after]]
        warnings.append(
            f"{len(replaced)} of {len(result)} stamps are "
            f"{'of another clock' if other.all() else '0 or of another clock'}: replaced by the "
            "time of receipt on the clock of the others"
        )
    result, loops = _unrolled(result, arrived)
    if loops:
        warnings.append(
            f"the stamps go back {loops} times, as of a bag played in a loop: the later ones "
            "are moved to follow"
        )
    return result, warnings


def _unrolled(
    stamps: NDArray[np.int64], arrived: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """Return stamps that do not go back, by the times of receipt, and how often they did."""
    latest = np.maximum.accumulate(stamps)
    if not (stamps < latest - int(_SECOND * MAX_LATE)).any():
        return stamps, 0
    result, shift, last, loops = stamps.copy(), 0, int(stamps[0]), 0
    for i in range(1, len(stamps)):
        stamp = int(stamps[i]) + shift
        if stamp < last - int(_SECOND * MAX_LATE):
            follows = last + max(int(arrived[i] - arrived[i - 1]), 1)
            shift, stamp, loops = shift + follows - stamp, follows, loops + 1
        result[i], last = stamp, max(last, stamp)
    return result, loops


def check_stamps(stamps: NDArray[np.int64], topic: str) -> Iterator[Finding]:
    """Yield what is wrong with the stamps of the last messages of a topic.

    Args:
        stamps: (n,) of the headers in ns, in the order of receipt.
        topic: their name, for the text.
    """
    if len(stamps) < 2:
        return
    steps = np.diff(stamps)
    if not steps.any():
        yield Finding(
            "stamps",
            f"the last {len(stamps)} messages on {topic} all have the stamp {_seconds(stamps[0])}: "
            "let the detector copy the stamp of the image into header.stamp",
        )
        return
    if (np.abs(steps) > _OTHER_CLOCK).sum() > 1:
        yield Finding(
            "stamps",
            f"the stamps on {topic} are of two clocks, {_seconds(stamps.min())} and "
            f"{_seconds(stamps.max())}: identities and smoothing take the time of receipt instead; "
            "do two nodes publish on it, one of them with use_sim_time? Set it alike in all nodes",
        )
        return
    rising = steps[steps > 0]
    middle = float(np.median(rising)) if len(rising) else 0.0
    if 0 < middle < _SHORTEST or middle > _LONGEST:
        yield Finding(
            "stamps",
            f"the stamps on {topic} are {middle / _SECOND:.2g} s apart: header.stamp.sec must be "
            "whole seconds, and nanosec the rest",
        )
        return
    back = int((steps <= 0).sum())
    is_loop = back == 1 and steps.min() < -int(_SECOND * MAX_LATE)
    if back and not is_loop:
        yield Finding(
            "stamps",
            f"{back} of {len(steps)} stamps on {topic} are not above the one before: do several "
            "detectors publish on it? Give each a topic of its own (parameter topics)",
        )


def _seconds(stamp: np.int64) -> str:
    """Return a stamp in ns as seconds for texts."""
    return f"{stamp / _SECOND:.3f} s"
