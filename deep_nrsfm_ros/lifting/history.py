# SPDX-License-Identifier: Apache-2.0
"""What a lifter remembers of each identity from frame to frame.

Four things are remembered: the shape and the rotation that the network has found, smoothed
(`lifting.network_smoothing`), the lengths of this object's bones (`lifting.own_bones`), and its
depths (`lifting.steady_depth`), in rows of their own. All of it stands in one row of numbers for
each identity, which the backends read and update. A row has a fixed length, each number in it
decays with time, and rows of identities that are gone are used again, so that memory is bounded.

Source: ours, not in the paper.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]

MAX_GAP = 0.5
"""Seconds without the object after which smoothing starts anew."""
MAX_BACK = 1.0
"""Seconds by which a frame may be earlier than the last one; more: smoothing starts anew."""
_MAX_AGE = 60.0  # seconds for which an identity is remembered where others need its row
_MAX_IDENTITIES = 256  # identities that are remembered, beside those of the present message
_FIRST_ROWS = 8


class StateLayout(NamedTuple):
    """The numbers that are remembered of one object, in one row.

    Attributes:
        p: keypoints.
        b: bones.
    """

    p: int
    b: int

    @property
    def size(self) -> int:
        """Numbers of a row."""
        return 13 + 3 * self.p + 2 * self.b

    def split(self, rows: Floats) -> State:
        """Return the parts of rows (n, size), as views of their memory."""
        shape_end = 13 + 3 * self.p
        n = len(rows)
        return State(
            rows[:, 0],
            rows[:, 1:3],
            rows[:, 3],
            rows[:, 4:13].reshape(n, 3, 3),
            rows[:, 13:shape_end].reshape(n, self.p, 3),
            rows[:, shape_end : shape_end + self.b],
            rows[:, shape_end + self.b :],
        )


class State(NamedTuple):
    """What is remembered of n objects.

    Attributes:
        time: (n,) of the last frame, seconds; NaN: there was none.
        misfit: (n, 2) recent deviation of the bones from the learned lengths, and from the model's.
        agreement: (n,) seconds for which the network has agreed with the rotation that is
            remembered; see `network_smoothing.weigh_turns`.
        rotation: (n, 3, 3) smoothed, from object to camera axes.
        shape: (n, p, 3) smoothed, in object axes, in units of the network.
        growth: (n, b) logarithm of each bone's length relative to the model's.
        evidence: (n, b) seconds of sight that stand behind it.
    """

    time: Floats
    misfit: Floats
    agreement: Floats
    rotation: Floats
    shape: Floats
    growth: Floats
    evidence: Floats


class Context(NamedTuple):
    """What is known of the n objects of a frame beside their keypoints.

    Attributes:
        states: (capacity, `StateLayout.size`) float64, updated by a lift.
        rows: (n,) int32, the row of each object; -1: nothing is remembered of it.
        time: of the frame, seconds.
        up: (3,) unit vector against gravity in the camera's axes; None: unknown.
        to_view: (n, 3, 3) from the camera to the view that is lifted; None: they are the same.
    """

    states: NDArray[np.float64]
    rows: NDArray[np.int32]
    time: float
    up: Floats | None = None
    to_view: NDArray[np.float64] | None = None


class Memory:
    """Finds the row of each identity of one topic.

    Attributes:
        depth_cutoff: in Hz, of depths; 0: they are not smoothed. See `steady_depth`.
        depth_states: (capacity, 1 + 7 p) what is remembered of depths.
    """

    def __init__(self, layout: StateLayout, depth_cutoff: float = 0.0) -> None:
        """Start without identities."""
        self.depth_cutoff = depth_cutoff
        self._states = np.full((_FIRST_ROWS, layout.size), np.nan)
        self.depth_states = np.full((_FIRST_ROWS, 1 + 7 * layout.p), np.nan)
        self._rows: dict[str, int] = {}
        self._free = list(range(_FIRST_ROWS))
        self._last: tuple[tuple[str, ...], NDArray[np.int32]] = ((), np.zeros(0, np.int32))

    def __len__(self) -> int:
        """Return the number of identities that are remembered."""
        return len(self._rows)

    def __call__(
        self, identities: tuple[str, ...], time: float, up: Floats | None = None
    ) -> Context:
        """Return the context of the objects of a message.

        Args:
            identities: n; "": unknown, nothing is remembered.
            time: of the message in seconds.
            up: as in `Context`.
        """
        if identities == self._last[0]:  # as in most messages
            return Context(self._states, self._last[1], time, up)
        get = self._rows.get
        rows = [get(identity, -1) for identity in identities]
        if -1 in rows:
            for i, identity in enumerate(identities):
                if rows[i] < 0 and identity:
                    rows[i] = get(identity, -1)  # it may be there twice
                    if rows[i] < 0:
                        rows[i] = self._add(identity, identities, time)
        self._last = identities, np.array(rows, np.int32)
        return Context(self._states, self._last[1], time, up)

    def row(self, identity: str) -> Floats | None:
        """Return the numbers that are remembered of an identity; None: it is not known."""
        row = self._rows.get(identity)
        return None if row is None else self._states[row]

    def latest(self, most: int) -> list[str]:
        """Return the identities that were lifted last, at most `most`, the last one first."""
        times = {name: self._states[row, 0] for name, row in self._rows.items()}
        lifted = [name for name, time in times.items() if time == time]
        return sorted(lifted, key=lambda name: -times[name])[:most]

    def _add(self, identity: str, present: tuple[str, ...], time: float) -> int:
        """Return a row for a new identity."""
        if not self._free:
            self._make_room(present, time)
        row = self._rows[identity] = self._free.pop()
        self._states[row] = self.depth_states[row] = np.nan
        return row

    def _make_room(self, present: tuple[str, ...], time: float) -> None:
        """Free the rows of identities that are gone, or add rows."""
        needed = set(present)
        times = {name: self._states[row, 0] for name, row in self._rows.items()}
        gone = [n for n, last in times.items() if n not in needed and not last > time - _MAX_AGE]
        if not gone and len(self._rows) >= _MAX_IDENTITIES:
            others = [name for name in times if name not in needed]
            gone = sorted(others, key=times.__getitem__)[:1]
        for name in gone:
            self._free.append(self._rows.pop(name))
        if not self._free:
            capacity = len(self._states)
            self._states, self.depth_states = (
                np.concatenate((each, np.full_like(each, np.nan)))
                for each in (self._states, self.depth_states)
            )
            self._free = list(range(capacity, 2 * capacity))
