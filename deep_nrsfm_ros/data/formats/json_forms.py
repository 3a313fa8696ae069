# SPDX-License-Identifier: Apache-2.0
"""What a value of JSON is by its form: a frame, an object, several as arrays, a keypoint."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.json_fields import (
    frame_field,
    identity_field,
    is_usual,
    letters,
    role,
)
from deep_nrsfm_ros.data.formats.json_items import JsonItem

KEYPOINTS = (
    *("keypoints", "pose_keypoints_2d", "pose_keypoints", "joints", "landmarks", "landmark"),
    *("pose_landmarks", "poseLandmarks"),
)
"""Names of the keypoints of an object, the surest first."""
OBJECTS = ("people", "bodies", "instances", "predictions", "poses", "objects", "persons")
"""Names of the objects of a frame in each file."""
RECORDING = ("annotations", "images", "categories", "meta_info", "instance_info", "frames")
"""Fields of a document that is a recording, and no frame."""
CONFIDENCE = ("visibility", "score", "confidence", "presence", "likelihood")
"""Names of the confidence of a keypoint."""
FEWEST = 3
"""Keypoints of an object without a field that names them."""
NUMBER = "frame number"
"""Name of the number of a frame that `with_number` gives it."""
NUMBERS = ("index", "idx", "number", "num", "no", "nr", "i", "n", "id")
"""Names of the number of a frame, beside its objects."""
_LABELLED = (17, 133)  # keypoints of the models of Transformers, which leave weak ones out
_FRAMES = ("frames", "results")
"""Fields with lists of frames, or of objects that are frames each."""
_ROLES_BESIDE = ("frame", "time", "identity", "confidence")
_IDENTITY = re.compile(r"[a-z]*[ _.-]?\d+", re.IGNORECASE)  # 3, person_3
_MOST_CONFIDENCE = 100.0  # of a list of confidences; they may be percent


def fields_of(start: list[JsonItem]) -> dict[str, Any]:
    """Return the fields of a document, of its items."""
    fields: dict[str, Any] = {}
    for key, value, is_element in start:
        if key is None:
            continue
        if not is_element:
            fields[key] = value
        elif isinstance(fields.get(key), list):
            fields[key].append(value)
        else:
            fields[key] = [value]
    return fields


def is_recording(item: JsonItem, is_document: bool) -> bool:
    """Return whether a document with such an item is a recording, whatever else is in it."""
    if item.key is None:
        return not isinstance(item.value, (int, float))
    return item.key in RECORDING and not is_document


def series_in(start: list[JsonItem]) -> set[str]:
    """Return the fields with several lists of objects, which are frames: `predictions`."""
    counts = Counter(
        key
        for key, value, is_element in start
        if key and is_element and isinstance(value, list) and not _is_array(value)
    )
    return {key for key, count in counts.items() if count > 1 and role(key) == "objects"}


def is_frame(key: str | None, value: Any, series: Collection[str], is_document: bool) -> bool:
    """Return whether an element of a list at the top is a frame, not an object."""
    if key in _FRAMES:
        return isinstance(value, (dict, list))
    if key is not None and role(key) == "keypoints" and not is_landmarks(key):
        is_object = isinstance(value, list) and (_is_array(value) or people_in(value))
        return bool(is_object) and not is_document
    if key is not None and (role(key) != "objects" or is_document):
        return False
    if isinstance(value, dict):
        if is_document:
            return False
        return bool(object_fields(value) or named_points(value)) or _is_result(value)
    return key is None and not is_document or key in series


def _is_result(value: Mapping[str, Any]) -> bool:
    """Return whether an entry is a result of MediaPipe or an array of people, one for each image.

    An entry with an identity is a person.
    """
    names = [name for name in value if role(name) in ("keypoints", "hands")]
    are_people = any(is_landmarks(name) or people_in(value[name]) for name in names)
    return are_people and not identity_field(value)


def holds_frames(values: list[Any]) -> bool:
    """Return whether the objects of a document are frames: several lists, or lists in them."""
    lists = sum(isinstance(each, list) and not _is_array(each) for each in values)
    return lists > 1 or any(isinstance(each, dict) and object_fields(each) for each in values)


def names_its_frame(value: Any) -> bool:
    """Return whether an object of a frame, or each of a list of them, names its own frame."""
    values = value if isinstance(value, list) else [value]
    return any(isinstance(each, dict) and frame_field(each) for each in values)


def check_frame(value: Mapping[str, Any]) -> None:
    """Raise ValueError if an object names its frame by neither a number nor a text."""
    for name in ("image_id", "frame_id"):
        if value.get(name) is not None and not frame_field({name: value[name]}):
            raise ValueError(f"have an `{name}` that is neither a number nor a text")


def names_a_frame(key: str, value: Mapping[str, Any]) -> bool:
    """Return whether a key of a document is the name of the frame whose object is its value."""
    if named_points(value):
        return True
    has_number = any(character.isdigit() for character in key)
    return has_number and (has_keypoints(value) or bool(people_by_id(value)))


def object_fields(value: Mapping[str, Any]) -> list[str]:
    """Return the fields of a frame with its objects."""
    found = [name for name in OBJECTS if name in value]
    for name, given in value.items():
        if name in found or role(name) != "objects":
            continue
        objects = as_list(given)
        if given == [] or any(map(_is_like_object, objects[:FEWEST])):
            found.append(name)
    return found


def with_number(value: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a frame with its number under `NUMBER`, if a field of it can be that."""
    for name, given in value.items():
        if letters(name) in NUMBERS and isinstance(given, int) and not isinstance(given, bool):
            return {**other_fields(value, [name]), NUMBER: given}
    return value


