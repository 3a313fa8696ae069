"""Read a field mapping from YAML, for message types that have none in this package.

`config/mappings/` has examples; media_pipe_ros2.yaml explains each field.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

from deep_nrsfm_ros.messages.field_mapping import NORMALISED, PIXELS, FieldMapping
from deep_nrsfm_ros.yaml_file import brief_repr, read_fields

MAPPING_SUFFIXES = (".yaml", ".yml")

_TYPE = re.compile(r"([A-Za-z]\w*)/(?:msg/)?([A-Za-z]\w*)")
_FIELD = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)*")


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


def _mapping(content: dict[Any, Any]) -> FieldMapping:
    """Return the mapping of checked fields; raise ValueError for an invalid one."""
    fields = {field.name: field for field in dataclasses.fields(FieldMapping) if field.init}
    for name in content:
        if name not in fields:
            raise ValueError(f"has no field {brief_repr(name)}; the fields are {', '.join(fields)}")
    content = {name: value for name, value in content.items() if value is not None}
    for name in ("type", "keypoints"):
        if name not in content:
            raise ValueError(f"lacks the field {name!r}")
    if not (match := _TYPE.fullmatch(str(content["type"]))):
        raise ValueError(f"type is {brief_repr(content['type'])}; it must be like my_msgs/People")
    names = content.get("names", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("names must be a list of names, in quotes if need be")
    if len(set(names)) < len(names):
        raise ValueError("names has a name twice")
    if names and "keypoint_id" not in content:
        raise ValueError("names are there, but no keypoint_id that is one of them")
    if content.get("units", PIXELS) not in (PIXELS, NORMALISED):
        raise ValueError(
            f"units is {brief_repr(content['units'])}; it must be {PIXELS} or {NORMALISED}"
        )
    for name, kind in (("first_id", int), ("missing", (int, float))):
        value = content.get(name, 0)
        if isinstance(value, bool) or not isinstance(value, kind):
            raise ValueError(f"{name} is {brief_repr(value)}; it must be a number")
    for name in ("objects", "identity", "keypoints", "x", "y", "confidence", "keypoint_id"):
        value = content.get(name, "x")
        if not isinstance(value, str) or not _FIELD.fullmatch(value):
            raise ValueError(f"{name} is {brief_repr(value)}; it must be a field, like position.x")
    return FieldMapping(**content | {"type": "/".join(match.groups()), "names": tuple(names)})
