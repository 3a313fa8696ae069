# SPDX-License-Identifier: Apache-2.0
"""Whether gravity, the camera's height and single keypoints can be right, by some seconds.

A wrong direction of gravity, such as one with another sign or in the axes of the camera's body,
spoils shapes and lays people on their side in a fixed frame. One message does not show it: people
bend and lie. Over seconds it is seen where people are upright in the image, and nearly all of them
are upside down against gravity, or horizontal before a camera that would look at the ceiling.
Somebody who lies, or whom a camera at the ceiling sees, is neither.

A wrong height of the camera makes giants or dwarfs of those who stand on the floor.

A keypoint that contradicts the others again and again is not where its name says.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.sanity import Finding, wrong_keypoints, wrong_keypoints_text

Floats = NDArray[Any]

WINDOW = 15.0
"""Seconds that are looked at."""

_INTERVAL = 0.2  # s between two messages that are kept
_LEAST_SECONDS = 3.0  # of people
_LEAST = 20  # people of all messages
_UPRIGHT = 0.7  # cosine between a person's up axis and that of the image, of somebody upright
_MOST = 0.6  # fraction of the people who must be upright in the image
_NEARLY_ALL = 0.95  # fraction of these who must disagree
_UPSIDE_DOWN = -0.5  # cosine between up axis and the direction against gravity: more than 120 deg
_OFF = 0.5  # the same: more than 60 degrees
_LOOKS_UP = 0.9  # cosine between the camera's view and the direction against gravity
_IMPOSSIBLE = 0.9  # fraction of objects of a size that does not exist


class _Window:
    """Rows of numbers of the objects of the last seconds."""

    def __init__(self) -> None:
        """Start without objects."""
        self._kept: deque[tuple[float, Floats]] = deque()

    def is_due(self, seconds: float) -> bool:
        """Return whether a message at this time is to be kept; most are left out."""
        return not self._kept or seconds - self._kept[-1][0] >= _INTERVAL

    def keep(self, seconds: float, rows: Floats) -> None:
        """Keep the rows (n, k) of the objects of a message."""
        kept = self._kept
        if len(rows):
            kept.append((seconds, rows))
        while kept and kept[0][0] < seconds - WINDOW:
            kept.popleft()

    @property
    def all(self) -> Floats | None:
        """All rows (m, k), however few; None: there are none."""
        return np.concatenate([rows for _, rows in self._kept]) if self._kept else None

    def rows(self) -> Floats | None:
        """Return all rows (m, k); None: they are too few, or of too short a time."""
        kept = self._kept
        if len(kept) < 2 or kept[-1][0] - kept[0][0] < _LEAST_SECONDS:
            return None
        rows: Floats = np.concatenate([rows for _, rows in kept])
        return rows if len(rows) >= _LEAST else None

    def forget(self) -> None:
        """Forget all objects."""
        self._kept.clear()


class GravityCheck:
    """Compares the direction against gravity with the people of the last seconds."""

    def __init__(self) -> None:
        """Start without people."""
        self._window = _Window()  # columns: cosines, see `add`
        self.forget = self._window.forget

    def add(self, seconds: float, rotations: Floats, up: Floats) -> None:
        """Keep the people of a message; most messages are left out.

        Args:
            seconds: of a clock that is never set back.
            rotations: (n, 3, 3) from object axes (z up) to camera axes; NaN where not lifted.
            up: (3,) unit vector against gravity in the camera's axes.
        """
        if not self._window.is_due(seconds):
            return
        axes = rotations[:, :, 2]
        axes = axes[np.isfinite(axes).all(1)].astype(np.float64)
        # Cosines of the up axis and that of the image, of it and gravity, of view and gravity.
        rows = np.column_stack((-axes[:, 1], axes @ up, np.full(len(axes), up[2])))
        self._window.keep(seconds, rows)

    def find(self, source: str, mend: str) -> list[Finding]:
        """Return whether people and gravity disagree.

        Args:
            source: of the direction, for the message.
            mend: what to check.
        """
        rows = self._window.rows()
        if rows is None:
            return []
        image, gravity, view = rows.T
        upright = image > _UPRIGHT
        if upright.sum() < _LEAST or upright.mean() < _MOST:
            return []
        disagrees = (gravity < _UPSIDE_DOWN) | (gravity < _OFF) & (view > _LOOKS_UP)
        if disagrees[upright].mean() < _NEARLY_ALL:
            return []
        angle = np.degrees(np.arccos(np.clip(np.median(gravity[upright]), -1, 1)))
        return [
            Finding(
                "gravity",
                f"people stand upright in the image, and {angle:.0f} degrees off the direction "
                f"against gravity that {source} gives: {mend}",
            )
        ]


class FloorCheck:
    """Compares the sizes that the floor gives with those that exist."""

    def __init__(self) -> None:
        """Start without objects."""
        self._window = _Window()  # columns: factor by the floor, least and largest one believed
        self.is_due, self.forget = self._window.is_due, self._window.forget

    def add(self, seconds: float, factors: Floats, believed: tuple[float, float]) -> None:
        """Keep the objects of a message; ask `is_due` first.

        Args:
            seconds: of a clock that is never set back.
            factors: (n,) of `floor_factor`; NaN where not lifted.
            believed: least and largest factor.
        """
        factors = factors[~np.isnan(factors)]
        self._window.keep(seconds, np.column_stack((factors, np.full((len(factors), 2), believed))))

    def find(self, height: float, trunk: float | None) -> list[Finding]:
        """Return whether nearly all objects would be of a size that does not exist.

        Args:
            height: of the camera above the floor, in metres.
            trunk: of people at factor 1, in metres; None: of other objects.
        """
        rows = self._window.rows()
        if rows is None:
            return []
        factors, low, high = rows.T
        if ((factors < low) | (factors > high)).mean() < _IMPOSSIBLE:
            return []
        middle = float(np.median(factors))
        if np.isinf(middle):
            size = "objects are higher than the camera"
        elif trunk:
            size = (
                f"people on that floor would have a trunk of {trunk * middle:.2f} m "
                f"({trunk * low[-1]:.2g} to {trunk * high[-1]:.2g} m exist)"
            )
        else:
            size = (
                f"objects on that floor would be {middle:.2g} times as large as reference_length "
                f"says ({low[-1]:.2g} to {high[-1]:.2g} are believed)"
            )
        return [
            Finding(
                "floor",
                f"camera_height is {height:g} and is not used: {size}; check it, the direction of "
                "gravity, the intrinsics, and that they stand on that floor",
            )
        ]


class WrongKeypointCheck:
    """Counts how often the keypoints of the last seconds contradict the others of their object."""

    def __init__(self) -> None:
        """Start without objects."""
        self._window = _Window()  # columns: the keypoints
        self.forget = self._window.forget

    def add(self, seconds: float, wrong: NDArray[np.bool_], residual: Floats) -> None:
        """Keep the objects of a message; most messages are left out.

        Args:
            seconds: of a clock that is never set back.
            wrong: (n, p) as in `Lifted`.
            residual: (n,) as in `Lifted`; NaN where not lifted.
        """
        if self._window.is_due(seconds):
            self._window.keep(seconds, wrong[~np.isnan(residual)])

    def find(self, keypoints: Sequence[str]) -> list[Finding]:
        """Return whether one is wrong in many objects.

        Args:
            keypoints: their names.
        """
        rows = self._window.rows()
        return [] if rows is None else wrong_keypoints(rows, keypoints)

    def text(self, keypoints: Sequence[str]) -> str:
        """Return which ones are wrong and how often, for diagnostics.

        Args:
            keypoints: their names.
        """
        rows = self._window.all
        return (rows is not None and wrong_keypoints_text(rows, keypoints)) or "none"