def at_their_places(
    values: NDArray[np.float64], labels: Any, expected: int | None
) -> NDArray[np.float64]:
    """Return keypoints at the places that their labels say, the others NaN.

    Args:
        values: (k, 3) of an object.
        labels: k numbers of the keypoints; the keypoints are as they are if it is anything else.
        expected: number of keypoints of the layout; None = unknown.
    """
    if not isinstance(labels, list) or len(labels) != len(values):
        return values
    if not all(type(label) is int and label >= 0 for label in labels):
        return values
    q = next((q for q in (expected, *_LABELLED) if q and q > max(labels)), 0)
    if len(set(labels)) < len(labels) or not q:
        return values
    placed = np.full((q, 3), np.nan)
    placed[labels] = values
    return placed


def _is_like_object(value: Any) -> bool:
    """Return whether a value is like an object or a frame."""
    if isinstance(value, dict):
        return has_keypoints(value) or bool(named_points(value) or object_fields(value))
    return isinstance(value, list) and _is_array(value)


def has_keypoints(value: Any) -> bool:
    """Return whether a value has a field of keypoints."""
    if not isinstance(value, dict):
        return False
    return any(
        (name in KEYPOINTS or role(name) == "keypoints" and isinstance(given, list))
        and not are_texts(given)
        for name, given in value.items()
    )


def are_texts(value: Any) -> bool:
    """Return whether a list begins with a text that is no number: the names of keypoints."""
    if not isinstance(value, list) or not value or not isinstance(value[0], str):
        return False
    return not value[0].strip().lstrip("+-").replace(".", "", 1).isdigit()


def hint_of(value: Mapping[str, Any]) -> str:
    """Return what to say of an object without keypoints that are read, "" for nothing."""
    if any(letters(name).endswith("x") and f"{name[:-1]}y" in value for name in value):
        return " (rows of a table: write it as .csv)"
    if any(role(name) == "hands" and value[name] for name in value):
        return " (hands are read with --model hand21)"
    words = ("3d", "world", "jointpositions")
    if any(word in letters(name) for word in words for name in value):
        return " (3D, and the 2D keypoints are needed)"
    return ""


def is_empty_frame(value: Mapping[str, Any]) -> bool:
    """Return whether a value is a frame without objects: its name, and nothing else that counts.

    An entry with `image_id` is an object.
    """
    if not frame_field(value) or "image_id" in value:
        return False
    return all(
        given is None or given in ([], {}) or role(name) in ("frame", "time") or name == "header"
        for name, given in value.items()
    )


