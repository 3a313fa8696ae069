# SPDX-License-Identifier: Apache-2.0
"""Paths into a message, as field mappings write them: `a.b`, `a[0]`, `a[]`, `a[0::3]`, `/a`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cached_property
from operator import attrgetter, itemgetter
from typing import Any

from deep_nrsfm_ros.lifting.observation import MessageError

_INDEX = r"\[(?:\d{0,6}|\d{0,6}:\d{0,6}(?::[1-9]\d{0,5})?)\]"
_NAME = rf"[A-Za-z]\w*(?:{_INDEX})*"
_PATH = re.compile(rf"/?{_NAME}(?:\.{_NAME})*")
_STEP = re.compile(rf"[A-Za-z]\w*|{_INDEX}")
_MAX_FIELDS = 30  # names of fields in an error text

Step = str | int | slice
"""A field, the index of an item, or a slice of a list: each of its items in turn."""


class FieldPath:
    """A path into a message: fields, indices of items, and slices of lists.

    Attributes:
        text: as the mapping writes it.
        from_message: the path begins at the message, not at the object: it starts with "/".
        steps: the fields, indices and slices on the way.
    """

    def __init__(self, text: str) -> None:
        """Read a path.

        Raises:
            ValueError: `text` is no path.
        """
        if not _PATH.fullmatch(text):
            raise ValueError(f"{text!r} is no path")
        self.text = text
        self.from_message = text.startswith("/")
        self.steps: tuple[Step, ...] = tuple(map(_step, _STEP.findall(text)))

    @property
    def is_list(self) -> bool:
        """Whether the path leads to several values: a step is a slice."""
        return any(isinstance(step, slice) for step in self.steps)

    @cached_property
    def value(self) -> Callable[[Any], Any]:
        """The function that returns the one value at the path."""
        return _getter(self.steps)

    @cached_property
    def values(self) -> Callable[[Any], Sequence[Any]]:
        """The function that returns the values of a list at the path.

        Lists that are the items of a list are joined.
        """
        if not self.is_list:
            return self.value
        first = next(i for i, step in enumerate(self.steps) if isinstance(step, slice))
        list_of, each = _getter(self.steps[:first]), self.steps[first]
        rest = FieldPath.__new__(FieldPath)
        rest.steps = self.steps[first + 1 :]
        if not rest.steps:
            return list_of if each == slice(None) else lambda root: list_of(root)[each]
        value_of = rest.values

        def values(root: Any) -> Sequence[Any]:
            found = [value_of(item) for item in list_of(root)[each]]
            if found and is_sequence(found[0]):
                return [value for items in found for value in items]
            return found

        return values

    def follow(self, root: Any, where: str) -> list[Any]:
        """Return the values at the path, checking every step.

        Args:
            root: message, object or keypoint that the path begins at.
            where: what `root` is, for the error text.

        Raises:
            MessageError: a step leads nowhere. The text says what was found there.
        """
        values, so_far = [root], ""
        for step in self.steps:
            place = so_far or where
            following = []
            for value in values:
                if isinstance(step, str):
                    if not hasattr(value, step):
                        raise MessageError(f"{place} is {describe(value)}{_remedy(value, step)}")
                    following.append(getattr(value, step))
                elif not is_sequence(value):
                    raise MessageError(f"{place} is {describe(value)}, which has no items")
                elif isinstance(step, slice):
                    following.extend(value[step])
                elif step >= len(value):
                    raise MessageError(f"{place} is {describe(value)}: it has no item [{step}]")
                else:
                    following.append(value[step])
            values, so_far = following, _append(so_far, step)
        return values


def describe(value: Any) -> str:
    """Return what a value in a message is, as error messages show it."""
    if is_sequence(value):
        return f"a list of {len(value)}"
    if isinstance(value, (str, bytes, int, float)) or value is None:
        text = repr(value)
        return text if len(text) <= 40 else f"{text[:40]}..."
    return f"a {type_of(value)}"


def is_sequence(value: Any) -> bool:
    """Return whether a value is a list or an array, not a text."""
    return (
        hasattr(value, "__len__")
        and hasattr(value, "__getitem__")
        and not isinstance(value, (str, bytes, dict))
    )


def type_of(value: Any) -> str:
    """Return the name of a value's type, without what rosbags and rclpy add to it."""
    return type(value).__name__.replace("__msg__", "/")


def fields_of(value: Any) -> list[str]:
    """Return the names of the fields of a message, [] if it has none."""
    try:
        if hasattr(value, "get_fields_and_field_types"):
            return list(value.get_fields_and_field_types())
        return [name for name in vars(value) if not name.startswith("_")]
    except (TypeError, AttributeError):
        return []


def _remedy(value: Any, step: str) -> str:
    """Return the text about a value that has no field `step`."""
    if is_sequence(value):
        return f", which has no field {step!r}: [] after it means each of them, [0] the first"
    if not (names := fields_of(value)):
        return f", which has no field {step!r}"
    more = ", ..." * (len(names) > _MAX_FIELDS)
    return f", which has no field {step!r}; its fields are {', '.join(names[:_MAX_FIELDS])}{more}"


def _append(path: str, step: Step) -> str:
    """Return a path with one more step."""
    if isinstance(step, str):
        return f"{path}.{step}" if path else step
    return f"{path}[]" if isinstance(step, slice) else f"{path}[{step}]"


def _step(text: str) -> Step:
    """Return a step of a path."""
    if not text.startswith("["):
        return text
    parts = text[1:-1].split(":")
    if len(parts) == 1 and parts[0]:
        return int(parts[0])
    return slice(*(int(part) if part else None for part in parts)) if parts != [""] else slice(None)


def _getter(steps: Sequence[Step]) -> Callable[[Any], Any]:
    """Return the function that follows fields and indices."""
    getters: list[Callable[[Any], Any]] = []
    names: list[str] = []
    for step in (*steps, None):
        if isinstance(step, str):
            names.append(step)
            continue
        if names:
            getters.append(attrgetter(".".join(names)))
            names = []
        if step is not None:
            getters.append(itemgetter(step))
    if len(getters) == 1:
        return getters[0]
    if len(getters) == 2:
        first, second = getters
        return lambda root: second(first(root))

    def get(root: Any) -> Any:
        for getter in getters:
            root = getter(root)
        return root

    return get
