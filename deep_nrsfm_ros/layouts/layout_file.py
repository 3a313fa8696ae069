# SPDX-License-Identifier: Apache-2.0
"""Layout files: keypoint layouts in YAML, those of the presets and those of users alike.

`config/layouts/hand.yaml` explains each field; `layouts/presets/` has files to copy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from deep_nrsfm_ros.layouts.joints import Joint, fitting_joints
from deep_nrsfm_ros.layouts.layout import Edge, KeypointLayout, Tetrahedron
from deep_nrsfm_ros.similar_names import did_you_mean
from deep_nrsfm_ros.yaml_file import brief_repr, read_fields

LAYOUT_SUFFIXES = (".yaml", ".yml")
FIELDS = (
    *("name", "keypoints", "edges", "rigid", "handedness"),
    *("reference", "reference_length", "derived", "top", "bottom"),
    "joints",
)
_OF_JOINTS = ("parent", "at", "angles", "max_twist")
_TREES = Path(__file__).parent / "trees"
HANDEDNESS = ("left", "right", "up", "front")
_MIN_KEYPOINTS = 4  # W = S M has a unique shape from four points on


class LayoutFileError(ValueError):
    """A layout file that is missing or wrong; the text names the file, the field and the mend."""


def read_layout(path: Path) -> KeypointLayout:
    """Return the keypoint layout of a layout file.

    Raises:
        LayoutFileError: the file cannot be read, or a field of it is wrong.
    """
    try:
        return _Description(read_fields(path, "name: hand")).layout()
    except LayoutFileError as error:
        raise LayoutFileError(f"layout file {path}: {error}") from None
    except ValueError as error:
        raise LayoutFileError(f"layout file {path}: {error}") from error


class _Description:
    """The fields of a layout file, each checked when it is read.

    Every error names the field and shows its value.
    """

    def __init__(self, fields: dict[Any, Any]) -> None:
        """Raise LayoutFileError for a field that does not exist or a required one that lacks."""
        unknown = [name for name in fields if name not in FIELDS]
        if unknown:
            hint = did_you_mean(str(unknown[0]), FIELDS) or f"the fields are {', '.join(FIELDS)}"
            raise LayoutFileError(f"has no field {brief_repr(unknown[0])}; {hint}")
        # A template leaves fields without a value; they count as absent.
        self._fields = {name: value for name, value in fields.items() if value is not None}
        for name in ("name", "keypoints"):
            if name not in self._fields:
                raise LayoutFileError(f"lacks the field '{name}'")

    def layout(self) -> KeypointLayout:
        """Return the layout; raise ValueError for a wrong field."""
        name = self._text("name", self._fields["name"])
        keypoints = self._names("keypoints", self._fields["keypoints"])
        if len(keypoints) < _MIN_KEYPOINTS:
            raise LayoutFileError(
                f"has {len(keypoints)} keypoints; at least {_MIN_KEYPOINTS} are needed"
            )
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
            top=self._names_or_name("top"),
            bottom=self._names_or_name("bottom"),
            joints=self._joints(keypoints),
        )

    def _joints(self, keypoints: tuple[str, ...]) -> tuple[Joint, ...]:
        """Return the joints of the layout's own tree, or those of a shared one that fit."""
        value = self._fields.get("joints", {})
        if not isinstance(value, str):
            return self._tree(value)
        trees = sorted(path.stem for path in _TREES.glob("*.yaml"))
        if value not in trees:
            raise LayoutFileError(
                f"joints is {brief_repr(value)}; it must be a mapping, or one of the trees "
                f"{', '.join(trees)}"
            )
        fields = read_fields(_TREES / f"{value}.yaml", "joints: {}")
        return fitting_joints(self._tree(fields["joints"]), keypoints)

    def _tree(self, value: Any) -> tuple[Joint, ...]:
        joints = self._mapping("joints", value)
        return tuple(
            self._joint(self._text("a name in joints", name), fields)
            for name, fields in joints.items()
        )

    def _joint(self, name: str, value: Any) -> Joint:
        where = f"joints.{name}"
        fields = self._mapping(where, value)
        if "at" not in fields:
            raise LayoutFileError(f"{where} lacks the field 'at'")
        at = fields["at"]
        twist = fields.get("max_twist", 180.0)
        if isinstance(twist, bool) or not isinstance(twist, (int, float)) or not 0 < twist <= 180:
            raise LayoutFileError(
                f"{where}.max_twist is {brief_repr(twist)}; it must be in degrees"
            )
        angles = self._mapping(f"{where}.angles", fields.get("angles", {}))
        return Joint(
            name,
            (at,) if isinstance(at, str) else self._names(f"{where}.at", at),
            self._text(f"{where}.parent", fields["parent"]) if "parent" in fields else "",
            tuple(
                (self._text(f"a direction of {where}", key), self._pair(f"{where}.{key}", pair))
                for key, pair in fields.items()
                if key not in _OF_JOINTS
            ),
            tuple(
                (self._text(f"an angle of {where}", key), self._text(f"{where}.{key}", axis))
                for key, axis in angles.items()
            ),
            float(twist),
        )

    def _pairs(self, field: str) -> tuple[Edge, ...]:
        pairs = self._list(field, self._fields.get(field, []))
        return tuple(self._pair(f"{field}[{i}]", pair) for i, pair in enumerate(pairs))

    def _handedness(self) -> tuple[Tetrahedron, ...]:
        value = self._fields.get("handedness", [])
        if not isinstance(value, list):
            return (self._tetrahedron("handedness", value),)
        return tuple(self._tetrahedron(f"handedness[{i}]", four) for i, four in enumerate(value))

    def _tetrahedron(self, where: str, value: Any) -> Tetrahedron:
        corners = self._mapping(where, value)
        if set(corners) != set(HANDEDNESS):
            raise LayoutFileError(
                f"{where} names {', '.join(map(brief_repr, corners)) or 'nothing'}; "
                f"it must name {', '.join(HANDEDNESS)}"
            )
        left, right, up, front = (self._text(f"{where}.{c}", corners[c]) for c in HANDEDNESS)
        return left, right, up, front

    def _derived(self) -> dict[str, tuple[str, ...]]:
        derived = self._mapping("derived", self._fields.get("derived", {}))
        return {
            self._text("a name in derived", name): self._names(f"derived.{name}", parts)
            for name, parts in derived.items()
        }

    def _reference_length(self) -> float | None:
        length = self._fields.get("reference_length")
        if length is None:
            return None
        if isinstance(length, bool) or not isinstance(length, (int, float)):
            raise LayoutFileError(f"reference_length is {brief_repr(length)}; it must be in metres")
        return float(length)

    def _pair(self, where: str, value: Any) -> Edge:
        names = self._names(where, value)
        if len(names) != 2:
            raise LayoutFileError(f"{where} has {len(names)} names; it must have 2")
        return names[0], names[1]

    def _names_or_name(self, field: str) -> tuple[str, ...]:
        value = self._fields.get(field, [])
        return (value,) if isinstance(value, str) else self._names(field, value)

    def _names(self, where: str, value: Any) -> tuple[str, ...]:
        items = self._list(where, value)
        return tuple(self._text(f"{where}[{i}]", item) for i, item in enumerate(items))

    def _list(self, where: str, value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise LayoutFileError(f"{where} is {brief_repr(value)}; it must be a list")
        return value

    def _mapping(self, where: str, value: Any) -> dict[Any, Any]:
        if not isinstance(value, dict):
            raise LayoutFileError(f"{where} is {brief_repr(value)}; it must be a mapping")
        return value

    def _text(self, where: str, value: Any) -> str:
        if isinstance(value, str) and value.strip():
            return value
        # YAML reads `on` and `no` as booleans and 1 as a number.
        raise LayoutFileError(
            f"{where} is {brief_repr(value)}; it must be a name, in quotes if need be"
        )
