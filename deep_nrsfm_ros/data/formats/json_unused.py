# SPDX-License-Identifier: Apache-2.0
"""The fields of objects and frames in JSON that are not used, and which of them to name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from typing import Any

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder
from deep_nrsfm_ros.data.formats.json_fields import (
    frame_field,
    identity_field,
    is_annotation,
    is_usual,
    role,
    time_field,
)
from deep_nrsfm_ros.data.formats.unused import meaning

_LOOKS = 20  # objects of the same fields in which unused ones are looked for
_MOST_FORMS = 1000  # sets of fields, likewise
_LONGEST = 100  # characters of a name, an identity or a time
_FEWEST = 3  # numbers of the confidences of an object
_MEANINGS = {
    "frame": "the frame",
    "time": "the time",
    "identity": "an identity",
    "confidence": "a confidence",
}
"""Roles of fields -> what `unused.meaning` calls them."""
_REMEDIES = {
    "frame": "frame",
    "time": "timestamp",
    "identity": "track_id",
    "confidence": "keypoint_scores",
}
"""Roles of fields -> a name under which they are read."""


class UnusedFields:
    """Gathers the fields that are not used; `tell` gives them to a builder."""

    def __init__(self) -> None:
        """Start without fields."""
        self._forms: Counter[tuple[str, ...]] = Counter()  # of the fields of an object
        self._fields: dict[str, _Unused] = {}

    def look(self, value: Mapping[str, Any], used: Collection[str]) -> None:
        """Look at the fields of an object or frame.

        Args:
            value: the object or frame.
            used: its fields that are read, without those of its frame, time and identity.
        """
        form = tuple(value)
        if self._forms[form] >= _LOOKS or len(self._forms) > _MOST_FORMS:
            return
        self._forms[form] += 1
        taken = {*used, frame_field(value), time_field(value), identity_field(value)}
        if is_annotation(value):
            taken.add("id")
        for name, given in value.items():
            if name in taken or is_usual(name) or given is None or given in ("", [], {}):
                continue
            if role(name) not in ("keypoints", "hands", "objects"):
                self.look_at(name, given)

    def look_at(self, name: str, value: Any) -> None:
        """Look at a value of a field."""
        field = self._fields.setdefault(name, _Unused(meaning(name)))
        if field.count < _LOOKS:
            field.look(value)

    def tell(self, builder: DetectionsBuilder, has: Collection[str]) -> None:
        """Name the fields to a builder.

        Args:
            builder: of the detections.
            has: roles of the fields that were read: what is known needs no other field.
        """
        remedies = {_MEANINGS[what]: name for what, name in _REMEDIES.items() if what not in has}
        told = [name for name, field in self._fields.items() if field.is_told(remedies)]
        builder.not_used("fields", told, remedies)


class _Unused:
    """A field that is not used: what it may mean, and whether its values are such.

    Attributes:
        count: values that were looked at.
    """

    def __init__(self, meant: str) -> None:
        """Start without values."""
        self._meaning, self._is_plausible, self._varies = meant, False, False
        self._first: Any = None
        self.count = 0

    def look(self, value: Any) -> None:
        """Look at a value."""
        if self._meaning == "a confidence":
            self._is_plausible |= isinstance(value, list) and len(value) >= _FEWEST
        else:
            is_plain = isinstance(value, (int, float, str)) and not isinstance(value, bool)
            self._is_plausible |= is_plain and len(str(value)) < _LONGEST
        if not self.count:
            self._first = value
        self.count += 1
        self._varies |= value != self._first

    def is_told(self, remedies: Collection[str]) -> bool:
        """Return whether to say that the field is not used.

        Args:
            remedies: meanings that the reader has not found.
        """
        if not self._meaning:
            return True
        is_same = self._meaning != "a confidence" and not self._varies and self.count > 1
        return self._meaning in remedies and self._is_plausible and not is_same