def people_by_id(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return the objects of {identity: object}; {} if they are none."""
    if not all(_IDENTITY.fullmatch(name) for name in value):
        return {}
    is_people = all(
        has_keypoints(one) or isinstance(one, list) and _is_array(one) for one in value.values()
    )
    return dict(value) if is_people else {}


def people_in(keypoints: Any) -> int:
    """Return the number of objects in keypoints (n, q, 2 or 3) or (n, 3q); 0 for one object."""
    if not isinstance(keypoints, list) or not all(isinstance(r, list) and r for r in keypoints):
        return 0
    if all(isinstance(row[0], (list, dict)) for row in keypoints):
        return len(keypoints)
    return len(keypoints) if all(len(row) >= 2 * FEWEST for row in keypoints) else 0


def objects_of(value: Mapping[str, Any], field: str) -> list[Mapping[str, Any]]:
    """Return the objects of arrays: keypoints (n, q, 2) with scores (n, q), n identities, ..."""
    n = people_in(value.get(field))
    if not n:
        return [value]
    shared = {k: v for k, v in value.items() if not isinstance(v, list) or len(v) != n}
    own = {k: v for k, v in value.items() if k not in shared}
    return [{**shared, **{k: v[i] for k, v in own.items()}} for i in range(n)]


def confidence_field(person: Mapping[str, Any], values: NDArray[np.float64]) -> str:
    """Return the field with a confidence for each keypoint under an unusual name; "" for none.

    Args:
        person: the object.
        values: (q, 3) its keypoints as they are without the field.
    """
    third = values[:, 2]
    if ((third >= 0) & (third <= 1)).all() and (third < 1).any():
        return ""
    for name, given in person.items():
        if not isinstance(given, list) or role(name) != "confidence" or "box" in letters(name):
            continue
        try:
            beside = np.asarray(given, np.float64).ravel()
        except (TypeError, ValueError, OverflowError):
            continue
        is_plausible = ((beside >= 0) & (beside <= _MOST_CONFIDENCE)) | np.isnan(beside)
        if beside.size == len(values) and is_plausible.all():
            return name
    return ""


def as_list(value: Any) -> list[Any]:
    """Return a list as it is, an object as a list of it, and [] for all else."""
    return value if isinstance(value, list) else [value] if isinstance(value, dict) else []


def other_fields(value: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Return the other fields."""
    return {name: given for name, given in value.items() if name not in names}


def is_landmarks(name: str) -> bool:
    """Return whether a field of this name is of MediaPipe."""
    return "landmark" in letters(name)


def is_point_of(key: str | None, value: Any) -> bool:
    """Return whether an element is a keypoint of an object that is all of the list."""
    is_listed = isinstance(value, list) and 2 <= len(value) <= 4 and are_coordinates(value)
    if not is_listed and not is_point(value):
        return False
    if key is None or role(key) in ("keypoints", "hands"):
        return True
    return any(character.isdigit() for character in key) and not is_usual(key)


def is_point(value: Any) -> bool:
    """Return whether a value is a keypoint with `x` and `y`, and not an object with its centre."""
    if not isinstance(value, dict) or "x" not in value or "y" not in value:
        return False
    return not any(role(name) in ("keypoints", "frame") for name in value)


def is_person(value: Any) -> bool:
    """Return whether an element of the landmarks of an image is all landmarks of a person."""
    is_array = isinstance(value, list) and all(isinstance(each, list) for each in value)
    is_message = isinstance(value, dict) and isinstance(value.get("landmark"), list)
    return is_array or is_message or are_points(value)


def are_landmarks(value: list[Any]) -> bool:
    """Return whether a list is an object, of keypoints with `x` and `y`."""
    return len(value) >= FEWEST and all(map(is_point, value))


def _is_array(value: list[Any]) -> bool:
    """Return whether a list is an object of keypoints."""
    return are_numbers(value) or are_landmarks(value)


def are_numbers(value: list[Any]) -> bool:
    """Return whether a list is an object as an array: [[x, y, s], ...] or [x, y, s, ...]."""
    if value and all(isinstance(point, list) and 2 <= len(point) <= 4 for point in value):
        value = [number for point in value for number in point]
    return len(value) >= 2 * FEWEST and are_coordinates(value)


def named_points(value: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return points with their names, of {name: {x, y, ...}} or {name: [x, y, s]}; else [].

    A point may be null, or [x, y, z, s], and beside the points there may be a frame, a time, an
    identity, a score and what is usual.
    """
    points: list[dict[str, Any]] = []
    for name, point in value.items():
        if isinstance(point, dict) and "x" in point and "y" in point:
            points.append({**point, "name": name})
        elif isinstance(point, list) and len(point) in (2, 3) and are_coordinates(point):
            points.append({"name": name, **dict(zip(("x", "y", "score"), point, strict=False))})
        elif _is_point_with_z(name, point):
            points.append({"name": name, "x": point[0], "y": point[1], "score": point[3]})
        elif role(name) in _ROLES_BESIDE or name == "header":
            continue
        elif point is None:
            points.append({"name": name, "x": None, "y": None})
        elif not is_usual(name) or isinstance(point, dict):
            return []
    present = sum(point["x"] is not None for point in points)
    return points if present >= FEWEST else []


def _is_point_with_z(name: str, point: Any) -> bool:
    """Return whether a field is a keypoint [x, y, z, visibility], and no box."""
    is_list = isinstance(point, list) and len(point) == 4 and are_coordinates(point)
    return is_list and "box" not in letters(name)


def beside_points(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return what an object says of itself beside its named points."""
    return {name: given for name, given in value.items() if role(name) in _ROLES_BESIDE}


def name_of(point: Mapping[str, Any]) -> Any:
    """Return the name of a keypoint; None if it has none."""
    return point.get("name", point.get("part"))


def are_coordinates(values: list[Any]) -> bool:
    """Return whether all values are numbers, or null for a missing one."""
    return all(value is None or isinstance(value, (int, float)) for value in values)


def columns_of(keypoints: Mapping[str, Any]) -> list[list[Any]]:
    """Return x, y and confidence of keypoints given as lists of each (Ultralytics).

    Raises:
        ValueError: there are no such lists, or they are not of one length.
    """
    x, y = keypoints.get("x"), keypoints.get("y")
    names = ("visible", *CONFIDENCE)
    c = next((keypoints[n] for n in names if isinstance(keypoints.get(n), list)), None)
    columns = [column for column in (x, y, c) if isinstance(column, list)]
    if len(columns) < 2 or not isinstance(x, list) or not isinstance(y, list):
        raise ValueError(f"have keypoints with {', '.join(map(str, keypoints))[:60]}, not x and y")
    if len({len(column) for column in columns}) > 1:
        raise ValueError("have lists x and y of other lengths")
    return [list(row) for row in zip(*columns, strict=True)]


def are_points(keypoints: Any) -> bool:
    """Return whether keypoints are objects with `x` and `y` (MediaPipe, PoseNet)."""
    if not isinstance(keypoints, list) or not keypoints:
        return False
    if not all(isinstance(point, dict) for point in keypoints):
        return False
    return all(isinstance(point.get("position", point), dict) for point in keypoints)
