"""Mapping files: a field mapping in a few lines of YAML, for messages of types not known here.

`config/mappings/` has examples; the first explains each field.
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
    """A mapping file that is missing or says what none can: names the file and the mend."""


def read_mapping(path: Path) -> FieldMapping:
    """Return the mapping that a YAML file describes; raise MappingError if it is none."""
    try:
        return _mapping(read_fields(path, "type: my_msgs/People"))
    except ValueError as error:
        raise MappingError(f"field mapping {path}: {error}") from error


def _mapping(given: dict[Any, Any]) -> FieldMapping:
    """Return the mapping of the fields of a file, each checked; raise ValueError for a bad one."""
    fields = {field.name: field for field in dataclasses.fields(FieldMapping) if field.init}
    for name in given:
        if name not in fields:
            raise ValueError(f"has no field {brief_repr(name)}; the fields are {', '.join(fields)}")
    given = {name: value for name, value in given.items() if value is not None}
    for name in ("type", "keypoints"):
        if name not in given:
            raise ValueError(f"lacks the field {name!r}")
    if not (match := _TYPE.fullmatch(str(given["type"]))):
        raise ValueError(f"type is {brief_repr(given['type'])}; it must be like my_msgs/People")
    names = given.get("names", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("names must be a list of names, in quotes if need be")
    if len(set(names)) < len(names):
        raise ValueError("names has a name twice")
    if names and "keypoint_id" not in given:
        raise ValueError("names are there, but no keypoint_id that is one of them")
    if given.get("units", PIXELS) not in (PIXELS, NORMALISED):
        raise ValueError(
            f"units is {brief_repr(given['units'])}; it must be {PIXELS} or {NORMALISED}"
        )
    for name, kind in (("first_id", int), ("missing", (int, float))):
        value = given.get(name, 0)
        if isinstance(value, bool) or not isinstance(value, kind):
            raise ValueError(f"{name} is {brief_repr(value)}; it must be a number")
    for name in ("objects", "identity", "keypoints", "x", "y", "score", "keypoint_id"):
        path = given.get(name, "x")
        if not isinstance(path, str) or not _FIELD.fullmatch(path):
            raise ValueError(f"{name} is {brief_repr(path)}; it must be a field, like position.x")
    return FieldMapping(**given | {"type": "/".join(match.groups()), "names": tuple(names)})
