"""Field mappings: the fields of a message type that hold its objects and their keypoints.

A mapping reads a new detector's messages without code. The mappings of well-known detectors are
here; others are read from YAML, see `config/mappings/`.
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

_MAX_KEYPOINTS = 1000  # keypoint numbers above are refused while the layout is unknown


@dataclass(frozen=True)
class FieldMapping:
    """Names of the fields of a message type; a dot leads into a nested message.

    Attributes:
        type: of the message, "package/Type".
        objects: the list of objects, in the message; "": the message is the only object.
        identity: the identity of an object, in the object; "": there is none.
        keypoints: the list of keypoints, in the object. An object with an empty list is left out.
        x: x of a keypoint, in the keypoint, to the right.
        y: y of a keypoint, in the keypoint, down.
        confidence: its confidence in [0, 1], in the keypoint; "": all keypoints have confidence 1.
        keypoint_id: which keypoint it is, in the keypoint: a number that counts from `first_id`,
            or one of `names`, if there are any; "": its place in the list.
        first_id: number of the layout's first keypoint.
        names: names of the keypoints in messages, in the order of the detector's layout.
        units: of x and y: "pixels", or "normalised" from 0 to 1 over the image.
        missing: value of x or y of a missing keypoint, besides NaN and (0, 0); None: no value.
    """

    type: str
    keypoints: str
    x: str = "x"
    y: str = "y"
    confidence: str = ""
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
        """Return the keypoints of n objects and their identities.

        Args:
            message: of the type `type`, from rclpy or rosbags.
            keypoints: q, the number of keypoints of the detector's layout.
            size: of the image; needed where `units` is "normalised".

        Returns:
            (n, q, 2) x and y in pixels, or (n, q, 3) with confidence, NaN where missing; and n
            identities.

        Raises:
            MessageError: keypoints that do not fit the layout, or an unknown size of the image.
            AttributeError, TypeError, ValueError: the message has not these fields.
        """
        rows, identities = [], []
        for item in self._items(message):
            if len(points := self._keypoints(item)):
                rows.append(self._row(points, keypoints))
                identities.append(_identity_text(self._identity(item)))
        width = 3 if self.confidence else 2
        values = np.array(rows, np.float64).reshape(len(rows), keypoints, width)
        if self.missing is not None:
            values[(values[..., :2] == self.missing).any(-1)] = np.nan
        if self.units == NORMALISED and not size:
            raise MessageError(
                f"keypoints of {self.type} are normalised: the size of the image is needed; set "
                "image_width and image_height"
            )
        if self.units == NORMALISED:
            with np.errstate(over="ignore"):  # infinite coordinates are marked as missing later
                values[..., :2] *= np.array(size)
        return values, tuple(identities)

    def count(self, message: Any) -> int:
        """Return the number of keypoints of the objects, 0 if there is no object.

        Where keypoints are numbered and some may be absent, this is the least possible number.
        """
        if self.names:
            return len(self.names)
        lists = [self._keypoints(item) for item in self._items(message)]
        if not self.keypoint_id:
            return max(map(len, lists), default=0)
        places = [self._place(point, _MAX_KEYPOINTS) for points in lists for point in points]
        return max(places, default=-1) + 1

    @cached_property
    def _values(self) -> Callable[[Any], Any]:
        """Return the getter of (x, y[, confidence]) of a keypoint."""
        return attrgetter(*filter(None, (self.x, self.y, self.confidence)))

    @cached_property
    def _keypoints(self) -> Callable[[Any], Sequence[Any]]:
        """Return the getter of the keypoints of an object."""
        return attrgetter(self.keypoints)

    @cached_property
    def _identity(self) -> Callable[[Any], Any]:
        """Return the getter of the identity of an object."""
        return attrgetter(self.identity) if self.identity else lambda _: ""

    @cached_property
    def _keypoint_id(self) -> Callable[[Any], Any]:
        """Return the getter of the number or the name of a keypoint."""
        return attrgetter(self.keypoint_id)

    @cached_property
    def _places(self) -> dict[str, int]:
        """Return the index in the layout of each name."""
        return {name: i for i, name in enumerate(self.names)}

    def _items(self, message: Any) -> Sequence[Any]:
        """Return the objects of a message."""
        items: Sequence[Any] = attrgetter(self.objects)(message) if self.objects else (message,)
        return items

    def _row(self, points: Sequence[Any], keypoints: int) -> list[Any]:
        """Return (x, y[, confidence]) of each keypoint of one object, in the layout's order."""
        if not self.keypoint_id:
            check_keypoints(len(points), keypoints, self.keypoints)
            return [self._values(point) for point in points]
        row = [(np.nan,) * (3 if self.confidence else 2)] * keypoints
        for point in points:
            row[self._place(point, keypoints)] = self._values(point)
        return row

    def _place(self, point: Any, keypoints: int) -> int:
        """Return the index of a keypoint in the layout."""
        value = self._keypoint_id(point)
        if self.names:
            check_keypoints(len(self.names), keypoints, "names")
            if value not in self._places:
                names = ", ".join(self.names)
                raise MessageError(f"{self.keypoint_id} is {value!r}; the mapping names {names}")
            return self._places[value]
        place = int(value) - self.first_id
        if not 0 <= place < keypoints:
            last = self.first_id + keypoints - 1
            raise MessageError(
                f"{self.keypoint_id} of a keypoint is {value}; the {keypoints} of the keypoint "
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
    confidence="score",
    keypoint_id="id",
    first_id=1,
)
"""yolo_ros; keypoints below its threshold are absent, other classes have no keypoints."""

SKELETON_2D = FieldMapping(
    "hri_msgs/Skeleton2D", keypoints="skeleton", confidence="c", units=NORMALISED
)
"""ROS4HRI (REP-155); one body per topic."""

MAPPINGS = {mapping.type: mapping for mapping in (YOLO, SKELETON_2D)}


def _identity_text(value: Any) -> str | None:
    """Return an identity as text; None for "" and negative numbers, which mean none."""
    text = str(value)
    return None if text == "" or text.startswith("-") else text
