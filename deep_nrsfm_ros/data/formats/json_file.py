# SPDX-License-Identifier: Apache-2.0
"""JSON of detectors: COCO, OpenPose, MMPose, AlphaPose, MediaPipe and PoseNet.

They differ in what holds the frames, and in the names of the same few fields of an object. One
reader takes them all, so that a mixture (COCO results with nested keypoints, identities of
AlphaPose) is read as well; and arrays written as lists, and keypoints by name, as scripts write
them.

A list at the top is of frames if its elements are frames, as results of MediaPipe are; else it is
of the objects of one frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from deep_nrsfm_ros.data.formats.builder import (
    NO_KEYPOINTS,
    TIMES,
    DetectionsBuilder,
    as_identity,
    as_score,
    as_values,
)
from deep_nrsfm_ros.data.formats.json_items import Readable, json_items
from deep_nrsfm_ros.data.formats.names import layout_of_dataset
from deep_nrsfm_ros.layouts.layout import MAX_KEYPOINTS

EXPECTED = (
    "neither COCO (`annotations`, or a list of results), OpenPose (`people`), MMPose "
    "(`instance_info`), AlphaPose, MediaPipe (`landmarks`) nor of a script of your own (a list "
    'with an object a frame, {"nose": [x, y, confidence], ...})'
)
_KEYPOINTS = (
    *("keypoints", "pose_keypoints_2d", "pose_keypoints", "joints", "landmarks", "landmark"),
    *("pose_landmarks", "poseLandmarks"),
)
_OBJECTS = ("people", "bodies", "instances", "predictions", "poses", "objects", "persons")
_LANDMARKS = ("landmarks", "landmark", "pose_landmarks", "poseLandmarks")
_FRAME = ("image_id", "frame_id", "frame", "frame_number", "frame_index", "image", "file_name")
_SCORES = ("keypoint_scores", "keypoints_scores", "keypoint_score", "scores", "confidence")
_IDENTITY = ("person_id", "track_id", "idx", "instance_id")
_SCORE = ("score", "bbox_score", "confidence")
_BESIDE = {*_FRAME, *_IDENTITY, *_SCORE, *TIMES}
_MAX_SIDE = 1_000_000  # pixels of an image; a larger number is no size
_FEWEST = 3  # keypoints of an object without a field that names them
_CONFIDENCE = ("visibility", "score", "confidence", "presence", "likelihood")


class DefaultFrame(NamedTuple):
    """The frame of objects that name none: that of their file or line.

    Attributes:
        name: of the file or line.
        number: of the frame; None = the number in its name, where the names have one.
        is_document: the document is this frame: a list in it is of objects, not of frames.
    """

    name: str
    number: int | None = None
    is_document: bool = False


class JsonReader:
    """Reads documents into a builder, each a whole recording or one frame."""

    def __init__(self, builder: DetectionsBuilder) -> None:
        """Add frames and objects to a builder."""
        self._builder = builder
        layout = builder.options.layout or builder.options.fallback
        self._expected = len(layout) if layout else None
        self._order: dict[str, int] = {}  # places of keypoints with names

    def read(self, file: Readable, frame: DefaultFrame) -> str:
        """Read a document; return what is wrong if it is of no known form, else "".

        Args:
            file: the document.
            frame: the frame of objects without one of their own.

        Raises:
            ValueError: the document is no JSON, or ends early; what comes before is read.
        """
        known, landmarks = False, []
        elements = 0
        keys: dict[str | None, None] = {}
        for key, value, is_element in json_items(file):
            keys[key] = None
            if key in (None, *_LANDMARKS) and is_element and _is_point(value):
                landmarks.append(value)
            else:
                if is_element and _is_frame(key, value, frame):
                    # Frames without a name or number of their own follow one another.
                    inner = DefaultFrame(f"{frame.name} [{elements}]", elements)
                    known |= self._item(key, value, is_element, inner)
                else:
                    known |= self._item(key, value, is_element, frame)
                elements += 1
        if landmarks:
            self._person({"landmarks": landmarks}, self._frame_of({}, frame))
        if known or landmarks:
            return ""
        names = ", ".join(f"`{key}`" for key in list(keys)[:8] if key is not None)
        return EXPECTED + (f"; it has {names}" if names else "")

    def _item(self, key: str | None, value: Any, is_element: bool, frame: DefaultFrame) -> bool:
        """Read an item of a document; return False if it is of no known form."""
        if key == "images":
            if is_element:
                self._image(value)
            return True
        if key == "categories":
            if is_element:
                self._category(value)
            return False
        if key == "meta_info":
            self._meta_info(value)
            return False
        if value is None or value == []:
            if key in (None, *_OBJECTS, *_LANDMARKS):
                self._frame_of({}, frame)  # a frame without objects
            return key in (None, "annotations", "instance_info", *_OBJECTS, *_LANDMARKS)
        if key in _OBJECTS:
            self._frame_of({}, frame)
        if key in (None, "annotations", "instance_info", "results", "frames", *_OBJECTS):
            return self._element(value, frame, key)
        if key in _LANDMARKS and isinstance(value, list if is_element else dict):
            self._person({"landmarks": value}, self._frame_of({}, frame))
            return True
        if isinstance(value, dict) and key is not None and any(k in value for k in _OBJECTS):
            return self._element(value, DefaultFrame(key), key)  # AlphaPose: image -> people
        if not is_element and isinstance(value, dict) and key and _names_a_frame(key, value):
            return self._element(value, DefaultFrame(key), key)
        if is_element and isinstance(value, dict) and "keypoints" in value and key:
            return self._element(value, DefaultFrame(key), key)
        return False

    def _element(self, value: Any, frame: DefaultFrame, key: str | None) -> bool:
        """Read an object, a frame, or the list of the objects of a frame."""
        if isinstance(value, list) and (_are_numbers(value) or _are_landmarks(value)):
            field = "keypoints" if _are_numbers(value) else "landmarks"
            self._person({field: value}, self._frame_of({}, frame))
            return True
        if isinstance(value, list):  # a list of instances inside `predictions`
            self._frame_of({}, frame)
            known = [self._element(each, frame, key) for each in value]
            return any(known)
        if not isinstance(value, dict):
            self._builder.leave_out("are no object", f"{frame.name}: {value!r:.30}")
            return False
        try:
            self._key_of(value)
        except ValueError as error:
            self._builder.leave_out(str(error), f"{frame.name}: {value!r:.40}")
            return True
        if any(name in value for name in _OBJECTS):
            self._frame(value, frame)
            return True
        if points := _named_points(value):
            index = self._frame_of(value, frame)
            self._time(value, index)
            self._person({**_beside(value), "keypoints": points}, index)
            return True
        field = next((name for name in _KEYPOINTS if name in value), "")
        if field in _LANDMARKS:
            self._result(value, field, frame)
            return True
        if not field:
            # Annotations of COCO are boxes of cars, too.
            if key != "annotations":
                self._builder.leave_out(
                    f"have no keypoints, but {', '.join(map(str, value))[:60] or 'nothing'}",
                    frame.name,
                )
            return key == "annotations"
        self._person(value, self._frame_of(value, frame))
        return True

    def _result(self, value: Mapping[str, Any], field: str, frame: DefaultFrame) -> None:
        """Read a result of MediaPipe: the landmarks of a person, or those of each person."""
        index = self._frame_of(value, frame)
        self._time(value, index)
        people = value[field]
        if isinstance(people, list) and all(map(_is_person, people)):
            for person in people:
                self._person({field: person}, index)
        elif people is not None:  # null: nobody is seen
            self._person(value, index)

    def _time(self, value: Mapping[str, Any], index: int) -> None:
        """Set the time of a frame, if it says one."""
        for name, unit in TIMES.items():
            time = value.get(name)
            if isinstance(time, (int, float)) and not isinstance(time, bool):
                self._builder.time(index, time, unit)
                break

    def _frame(self, value: Mapping[str, Any], frame: DefaultFrame) -> None:
        """Read the objects of a frame."""
        index = self._frame_of(value, frame)
        self._time(value, index)
        for name in _OBJECTS:
            objects = value.get(name)
            if isinstance(objects, list):
                for person in objects:
                    if isinstance(person, dict):
                        self._person(person, index)
                    elif isinstance(person, list):  # predictions: [[person, ...]]
                        for each in person:
                            if isinstance(each, dict):
                                self._person(each, index)
                    else:
                        self._builder.leave_out("are no object", self._place(index))
            elif objects is not None and name in value:
                self._builder.leave_out(f"have no list `{name}`", self._place(index))

    def _key_of(self, value: Mapping[str, Any]) -> int | str | None:
        """Return how an object or frame names its frame; None if it does not.

        Raises:
            ValueError: it names it by something that is neither a number nor a text.
        """
        for name in _FRAME:
            key = value.get(name)
            if isinstance(key, float) and key.is_integer():
                key = int(key)
            if isinstance(key, (int, str)) and not isinstance(key, bool):
                return key
            if key is not None and name.endswith("_id"):
                raise ValueError(f"have an `{name}` that is neither a number nor a text")
        return None

    def _frame_of(self, value: Mapping[str, Any], frame: DefaultFrame) -> int:
        """Return the index of the frame that an object or frame names, or of the default."""
        key = self._key_of(value)
        if key is not None:
            return self._builder.frame(key)
        return self._builder.frame(frame.name, number=frame.number)

    def _person(self, person: Mapping[str, Any], frame: int) -> None:
        """Add an object, or count what is wrong with it."""
        try:
            field = next((name for name in _KEYPOINTS if name in person), "")
            keypoints: Any = person.get(field)
            self._builder.is_mediapipe |= field in _LANDMARKS
            if keypoints is None:
                raise ValueError(NO_KEYPOINTS)
            scores = next((person[n] for n in _SCORES if isinstance(person.get(n), list)), None)
            if isinstance(keypoints, dict) and isinstance(keypoints.get("landmark"), list):
                keypoints = keypoints["landmark"]  # of a message of protobuf
            if isinstance(keypoints, dict):
                keypoints = _named_points(keypoints) or _columns(keypoints)
                scores = None
            by_name = False
            if _are_points(keypoints):
                by_name = self._have_names(keypoints)
                keypoints, scores = self._points(keypoints, by_name), None
            values = as_values(keypoints, scores, self._expected)
            self._builder.in_box(values, person.get("bbox", person.get("box")))
        except ValueError as error:
            self._builder.leave_out(str(error), self._place(frame))
            return
        identity = next(
            (i for n in _IDENTITY if (i := as_identity(person.get(n))) is not None), None
        )
        score = next((s for n in _SCORE if (s := as_score(person.get(n))) is not None), None)
        category = person.get("category_id")
        category = category if isinstance(category, (int, str)) else None
        self._builder.is_coco |= category is not None and "image_id" in person
        self._builder.add(frame, values, identity, score, category, by_name)

    def _have_names(self, points: list[Mapping[str, Any]]) -> bool:
        """Return whether points are told apart by their names; give the builder all names so far.

        Raises:
            ValueError: the objects so far have too many names.
        """
        names = [_name(point) for point in points]
        if not all(isinstance(name, str) for name in names):
            return False
        if len(set(names)) < len(names):
            self._builder.name_keypoints(names)
            return False
        new = [name for name in names if name not in self._order]
        if len(self._order) + len(new) > MAX_KEYPOINTS:
            raise ValueError(f"have names of more than {MAX_KEYPOINTS} keypoints with the others")
        for name in new:
            self._order[name] = len(self._order)
        if new:
            self._builder.name_keypoints(list(self._order))
        return True

    def _points(self, points: list[Mapping[str, Any]], by_name: bool) -> list[list[Any]]:
        """Return x, y and confidence of points with named coordinates.

        Args:
            points: of an object.
            by_name: their names say their places, whatever their order; those that the object
                lacks are NaN.
        """
        rows = [[np.nan] * 3 for _ in (self._order if by_name else points)]
        for i, point in enumerate(points):
            position = point.get("position", point)
            confidence = next((point[n] for n in _CONFIDENCE if n in point), 1.0)
            place = self._order[_name(point)] if by_name else i
            rows[place] = [position.get("x"), position.get("y"), confidence]
        return rows

    def _place(self, frame: int) -> str:
        """Return the name of a frame, for a warning."""
        return self._builder.frame_name(frame)

    def _image(self, image: Any) -> None:
        """Read an entry of `images`."""
        key = image.get("id") if isinstance(image, dict) else None
        if not isinstance(key, (int, str)):
            self._builder.leave_out("are images without `id`", f"{image!r:.40}")
            return
        name = image.get("file_name")
        number = image.get("frame_id", image.get("frame_number"))
        self._builder.frame(
            key,
            name if isinstance(name, str) else "",
            number if isinstance(number, int) else None,
            listed=True,
        )
        width, height = image.get("width"), image.get("height")
        known = all(isinstance(side, int) and 0 < side <= _MAX_SIDE for side in (width, height))
        self._builder.image_size((width, height) if known else None)

    def _category(self, category: Any) -> None:
        """Read an entry of `categories`."""
        if not isinstance(category, dict) or not isinstance(category.get("id"), (int, str)):
            return
        name, names = category.get("name"), category.get("keypoints")
        if isinstance(names, list) and names:
            self._builder.name_keypoints(names, category["id"])
            self._builder.name_category(category["id"], name if isinstance(name, str) else "")

    def _meta_info(self, info: Any) -> None:
        """Read `meta_info` of MMPose."""
        if not isinstance(info, dict):
            return
        if layout := layout_of_dataset(str(info.get("dataset_name", ""))):
            self._builder.use_preset(layout)
        names = info.get("keypoint_id2name")
        if isinstance(names, dict):
            try:
                ordered = [names[key] for key in sorted(names, key=int)]
            except ValueError:
                return
            self._builder.name_keypoints(ordered)


def _names_a_frame(key: str, value: Mapping[str, Any]) -> bool:
    """Return whether a key of a document is the name of the frame whose object is its value."""
    has_number = any(character.isdigit() for character in key)
    return bool(_named_points(value)) or has_number and any(name in value for name in _KEYPOINTS)


def _is_frame(key: str | None, value: Any, document: DefaultFrame) -> bool:
    """Return whether an element of a list at the top is a frame, not an object."""
    if key in ("frames", "results"):
        return isinstance(value, (dict, list))
    if key is not None:
        return False
    if isinstance(value, dict):
        is_people = any(isinstance(value.get(n), list) for n in _OBJECTS)
        is_result = _is_result(value) and not document.is_document
        return is_people or is_result or bool(_named_points(value))
    return value is None or isinstance(value, list)


def _is_result(value: Mapping[str, Any]) -> bool:
    """Return whether an entry is a result of MediaPipe, which gives one for each image.

    An entry with an identity is a person.
    """
    has_identity = any(as_identity(value.get(name)) is not None for name in _IDENTITY)
    return any(name in value for name in _LANDMARKS) and not has_identity


def _is_point(value: Any) -> bool:
    """Return whether a value is a keypoint with `x` and `y`, and not an object with its centre."""
    others = (*_KEYPOINTS, *_FRAME)
    is_dict = isinstance(value, dict) and "x" in value and "y" in value
    return is_dict and not any(name in value for name in others)


def _is_person(value: Any) -> bool:
    """Return whether an element of the landmarks of an image is all landmarks of a person."""
    is_array = isinstance(value, list) and all(isinstance(each, list) for each in value)
    return is_array or _are_points(value)


def _are_landmarks(value: list[Any]) -> bool:
    """Return whether a list is an object, of keypoints with `x` and `y`."""
    return len(value) >= _FEWEST and all(map(_is_point, value))


def _are_numbers(value: list[Any]) -> bool:
    """Return whether a list is an object as an array: [[x, y, s], ...] or [x, y, s, ...]."""
    if value and all(isinstance(point, list) and 2 <= len(point) <= 4 for point in value):
        value = [number for point in value for number in point]
    return len(value) >= 2 * _FEWEST and _are_coordinates(value)


def _named_points(value: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return points with their names, of {name: {x, y, ...}} or {name: [x, y, s]}; else [].

    A point may be null, and beside the points there may be a frame, a time and an identity.
    """
    points: list[dict[str, Any]] = []
    for name, point in value.items():
        if isinstance(point, dict) and "x" in point and "y" in point:
            points.append({**point, "name": name})
        elif isinstance(point, list) and len(point) in (2, 3) and _are_coordinates(point):
            points.append({"name": name, **dict(zip(("x", "y", "score"), point, strict=False))})
        elif point is None and name not in _BESIDE:
            points.append({"name": name, "x": None, "y": None})
        elif name not in _BESIDE:
            return []
    present = sum(point["x"] is not None for point in points)
    return points if present >= _FEWEST else []


