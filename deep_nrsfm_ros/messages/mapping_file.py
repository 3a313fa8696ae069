# SPDX-License-Identifier: Apache-2.0
"""Read a field mapping from YAML, for message types that have none in this package.

`config/mappings/` has examples; media_pipe_ros2.yaml explains each field.
"""

from __future__ import annotations

import dataclasses
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from deep_nrsfm_ros.messages.field_mapping import NEGATIVE, NORMALISED, PIXELS, FieldMapping
from deep_nrsfm_ros.messages.field_path import FieldPath
from deep_nrsfm_ros.model_files.folders import mapping_folders
from deep_nrsfm_ros.yaml_file import brief_repr, read_fields

MAPPING_SUFFIXES = (".yaml", ".yml")

_TYPE = re.compile(r"([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)")
_DOTTED_INDEX = re.compile(r"\.(\d+)")
_PATHS = (
    "objects",
    "where",
    "identity",
    "score",
    "keypoints",
    "count",
    "x",
    "y",
    "confidence",
    "keypoint_id",
)
_SEVERAL = ("keypoints", "x", "y", "confidence")  # may have a path for each keypoint
_FROM_OBJECT = ("objects", "where", "keypoints")  # that are not looked for in the message
_REAL = (int, float)
_NUMBERS = ("first_id", "max_confidence")


class MappingError(ValueError):
    """A mapping file that is missing or invalid; the text names the file and the remedy."""


def read_mapping(path: Path) -> FieldMapping:
    """Return the mapping in a YAML file.

    Raises:
        MappingError: the file is missing or invalid.
    """
    try:
        return _mapping(read_fields(path, "type: my_msgs/People"))
    except ValueError as error:
        raise MappingError(f"field mapping {path}: {error}") from error


def shipped_mappings(kind: str) -> list[Path]:
    """Return the field mappings of a message type, "package/Type", that come with the package."""
    found: dict[str, Path] = {}
    for folder in mapping_folders():
        for path in sorted(folder.glob(f"*{MAPPING_SUFFIXES[0]}")):
            with suppress(ValueError):
                if read_mapping(path).type == kind:
                    found.setdefault(path.name, path)
    return list(found.values())


def _mapping(content: dict[Any, Any]) -> FieldMapping:
    """Return the mapping of checked fields; raise ValueError for an invalid one."""
    fields = {field.name: field for field in dataclasses.fields(FieldMapping) if field.init}
    for name in content:
        if name not in fields:
            raise ValueError(f"has no field {brief_repr(name)}; the fields are {', '.join(fields)}")
    content = {name: value for name, value in content.items() if value is not None}
    if "type" not in content:
        raise ValueError("lacks the field 'type'")
    if "keypoints" not in content and not {"x", "y"} <= content.keys():
        raise ValueError(
            "lacks the field 'keypoints', the list of keypoints of an object; or x and y, the "
            "lists of their coordinates"
        )
    if not (match := _TYPE.fullmatch(str(content["type"]))):
        raise ValueError(f"type is {brief_repr(content['type'])}; it must be like my_msgs/People")
    for name in _NUMBERS:
        value = content.get(name, 1)
        if isinstance(value, bool) or not isinstance(value, int if name == "first_id" else _REAL):
            raise ValueError(f"{name} is {brief_repr(value)}; it must be a number")
    if not content.get("max_confidence", 1) > 0:
        raise ValueError(f"max_confidence is {content['max_confidence']}; it must be above 0")
    paths = {name: _paths(name, content[name]) for name in _PATHS if name in content}
    _check_paths(paths)
    made = {
        "type": "/".join(match.groups()),
        "names": _names(content),
        "units": _units(content.get("units", PIXELS)),
        "missing": _missing(content.get("missing", [])),
        "counts": _counts(content),
    }
    return FieldMapping(**content | paths | made)


