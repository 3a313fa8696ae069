# SPDX-License-Identifier: Apache-2.0
"""Field mappings: the fields of a message type that hold its objects and their keypoints.

A mapping reads a new detector's messages without code. The mappings of well-known detectors are
here; others are read from YAML, see `config/mappings/`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.lifting.observation import (
    NAME_THE_LAYOUT,
    Identities,
    MessageError,
    check_keypoints,
)
from deep_nrsfm_ros.messages.field_path import FieldPath, describe, fields_of, is_sequence

PIXELS, NORMALISED = "pixels", "normalised"
NEGATIVE = "negative"
"""Value of `missing`: every negative coordinate."""

Size = tuple[int, int]
"""Width and height of an image in pixels."""

_MAX_KEYPOINTS = 1000  # keypoint numbers above are refused while the layout is unknown
_MISFITS = (AttributeError, TypeError, ValueError, IndexError, KeyError, OverflowError)


class MappedObjects(NamedTuple):
    """The n objects of a message that fit a mapping.

    Attributes:
        values: (n, q, 2) x and y in pixels, or (n, q, 3) with confidence, NaN where missing.
        identities: n, None for an object without one.
        scores: n, of the objects; () if the mapping names no score.
        left_out: a reason for each object or keypoint that is left out.
        places: n, the index in the message of each object.
    """

    values: NDArray[np.floating]
    identities: Identities
    scores: tuple[float, ...] = ()
    left_out: tuple[str, ...] = ()
    places: tuple[int, ...] = ()


@dataclass(frozen=True)
class FieldMapping:
    """Paths to the fields of a message type that hold its objects and their keypoints.

    A path (`field_path`) has a dot before a nested field, `[0]` for an item of a list, `[]` for
    each item, `[0::3]` for every third. It begins at the object, with "/" at the message. There are
    three kinds of keypoints:

    - A list of structures: `keypoints` is its path; x, y, confidence and keypoint_id are fields of
      each.
    - A field for each keypoint: `keypoints` has their paths, in the order of the detector's layout.
    - Parallel lists: `keypoints` is ""; x, y, confidence and keypoint_id are paths to lists in the
      object, or to a single number for each keypoint.

    Attributes:
        type: of the message, "package/Type".
        objects: the list of objects, in the message; "": the message is the only object.
        where: a field of an object; those where it is false, 0 or empty are left out; "": none are.
        identity: the identity of an object, in the object, or with "/" a list with one for each
            object; "": there is none.
        score: of an object, in the object, or with "/" a list with one for each object; "": there
            is none.
        keypoints: the list of keypoints of an object, whose items have x, y, confidence and
            keypoint_id; or the fields of all keypoints; "": x, y, confidence and keypoint_id are
            lists themselves. An object with an empty list is left out.
        count: the number of keypoints in the list, in the object; the places behind them are not
            used; "": all of them.
        counts: pairs of a value of `count` and the number that it stands for; (): the number.
        x: x of a keypoint, to the right.
        y: y of a keypoint, down.
        confidence: its confidence from 0 to `max_confidence`; "": all keypoints have confidence 1.
        max_confidence: the largest confidence in messages, e.g. 100 for percent.
        keypoint_id: which keypoint it is: a number that counts from `first_id`, or one of `names`,
            if there are any; "": its place in the list.
        first_id: number of the layout's first keypoint.
        names: names of the keypoints in messages, in the order of the detector's layout. Keypoints
            with other names are left out.
        units: of x and y: "pixels"; "normalised" from 0 to 1 over the image; or width and height of
            the image to which the detector scaled the camera's, if they are pixels of that.
        missing: values of x or y of a missing keypoint, besides NaN and (0, 0); "negative": any
            negative number.
    """

    type: str
    keypoints: str | tuple[str, ...] = ""
    x: str | tuple[str, ...] = "x"
    y: str | tuple[str, ...] = "y"
    confidence: str | tuple[str, ...] = ""
    objects: str = ""
    identity: str = ""
    keypoint_id: str = ""
    first_id: int = 0
    names: tuple[str, ...] = ()
    units: str | Size = PIXELS
    missing: tuple[float, ...] | str = ()
    where: str = ""
    count: str = ""
    counts: tuple[tuple[int, int], ...] = ()
    max_confidence: float = 1.0
    score: str = ""

    def __call__(self, message: Any, keypoints: int, size: Size | None = None) -> MappedObjects:
        """Return the keypoints of n objects, their identities and scores.

        An object that does not fit the layout is left out, with the reason, where another one
        fits.

        Args:
            message: of the type `type`, from rclpy or rosbags.
            keypoints: q, the number of keypoints of the detector's layout.
            size: of the image; needed where `units` is "normalised".

        Raises:
            MessageError: keypoints that do not fit the layout, an unknown size of the image, or
                fields that the message does not have.
        """
        try:
            objects = self._read(message, keypoints)
        except MessageError:
            raise
        except _MISFITS as error:
            raise misfit(self, message, error) from None
        values = objects.values
        xy = values[..., :2]
        if self.missing == NEGATIVE:
            values[(xy < 0).any(-1)] = np.nan
        elif self.missing:
            values[np.isin(xy, self.missing).any(-1)] = np.nan
        if self.max_confidence != 1:
            values[..., 2:] /= self.max_confidence
        if self.units == PIXELS:
            return objects
        scaled = (1, 1) if isinstance(self.units, str) else self.units
        if not size:
            unit = "normalised" if scaled == (1, 1) else f"pixels of {scaled[0]} x {scaled[1]}"
            raise MessageError(
                f"keypoints of {self.type} are {unit}: the size of the image is needed; set "
                "image_width and image_height"
            )
        with np.errstate(over="ignore"):  # infinite coordinates are marked as missing later
            xy *= np.array(size) / scaled
        return objects

    def keypoint_count(self, message: Any) -> int:
        """Return the number of keypoints of the objects, 0 if there is no object.

        Where keypoints are numbered and some may be absent, this is the least possible number.
        """
        if self.names:
            return len(self.names)
        try:
            items = [i for i in self.items(message) if not self.where or self._where(i)]
            points = [self._points(message, item)[:2] for item in items]
            if not self.keypoint_id:
                return max((size for size, _ in points), default=0)
            places = [self._numbers(ids, _MAX_KEYPOINTS) for _, ids in points]
            return max((max(row) for row in places if row), default=-1) + 1
        except MessageError:
            raise
        except _MISFITS as error:
            raise misfit(self, message, error) from None

    def path(self, key: str) -> FieldPath:
        """Return the path of an attribute that has one."""
        return FieldPath(getattr(self, key))

    def paths(self, key: str) -> tuple[FieldPath, ...]:
        """Return the paths of an attribute that may have several."""
        value = getattr(self, key)
        return tuple(map(FieldPath, (value,) if isinstance(value, str) else value))

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """The attributes with the numbers of a keypoint: x, y and, if there is one, confidence."""
        return ("x", "y", "confidence") if self.confidence else ("x", "y")

    def items(self, message: Any) -> Sequence[Any]:
        """Return the objects of a message."""
        items: Sequence[Any] = self._objects(message) if self.objects else (message,)
        return items

    @cached_property
    def _objects(self) -> Callable[[Any], Sequence[Any]]:
        """Return the getter of the objects of a message."""
        return self.path("objects").values

    @cached_property
    def _where(self) -> Callable[[Any], Any]:
        """Return the getter of what says whether an object has keypoints."""
        return self.path("where").value

    @cached_property
    def _values(self) -> Callable[[Any], Any]:
        """Return the getter of (x, y[, confidence]) of a keypoint."""
        paths = [self.path(key) for key in self.columns]
        if all(isinstance(step, str) for path in paths for step in path.steps):
            return attrgetter(*(path.text for path in paths))
        getters = [path.value for path in paths]
        return lambda point: [get(point) for get in getters]

    @cached_property
    def _keypoints(self) -> Callable[[Any], Sequence[Any]]:
        """Return the getter of the keypoints of an object."""
        if isinstance(self.keypoints, str):
            return self.path("keypoints").values
        getters = [path.value for path in self.paths("keypoints")]
        return lambda item: [get(item) for get in getters]

    @cached_property
    def _columns(self) -> list[tuple[bool, Callable[[Any], Sequence[Any]]]]:
        """Return whether each column begins at the message, and its getter."""
        return [column_getter(self.paths(key)) for key in self.columns]

    @cached_property
    def _ids(self) -> tuple[bool, Callable[[Any], Sequence[Any]]]:
        """Return the same of the numbers or names of the keypoints."""
        return column_getter(self.paths("keypoint_id"))

    @cached_property
    def _keypoint_id(self) -> Callable[[Any], Any]:
        """Return the getter of the number or the name of a keypoint."""
        return self.path("keypoint_id").value

    @cached_property
    def _count(self) -> Callable[[Any, Any], int]:
        """Return the function of message and object that returns the number of keypoints."""
        path, numbers = self.path("count"), dict(self.counts)

        def count(message: Any, item: Any) -> int:
            number = int(path.value(message if path.from_message else item))
            if numbers and number not in numbers:
                known = ", ".join(f"{value} ({n} keypoints)" for value, n in numbers.items())
                raise MessageError(f"{self.count} is {number}; counts of the mapping has {known}")
            return numbers.get(number, number)

        return count

    @cached_property
    def _places(self) -> dict[str, int]:
        """Return the index in the layout of each name."""
        return {name: i for i, name in enumerate(self.names)}

    def _read(self, message: Any, keypoints: int) -> MappedObjects:
        """Return the values of all objects, their identities and scores."""
        rows: list[Any] = []
        identities: list[str | None] = []
        scores: list[float] = []
        left_out: list[str] = []
        places: list[int] = []
        refused: MessageError | None = None
        items = self.items(message)
        identity = self._of_object("identity", message, len(items))
        score = self._of_object("score", message, len(items))
        for i, item in enumerate(items):
            if self.where and not self._where(item):
                continue
            try:
                row = self._row(message, item, keypoints, left_out)
            except MessageError as error:
                refused = refused or error
                left_out.append(f"an object is left out: {error}")
                continue
            if row is not None:
                rows.append(row)
                places.append(i)
                identities.append(_identity_text(identity(i, item)) if identity else None)
                if score:
                    scores.append(float(score(i, item)))
        if refused and not rows:
            raise refused
        others = tuple(identities), tuple(scores), tuple(left_out), tuple(places)
        width = len(self.columns)
        shape = (len(rows), keypoints, width)
        if rows and isinstance(rows[0], list):  # twice as fast as np.array
            numbers = chain.from_iterable(chain.from_iterable(rows))
            return MappedObjects(np.fromiter(numbers, np.float64).reshape(shape), *others)
        return MappedObjects(np.array(rows, np.float64).reshape(shape), *others)

    def _of_object(self, key: str, message: Any, objects: int) -> Callable[[int, Any], Any] | None:
        """Return the function of index and object that returns a value of the object.

        Args:
            key: the attribute with its path, "identity" or "score".
            message: of the type `type`.
            objects: number of objects in the message.

        Returns:
            None if the attribute is "".
        """
        text = getattr(self, key)
        if not text:
            return None
        if not text.startswith("/"):
            get = self._getters[key]
            return lambda _, item: get(item)
        listed = self.path(key).values(message)
        if len(listed) != objects:
            raise MessageError(
                f"{key} ({text}) has {len(listed)}; the message has {objects} objects"
            )
        return lambda i, _: listed[i]

    @cached_property
    def _getters(self) -> dict[str, Callable[[Any], Any]]:
        """The getters of the values of an object."""
        keys = ("identity", "score")
        return {key: self.path(key).value for key in keys if getattr(self, key)}

    def _row(self, message: Any, item: Any, keypoints: int, left_out: list[str]) -> Any:
        """Return (x, y[, confidence]) of each keypoint of one object, in the layout's order.

        None if the object has no keypoints. Reasons for keypoints that are left out are added to
        `left_out`.
        """
        if self.keypoints and not self.count:  # most messages
            points = self._keypoints(item)
            size, values = len(points), [*map(self._values, points)]
            ids: Sequence[Any] = [*map(self._keypoint_id, points)] if self.keypoint_id else ()
        else:
            size, ids, values = self._points(message, item)
        if not size:
            return None
        if not self.keypoint_id:
            if size != keypoints:
                self._check_count(values, keypoints)
            return values
        row = [(np.nan,) * len(self.columns)] * keypoints
        if not self.names:
            for place, numbers in zip(self._numbers(ids, keypoints), values, strict=True):
                row[place] = numbers
            return row
        check_keypoints(len(self.names), keypoints, "names")
        places = [*map(self._places.get, ids)]
        for i, numbers in zip(places, values, strict=True):
            if i is not None:
                row[i] = numbers
        if None in places:
            name = str(ids[places.index(None)])[:40]
            known = ", ".join(self.names)
            problem = f"{self.keypoint_id} is {name!r}; the mapping names {known}"
            if not any(i is not None for i in places):
                raise MessageError(problem)
            left_out.append(f"a keypoint is left out: {problem}")
        return row

    def _check_count(self, row: Any, keypoints: int) -> None:
        """Raise MessageError about an object with another number of keypoints than the layout."""
        filled = len(row)
        if not self.count:
            xy = np.array(row, np.float64)[:, :2]
            places = np.flatnonzero(xy.any(1) & np.isfinite(xy).all(1))
            filled = int(places[-1]) + 1 if len(places) else 0
        if not keypoints <= filled < len(row):
            check_keypoints(len(row), keypoints, self._source)
        remedy = f"write {self._source}[:{filled}] in the mapping, or set count"
        if filled != keypoints:
            remedy += f", and {NAME_THE_LAYOUT}"
        raise MessageError(
            f"message has {len(row)} places for keypoints ({self._source}), of which the first "
            f"{filled} are filled; the keypoint layout has {keypoints}: {remedy}"
        )

    @cached_property
    def _source(self) -> str:
        """Return what holds the keypoints, for error texts."""
        if isinstance(self.keypoints, tuple):
            return "keypoints of the mapping"
        return self.keypoints or (self.x if isinstance(self.x, str) else "x of the mapping")

    def _points(self, message: Any, item: Any) -> tuple[int, Sequence[Any], Any]:
        """Return the number of keypoints of one object, their ids, and their values."""
        number = self._count(message, item) if self.count else None
        if number is not None and number < 0:
            raise MessageError(f"{self.count} is {number}; it must be a number of keypoints")
        ids: Sequence[Any] = ()
        if self.keypoints:
            points = self._keypoints(item)
            size = len(points)
            if number is not None:
                points = points[:number]
            if self.keypoint_id:
                ids = [*map(self._keypoint_id, points)]
            values: Any = [*map(self._values, points)]
        else:
            lists = [get(message if root else item) for root, get in self._columns]
            if self.keypoint_id:
                root, get = self._ids
                ids = get(message if root else item)
                lists.append(ids)
            size = len(lists[0])
            if any(len(items) != size for items in lists):
                keys = [*self.columns, "keypoint_id"]
                sizes = ", ".join(
                    f"{key} ({self._text(key)}) has {len(items)}"
                    for key, items in zip(keys, lists, strict=False)
                )
                raise MessageError(f"the lists of an object must be of one length: {sizes}")
            lists = lists if number is None else [items[:number] for items in lists]
            ids = ids if number is None else ids[:number]
            values = np.array(lists[: len(self.columns)], np.float64).T
        if number is not None and number > size:
            raise MessageError(f"{self.count} says {number} keypoints; {self._source} has {size}")
        return len(values), ids, values

    def _text(self, key: str) -> str:
        """Return the path of an attribute, or the first of its paths, for error texts."""
        return self.paths(key)[0].text

    def _numbers(self, ids: Sequence[Any], keypoints: int) -> list[int]:
        """Return the index in the layout of each numbered keypoint."""
        try:
            places = [int(value) - self.first_id for value in ids]
        except ValueError as error:
            text = next((v for v in ids if isinstance(v, str)), None)
            problem = f"{self.keypoint_id} of a keypoint is {str(text)[:40]!r}, which is no number"
            raise MessageError(
                f"{problem}: list the names of the keypoints as names" if text else str(error)
            ) from None
        if places and min(places) < 0:
            raise MessageError(
                f"{self.keypoint_id} of a keypoint is {min(places) + self.first_id}; first_id of "
                f"the mapping is {self.first_id}: set it to the number of the layout's first "
                "keypoint"
            )
        if places and max(places) >= keypoints:
            last = self.first_id + keypoints - 1
            raise MessageError(
                f"{self.keypoint_id} of a keypoint is {max(places) + self.first_id}; the "
                f"{keypoints} of the keypoint layout are {self.first_id} to {last}: name the "
                "layout of the detector"
            )
        return places


def column_getter(paths: Sequence[FieldPath]) -> tuple[bool, Callable[[Any], Sequence[Any]]]:
    """Return whether a column of parallel lists begins at the message, and its getter.

    Args:
        paths: one of a list, or one of a number for each keypoint.
    """
    if len(paths) == 1:
        return paths[0].from_message, paths[0].values
    getters = [path.value for path in paths]
    return paths[0].from_message, lambda root: [get(root) for get in getters]


def misfit(mapping: FieldMapping, message: Any, error: Exception) -> MessageError:
    """Return the error about a message that has not the fields of a mapping.

    Args:
        mapping: of the message.
        message: the message.
        error: from reading it.
    """
    problem: Exception = error
    try:
        explain(mapping, message)
    except Exception as found:  # the message may be anything
        problem = found
    return MessageError(f"message of type {mapping.type} does not fit its mapping: {problem}")


def explain(mapping: FieldMapping, message: Any) -> None:
    """Raise MessageError with the path of a mapping that a message does not have.

    Returns where every path leads to what it should.
    """
    objects = [message]
    if mapping.objects:
        objects = _follow(mapping, "objects", message, "the message", _LIST)
    for item in objects:
        place = "the object" if mapping.objects else "the message"
        for key in ("where", "identity", "score", "count"):
            if text := getattr(mapping, key):
                root, where = (message, "the message") if text[0] == "/" else (item, place)
                kind = _NUMBER if key in ("count", "score") else _VALUE
                listed = key in ("identity", "score") and text[0] == "/"
                _follow(mapping, key, root, where, _LIST if listed else kind)
        kinds = dict.fromkeys(mapping.columns, _NUMBER)
        if mapping.keypoint_id:
            kinds["keypoint_id"] = _VALUE
        if not mapping.keypoints:
            for key, kind in kinds.items():
                several = len(mapping.paths(key)) > 1
                for path in mapping.paths(key):
                    root, where = (message, "the message") if path.from_message else (item, place)
                    items = _follow(mapping, key, root, where, kind if several else _LIST, path)
                    wrong = [item for item in items if not _number(item)]
                    if wrong and kind == _NUMBER:
                        problem = f"its items are no numbers: one is {describe(wrong[0])}"
                        raise MessageError(f"{key} is {path.text!r}, and {problem}")
            continue
        single = isinstance(mapping.keypoints, str)
        for path in mapping.paths("keypoints"):
            kind = _LIST if single else _VALUE
            for point in _follow(mapping, "keypoints", item, place, kind, path):
                for key, wanted in kinds.items():
                    _follow(mapping, key, point, "the keypoint", wanted)


_VALUE, _NUMBER, _LIST = "a value", "a number", "a list"


def _follow(
    mapping: FieldMapping,
    key: str,
    root: Any,
    where: str,
    kind: str,
    path: FieldPath | None = None,
) -> list[Any]:
    """Return the values at a path of a mapping, or raise MessageError that says what is wrong."""
    path = path or mapping.path(key)
    problem = f"{key} is {path.text!r}, and "
    try:
        values = path.follow(root, where)
    except MessageError as error:
        raise MessageError(f"{problem}{error}") from None
    if kind == _LIST:
        if path.is_list:
            return [v for value in values for v in (value if is_sequence(value) else [value])]
        if is_sequence(values[0]):
            return list(values[0])
    wrong = [value for value in values if kind == _LIST or kind == _NUMBER and not _number(value)]
    if wrong:
        remedy = f": write {path.text}[0] for its first item" if is_sequence(wrong[0]) else ""
        if kind == _NUMBER and (fields := fields_of(wrong[0])):
            remedy = f": go on to one of its fields, like {path.text}.{fields[0]}"
        raise MessageError(f"{problem}that is {describe(wrong[0])}, not {kind}{remedy}")
    return values


def _number(value: Any) -> bool:
    """Return whether a value can be a coordinate."""
    if is_sequence(value):
        return False
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


YOLO = FieldMapping(
    "yolo_msgs/DetectionArray",
    objects="detections",
    identity="id",
    score="score",
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
