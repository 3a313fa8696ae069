# SPDX-License-Identifier: Apache-2.0
"""Tells 3D points in a table from the relative depth that MediaPipe writes beside pixels."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import KeypointFileError

_OBJECTS = 500  # that are looked at
_FLAT = 1e-6  # of a coordinate: a z that varies by less is none
_NEAR = 0.1  # of the range of z, within which it is about 0
_INSIDE = 0.02  # of a range, by which 0 lies inside
_VISIBILITY = {"visibility", "presence", "v", "vis"}
_NEARLY_ALL = 0.9  # of the objects
_SHOWN = 2  # values that a message names
_HAND = 21  # landmarks of MediaPipe's hand, all before the wrist, whose z is 0


def is_visibility(names: Collection[str]) -> bool:
    """Return whether names of columns have one that MediaPipe gives a confidence."""
    return not _VISIBILITY.isdisjoint(names)


class DepthCheck:
    """Looks at x, y and z of a table's first objects.

    MediaPipe's z is relative: 0 at the hips or the wrist, negative before them, while x and y are
    places in the image.
    """

    def __init__(
        self, names: Sequence[str], *, has_confidence: bool, has_visibility: bool = False
    ) -> None:
        """Start without objects.

        Args:
            names: of the q keypoints that have a z.
            has_confidence: they have a confidence of any name.
            has_visibility: it has the name that MediaPipe gives it, so that some of its landmarks
                may have been left out, such as the hips.
        """
        self._names = names
        self._is_lenient = has_confidence or len(names) == _HAND
        self._may_be_before = has_visibility
        self._objects: list[NDArray[np.float64]] = []

    def add(self, xyz: NDArray[np.float64]) -> None:
        """Look at x, y and z (q, 3) of an object.

        Raises:
            KeypointFileError: as of `finish`.
        """
        if len(self._objects) < _OBJECTS:
            if np.isfinite(xyz).all(1).any():
                self._objects.append(xyz)
            if len(self._objects) == _OBJECTS:
                self.finish()

    def finish(self) -> None:
        """Raise KeypointFileError if the objects are 3D."""
        if not self._objects:
            return
        xyz = np.stack(self._objects)
        xyz[~np.isfinite(xyz).all(-1) | ~xyz.any(-1)] = np.nan  # zeros stand for missing, too
        xyz = xyz[np.isfinite(xyz).all(-1).any(-1)]
        if not len(xyz):
            return
        z = xyz[..., 2]
        if np.nanmax(z) - np.nanmin(z) <= _FLAT * max(1.0, float(np.nanmax(np.abs(z)))):
            return
        low, high = np.nanmin(xyz, 1), np.nanmax(xyz, 1)
        span = high - low
        is_inside = (low <= -_INSIDE * span) & (high >= _INSIDE * span) & (span > 0)
        is_near = (low <= _NEAR * span) & (high >= -_NEAR * span)
        if self._may_be_before:
            is_near |= high < 0
        is_relative = (is_near if self._is_lenient else is_inside)[:, 2].mean() >= _NEARLY_ALL
        is_centred = is_inside[:, :2].all(1).mean() >= _NEARLY_ALL
        if is_centred or not is_relative:
            name, values = self._names[0], z[:, 0]
            shown = [f"{value:g}" for value in values[np.isfinite(values)][:_SHOWN]]
            example = f": z of {name} is {', '.join([*shown, '...'])}" if shown else ""
            raise KeypointFileError(three_d(f"z changes{example}"))


def three_d(sign: str) -> str:
    """Return the sentence that a table is 3D, by a sign of it."""
    return f"it is 3D ({sign}): lift needs the 2D keypoints that they come from"