def _paths(name: str, value: Any) -> str | tuple[str, ...]:
    """Return the path in a field, or the paths."""
    if isinstance(value, list) and value and name in _SEVERAL:
        paths = [_paths(name, path) for path in value]
        if all(isinstance(path, str) for path in paths):
            return tuple(map(str, paths))
    try:
        if not isinstance(value, str):
            raise ValueError
        path = FieldPath(value)
    except ValueError:
        remedy = "it must be a field, like position.x"
        if isinstance(value, str) and _DOTTED_INDEX.search(value):
            remedy = f"an index is in brackets: {_DOTTED_INDEX.sub(_brackets, value)}"
        elif isinstance(value, list) and name in _SEVERAL:
            remedy = "it must be a field, like position.x, or the fields of all keypoints"
        raise ValueError(f"{name} is {brief_repr(value)}; {remedy}") from None
    if path.from_message and name in _FROM_OBJECT:
        where = "the message" if name == "objects" else "the object"
        raise ValueError(f"{name} is {value!r}; it begins at {where}, without /")
    return value


def _brackets(match: re.Match[str]) -> str:
    """Return an index in brackets."""
    return f"[{match[1]}]"


def _check_paths(paths: dict[str, str | tuple[str, ...]]) -> None:
    """Raise ValueError for paths that do not go together."""
    keypoints = paths.get("keypoints")
    for name, value in paths.items():
        several = (value,) if isinstance(value, str) else value
        in_keypoint = name in ("x", "y", "confidence", "keypoint_id") and bool(keypoints)
        for path in map(FieldPath, several):
            if in_keypoint and (path.is_list or path.from_message or len(several) > 1):
                raise ValueError(
                    f"{name} is {brief_repr(value)}, which is no field of one keypoint: leave out "
                    "keypoints where x and y are lists of the object"
                )
            one = name in ("where", "count") or (
                name in ("identity", "score") and not path.from_message
            )
            if path.is_list and (one or len(several) > 1):
                raise ValueError(f"{name} is {path.text!r}; it must lead to one value, without []")
    if isinstance(keypoints, tuple):
        for name in ("keypoint_id", "count"):
            if name in paths:
                raise ValueError(
                    f"{name} is there, but keypoints names a field for each keypoint, in the order "
                    "of the layout: leave it out"
                )
    lists = [
        len(paths[name])
        for name in ("x", "y", "confidence")
        if name in paths and isinstance(paths[name], tuple)
    ]
    if lists and len(set(lists)) > 1:
        raise ValueError(
            f"x, y and confidence name {', '.join(map(str, lists))} fields; they must "
            "name one for each keypoint"
        )


def _names(content: dict[Any, Any]) -> tuple[str, ...]:
    """Return the checked names of keypoints."""
    names = content.get("names", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("names must be a list of names, in quotes if need be")
    if len(set(names)) < len(names):
        raise ValueError("names has a name twice")
    if names and "keypoint_id" not in content:
        raise ValueError("names are there, but no keypoint_id that is one of them")
    if "first_id" in content and (names or "keypoint_id" not in content):
        reason = "keypoints have names" if names else "there is no keypoint_id that counts from it"
        raise ValueError(f"first_id is there, but {reason}: leave it out")
    return tuple(names)


def _units(value: Any) -> str | tuple[int, int]:
    """Return the checked units of coordinates."""
    if isinstance(value, list) and len(value) == 2:
        width, height = value
        if type(width) is int and type(height) is int and min(value) > 0:
            return width, height
    if value not in (PIXELS, NORMALISED):
        raise ValueError(
            f"units is {brief_repr(value)}; it must be {PIXELS}, {NORMALISED}, or the width and "
            "height of the image that the detector saw, like [224, 224]"
        )
    return str(value)


def _missing(value: Any) -> tuple[float, ...] | str:
    """Return the checked values of missing keypoints."""
    if value == NEGATIVE:
        return NEGATIVE
    values = value if isinstance(value, list) else [value]
    if any(isinstance(number, bool) or not isinstance(number, _REAL) for number in values):
        raise ValueError(
            f"missing is {brief_repr(value)}; it must be a number, a list of numbers, or {NEGATIVE}"
        )
    return tuple(values)


def _counts(content: dict[Any, Any]) -> tuple[tuple[int, int], ...]:
    """Return the checked pairs of counts."""
    counts = content.get("counts", {})
    if not isinstance(counts, dict) or not all(
        type(value) is int and type(number) is int and number > 0
        for value, number in counts.items()
    ):
        raise ValueError(
            "counts must be numbers of keypoints for values of count, like {0: 18, 1: 34}"
        )
    if counts and "count" not in content:
        raise ValueError("counts are there, but no count whose values they are")
    return tuple(counts.items())