def _beside(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return what an object says of itself beside its named points."""
    return {name: value[name] for name in (*_IDENTITY, *_SCORE) if name in value}


def _name(point: Mapping[str, Any]) -> Any:
    """Return the name of a keypoint; None if it has none."""
    return point.get("name", point.get("part"))


def _are_coordinates(values: list[Any]) -> bool:
    """Return whether all values are numbers, or null for a missing one."""
    return all(value is None or isinstance(value, (int, float)) for value in values)


def _columns(keypoints: Mapping[str, Any]) -> list[list[Any]]:
    """Return x, y and confidence of keypoints given as lists of each (Ultralytics).

    Raises:
        ValueError: there are no such lists, or they are not of one length.
    """
    x, y = keypoints.get("x"), keypoints.get("y")
    names = ("visible", *_CONFIDENCE)
    c = next((keypoints[n] for n in names if isinstance(keypoints.get(n), list)), None)
    columns = [column for column in (x, y, c) if isinstance(column, list)]
    if len(columns) < 2 or not isinstance(x, list) or not isinstance(y, list):
        raise ValueError(f"have keypoints with {', '.join(map(str, keypoints))[:60]}, not x and y")
    if len({len(column) for column in columns}) > 1:
        raise ValueError("have lists x and y of other lengths")
    return [list(row) for row in zip(*columns, strict=True)]


def _are_points(keypoints: Any) -> bool:
    """Return whether keypoints are objects with `x` and `y` (MediaPipe, PoseNet)."""
    if not isinstance(keypoints, list) or not keypoints:
        return False
    if not all(isinstance(point, dict) for point in keypoints):
        return False
    return all(isinstance(point.get("position", point), dict) for point in keypoints)
