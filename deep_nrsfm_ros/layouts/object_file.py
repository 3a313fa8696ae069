"""Object files: a keypoint layout in a few lines of YAML, for objects that have no preset.

`config/objects/` has examples that explain each field.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from deep_nrsfm_ros.layouts.keypoint_layout import LAYOUTS, Edge, KeypointLayout, Tetrahedron
from deep_nrsfm_ros.yaml_file import read_fields, words

OBJECT_SUFFIXES = (".yaml", ".yml")
FIELDS = (
    *("name", "keypoints", "edges", "rigid", "handedness"),
    *("reference", "reference_length", "derived"),
)
HANDEDNESS = ("left", "right", "up", "front")
_FEWEST = 4  # W = S M has a unique shape from four points on


class ObjectFileError(ValueError):
    """An object file that is missing or says something that no layout can: names file and mend."""


def read_object(path: Path) -> KeypointLayout:
    """Return the layout that an object file describes; raise ObjectFileError if it is none."""
    try:
        return _Description(read_fields(path, "name: hand")).layout()
    except ObjectFileError as error:
        raise ObjectFileError(f"object file {path}: {error}") from None
    except ValueError as error:
        raise ObjectFileError(f"object file {path}: {error}") from error


class _Description:
    """The fields of an object file, each checked when it is asked for.

    Every complaint names the field and shows what was found there.
    """

    def __init__(self, fields: dict[Any, Any]) -> None:
        """Refuse fields that do not exist, and the lack of those that must."""
        unknown = [name for name in fields if name not in FIELDS]
        if unknown:
            raise ObjectFileError(
                f"has no field {words(unknown[0])}; the fields are {', '.join(FIELDS)}"
            )
        # A field without a value, as a template leaves it, is as good as none.
        self._fields = {name: value for name, value in fields.items() if value is not None}
        for name in ("name", "keypoints"):
            if name not in self._fields:
                raise ObjectFileError(f"lacks the field '{name}'")

    def layout(self) -> KeypointLayout:
        """Return the layout; raise ValueError for what it cannot be."""
        name = self._text("name", self._fields["name"])
        if name in LAYOUTS:
            raise ObjectFileError(f"name {name!r} is that of a preset; choose another")
        keypoints = self._names("keypoints", self._fields["keypoints"])
        if len(keypoints) < _FEWEST:
            raise ObjectFileError(f"has {len(keypoints)} keypoints; at least {_FEWEST} are needed")
        reference = self._fields.get("reference")
        return KeypointLayout(
            name,
            keypoints,
            edges=self._pairs("edges"),
            rigid=self._pairs("rigid"),
            handedness=self._handedness(),
            reference=None if reference is None else self._pair("reference", reference),
            derived=self._derived(),
            reference_length=self._reference_length(),
        )

    def _pairs(self, field: str) -> tuple[Edge, ...]:
        pairs = self._list(field, self._fields.get(field, []))
        return tuple(self._pair(f"{field}[{i}]", pair) for i, pair in enumerate(pairs))

    def _handedness(self) -> tuple[Tetrahedron, ...]:
        given = self._fields.get("handedness", [])
        if not isinstance(given, list):
            return (self._tetrahedron("handedness", given),)
        return tuple(self._tetrahedron(f"handedness[{i}]", four) for i, four in enumerate(given))

    def _tetrahedron(self, where: str, value: Any) -> Tetrahedron:
        given = self._mapping(where, value)
        if set(given) != set(HANDEDNESS):
            raise ObjectFileError(
                f"{where} names {', '.join(map(words, given)) or 'nothing'}; "
                f"it must name {', '.join(HANDEDNESS)}"
            )
        left, right, up, front = (self._text(f"{where}.{s}", given[s]) for s in HANDEDNESS)
        return left, right, up, front

    def _derived(self) -> dict[str, tuple[str, ...]]:
        given = self._mapping("derived", self._fields.get("derived", {}))
        return {
            self._text("a name in derived", name): self._names(f"derived.{name}", parts)
            for name, parts in given.items()
        }

    def _reference_length(self) -> float | None:
        length = self._fields.get("reference_length")
        if length is None:
            return None
        if isinstance(length, bool) or not isinstance(length, (int, float)):
            raise ObjectFileError(f"reference_length is {words(length)}; it must be in metres")
        return float(length)

    def _pair(self, where: str, value: Any) -> Edge:
        names = self._names(where, value)
        if len(names) != 2:
            raise ObjectFileError(f"{where} has {len(names)} names; it must have 2")
        return names[0], names[1]

    def _names(self, where: str, value: Any) -> tuple[str, ...]:
        items = self._list(where, value)
        return tuple(self._text(f"{where}[{i}]", item) for i, item in enumerate(items))

    def _list(self, where: str, value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise ObjectFileError(f"{where} is {words(value)}; it must be a list")
        return value

    def _mapping(self, where: str, value: Any) -> dict[Any, Any]:
        if not isinstance(value, dict):
            raise ObjectFileError(f"{where} is {words(value)}; it must be a mapping")
        return value

    def _text(self, where: str, value: Any) -> str:
        if isinstance(value, str) and value.strip():
            return value
        # YAML reads `on`, `no` and 1 as something else than text.
        raise ObjectFileError(f"{where} is {words(value)}; it must be a name, in quotes if need be")
