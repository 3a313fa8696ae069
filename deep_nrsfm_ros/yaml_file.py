# SPDX-License-Identifier: Apache-2.0
"""YAML files that people write: layouts, field mappings, cameras. Read with helpful errors."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import yaml

_MAX_BYTES = 64 * 2**10
_MAX_DEPTH = 8
_TOO_DEEP = f"is nested deeper than {_MAX_DEPTH}: not a description"
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's is ten times faster


def read_fields(path: Path, example: str) -> dict[Any, Any]:
    """Return the fields of a YAML file that holds one mapping.

    The file is at most 64 KiB, without aliases and nested at most 8 deep, so that a small hostile
    file cannot take much memory. `---` at the end is allowed: `ros2 topic echo` writes it.

    Args:
        path: the file.
        example: a field as the file may have it, for the error message, e.g. "name: hand".

    Raises:
        ValueError: the file cannot be read, or is not such a mapping. The message continues
            "file PATH", e.g. "is not YAML: ...".
    """
    try:
        if path.exists() and not path.is_file():  # reading a pipe would block
            raise ValueError("is not a regular file")
        with path.open("rb") as file:
            text = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error
    if len(text) > _MAX_BYTES:
        raise ValueError(f"is larger than {_MAX_BYTES >> 10} KiB: not a description")
    text = text.rstrip().removesuffix(b"\n---")
    _check_nesting(text)
    try:
        root = yaml.compose(text, _Loader)
        fields = yaml.load(text, _Loader)
    except Exception as error:  # explicit tags make PyYAML raise exceptions of many types
        raise ValueError(f"is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(root, yaml.MappingNode) or not isinstance(fields, dict):
        raise ValueError(f"is {brief_repr(fields)}; it must hold fields like '{example}'")
    ((name, times),) = Counter(str(key.value) for key, _ in root.value).most_common(1) or [("", 0)]
    if times > 1:  # PyYAML would silently keep the last
        raise ValueError(f"has the field {brief_repr(name)} {times} times")
    return fields


def _check_nesting(text: bytes) -> None:
    """Raise ValueError for aliases and deep nesting, without building the document."""
    depth = 0
    try:
        for event in yaml.parse(text, _Loader):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"has the alias *{event.anchor}; write out what it stands for")
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_DEPTH:
                raise ValueError(_TOO_DEEP)
    except yaml.YAMLError as error:
        if "maximum nesting depth" in str(error):  # libyaml's own limit, which is higher
            raise ValueError(_TOO_DEEP) from error
        raise ValueError(f"is not YAML: {' '.join(str(error).split())}") from error


def brief_repr(value: Any) -> str:
    """Return a value from a file as error messages show it, at most about 60 characters."""
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "a mapping"
    text = "empty" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
