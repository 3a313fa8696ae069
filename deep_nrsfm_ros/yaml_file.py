"""YAML that people write: read with every complaint they need, and no more than they meant."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import yaml

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's is ten times faster
_MAX_BYTES = 64 * 2**10
_DEEPEST = 8


def read_fields(path: Path, example: str) -> dict[Any, Any]:
    """Return the fields of a file, its size and its form checked.

    example: a field as the file may have it. Raises ValueError that says what is wrong.
    """
    try:
        if path.exists() and not path.is_file():  # reading a pipe would wait for ever
            raise ValueError("is not a regular file")
        with path.open("rb") as file:
            text = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error
    if len(text) > _MAX_BYTES:
        raise ValueError(f"is larger than {_MAX_BYTES >> 10} KiB: not a description")
    text = text.rstrip().removesuffix(b"\n---")  # so `ros2 topic echo` ends each message
    _check_nesting(text)
    try:
        root = yaml.compose(text, _Loader)
        fields = yaml.load(text, _Loader)
    except Exception as error:  # PyYAML raises many kinds for what explicit tags say
        raise ValueError(f"is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(root, yaml.MappingNode) or not isinstance(fields, dict):
        raise ValueError(f"is {words(fields)}; it must hold fields like '{example}'")
    ((name, times),) = Counter(str(key.value) for key, _ in root.value).most_common(1) or [("", 0)]
    if times > 1:  # YAML itself would keep the last and forget the others
        raise ValueError(f"has the field {words(name)} {times} times")
    return fields


def _check_nesting(text: bytes) -> None:
    """Refuse what makes much out of little before it is made: aliases, deep nesting."""
    depth = 0
    try:
        for event in yaml.parse(text, _Loader):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"has the alias *{event.anchor}; write out what it stands for")
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:
                raise ValueError(f"is nested deeper than {_DEEPEST}: not a description")
    except yaml.YAMLError as error:
        raise ValueError(f"is not YAML: {' '.join(str(error).split())}") from error


def words(value: Any) -> str:
    """Return a value as a complaint shows it: short, whatever a file holds."""
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "a mapping"
    text = "empty" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
