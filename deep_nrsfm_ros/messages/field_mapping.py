"""Field mappings: where a message of some type has its objects and their keypoints.

A mapping makes an adapter out of a few names of fields, so that a new detector needs no code. Those
of well-known detectors are here; others come from YAML, see `config/mappings/`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import Identities, MessageError, check_keypoints

PIXELS, NORMALISED = "pixels", "normalised"

Size = tuple[int, int]
"""Width and height of an image in pixels."""

_MOST = 1000  # keypoints that a message may speak of by number


@dataclass(frozen=True)
class FieldMapping:
    """Names of fields, with dots between those of nested messages.

    type: of the message, "package/Type".
    objects: the list of objects; "" if the message itself is the only one.
    identity: that of an object, from the object; "" if there is none.
    keypoints: the list of keypoints, from an object. An object without any is left out.
    x, y, score: from a keypoint; score may be "".
    keypoint_id: which one it is, from a keypoint: a number that counts from `first_id`, or one of
        `names` if there are any; "" if the place in the list tells.
    names: the keypoints as messages name them, in the order of the detector's layout.
    units: of x and y: "pixels" or, where they go from 0 to 1, "normalised".
    missing: what x or y is where the keypoint is missing, besides NaN and (0, 0); None: nothing.
    """

    type: str
    keypoints: str
    x: str = "x"
    y: str = "y"
    score: str = ""
    objects: str = ""
    identity: str = ""
    keypoint_id: str = ""
    first_id: int = 0
    names: tuple[str, ...] = ()
    units: str = PIXELS
    missing: float | None = None

    def __call__(
        self, message: Any, keypoints: int, size: Size | None = None
    ) -> tuple[NDArray[np.floating], Identities]:
        """Return values (n, q, 2 or 3: x, y, score) in pixels, NaN where missing, and n identities.

        keypoints: q of the detector's layout. size: that of the image, needed if normalised.
        Raises MessageError for numbers that do not fit, and what a message without such fields
        raises.
        """
        rows, identities = [], []
        for item in self._items(message):
            if len(points := self._keypoints(item)):
                rows.append(self._row(points, keypoints))
                identities.append(_known(self._identity(item)))
        width = 3 if self.score else 2
        values = np.array(rows, np.float64).reshape(len(rows), keypoints, width)
        if self.missing is not None:
            values[(values[..., :2] == self.missing).any(-1)] = np.nan
        if self.units == NORMALISED and not size:
            raise MessageError(
                f"keypoints of {self.type} are normalised: the size of the image is needed; set "
                "image_width and image_height"
            )
        if self.units == NORMALISED:
            with np.errstate(over="ignore"):  # what is farther than any image counts as missing
                values[..., :2] *= np.array(size)
        return values, tuple(identities)

    def count(self, message: Any) -> int:
        """Return how many keypoints the objects have, 0 if there is no object.

        Where keypoints are numbered and some may be absent, it is the least that there can be.
        """
        if self.names:
            return len(self.names)
        lists = [self._keypoints(item) for item in self._items(message)]
        if not self.keypoint_id:
            return max(map(len, lists), default=0)
        places = [self._place(point, _MOST) for points in lists for point in points]
        return max(places, default=-1) + 1

    @cached_property
    def _values(self) -> Callable[[Any], Any]:
        """Return what gives (x, y[, score]) of a keypoint."""
        return attrgetter(*filter(None, (self.x, self.y, self.score)))

    @cached_property
    def _keypoints(self) -> Callable[[Any], Sequence[Any]]:
        """Return what gives the keypoints of an object."""
        return attrgetter(self.keypoints)

    @cached_property
    def _identity(self) -> Callable[[Any], Any]:
        """Return what gives the identity of an object."""
        return attrgetter(self.identity) if self.identity else lambda _: ""

    @cached_property
    def _keypoint_id(self) -> Callable[[Any], Any]:
        """Return what gives the number or the name of a keypoint."""
        return attrgetter(self.keypoint_id)

    @cached_property
    def _places(self) -> dict[str, int]:
        """Return the layout's number of each name."""
        return {name: i for i, name in enumerate(self.names)}

    def _items(self, message: Any) -> Sequence[Any]:
        """Return the objects of a message."""
        items: Sequence[Any] = attrgetter(self.objects)(message) if self.objects else (message,)
        return items

    def _row(self, points: Sequence[Any], keypoints: int) -> list[Any]:
        """Return (x, y[, score]) of each keypoint of one object, in the layout's order."""
        if not self.keypoint_id:
            check_keypoints(len(points), keypoints, self.keypoints)
            return [self._values(point) for point in points]
        row = [(np.nan,) * (3 if self.score else 2)] * keypoints
        for point in points:
            row[self._place(point, keypoints)] = self._values(point)
        return row

    def _place(self, point: Any, keypoints: int) -> int:
        """Return which of the layout's keypoints this one is."""
        given = self._keypoint_id(point)
        if self.names:
            check_keypoints(len(self.names), keypoints, "names")
            if given not in self._places:
                names = ", ".join(self.names)
                raise MessageError(f"{self.keypoint_id} is {given!r}; the mapping names {names}")
            return self._places[given]
        place = int(given) - self.first_id
        if not 0 <= place < keypoints:
            last = self.first_id + keypoints - 1
            raise MessageError(
                f"{self.keypoint_id} of a keypoint is {given}; the {keypoints} of the keypoint "
                f"layout are {self.first_id} to {last}: name the layout of the detector"
            )
        return place


YOLO = FieldMapping(
    "yolo_msgs/DetectionArray",
    objects="detections",
    identity="id",
    keypoints="keypoints.data",
    x="point.x",
    y="point.y",
    score="score",
    keypoint_id="id",
    first_id=1,
)
"""yolo_ros: joints below its threshold are absent, detections of other classes have none."""

SKELETON_2D = FieldMapping("hri_msgs/Skeleton2D", keypoints="skeleton", score="c", units=NORMALISED)
"""ROS4HRI (REP-155): one body a topic."""

MAPPINGS = {mapping.type: mapping for mapping in (YOLO, SKELETON_2D)}


def _known(value: Any) -> str | None:
    """Return an identity as text, None for what trackers write where they have none."""
    text = str(value)
    return None if text == "" or text.startswith("-") else text
