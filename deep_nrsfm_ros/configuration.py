# SPDX-License-Identifier: Apache-2.0
"""Options: fields of frozen dataclasses with a description and a range.

Each option is declared once. It is a Python default, a command-line option (`add_arguments`) and,
in the node, a ROS parameter with a descriptor (`node/parameter_bridge.py`). `help` of the class has
the descriptions too (`described`).
"""

from __future__ import annotations

import argparse
import dataclasses
import textwrap
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any, TypeVar, get_args, get_type_hints

Config = TypeVar("Config")

_WIDTH = 96  # of a line of a docstring


@dataclasses.dataclass(frozen=True)
class Option:
    """The description and the allowed values of an option.

    Attributes:
        description: one sentence with unit, meaning of the range and typical value.
        low: least value, inclusive; None = unbounded.
        high: largest value, inclusive; None = unbounded.
        choices: the allowed values; empty = any.
        read_only: the value cannot change while a node runs.
    """

    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False

    def check(self, name: str, value: Any) -> None:
        """Raise ValueError if a value, or an element of a tuple, is not allowed.

        Args:
            name: name of the option, for the error message.
            value: a value, or a tuple or list of them; None, where that is the default, is
                allowed.
        """
        values = value if isinstance(value, (tuple, list)) else (value,)
        for item in values:
            if item is None:
                continue
            if self.choices and item not in self.choices:
                raise ValueError(f"{name} is {item!r}; choose one of {', '.join(self.choices)}")
            bounded = self.low is not None or self.high is not None
            if bounded and not isinstance(item, Real):
                raise ValueError(f"{name} is {item!r}; it must be a number, {self.allowed()}")
            below = self.low is not None and not item >= self.low
            above = self.high is not None and not item <= self.high
            if below or above:
                raise ValueError(f"{name} is {item!r}; it must be {self.allowed()}")

    def allowed(self) -> str:
        """Return the range in words, e.g. "at least 0 and at most 1"; "" if unbounded."""
        bounds = (("at least", self.low), ("at most", self.high))
        return " and ".join(f"{word} {bound:g}" for word, bound in bounds if bound is not None)


def option(
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    read_only: bool = False,
) -> Any:
    """Return a dataclass field with an `Option` in its metadata; see there for the arguments."""
    return dataclasses.field(
        default=default, metadata={"option": Option(description, low, high, choices, read_only)}
    )


def described(cls: type[Config]) -> type[Config]:
    """Return the class of a dataclass with its options in its docstring, and values checked.

    Below `dataclass`, which reads the fields. The docstring has the description, the allowed values
    and the default of each option. To make an object with a value that is not allowed raises
    ValueError.
    """
    lines = [(cls.__doc__ or cls.__name__).rstrip(), "", "Attributes:"]
    for name, field in vars(cls).items():
        opt = field.metadata.get("option") if isinstance(field, dataclasses.Field) else None
        if opt is None:
            continue
        parts = [opt.description, opt.allowed(), f"default {field.default!r}"]
        if opt.choices and not all(choice in opt.description for choice in opt.choices):
            parts.insert(1, f"one of {', '.join(map(repr, opt.choices))}")
        text = f"{name}: {'; '.join(filter(None, parts))}."
        lines += textwrap.wrap(
            text, _WIDTH, initial_indent=" " * 4, subsequent_indent=" " * 8, break_long_words=False
        )
    cls.__doc__ = "\n".join(lines)
    after: Callable[[Any], None] = vars(cls).get("__post_init__", lambda self: None)

    def post_init(self: Any) -> None:
        check(self)
        after(self)

    cls.__post_init__ = post_init  # type: ignore[attr-defined]
    return cls


def options(cls: type) -> list[tuple[dataclasses.Field[Any], Any, Option]]:
    """Return (field, its type, its option) for every field of `cls` declared with `option`."""
    hints = get_type_hints(cls)
    return [
        (field, hints[field.name], field.metadata["option"])
        for field in dataclasses.fields(cls)
        if "option" in field.metadata
    ]


def check(config: Any) -> None:
    """Raise ValueError if an option of the dataclass `config` has a value that is not allowed."""
    for field, _, opt in options(type(config)):
        opt.check(field.name, getattr(config, field.name))


def add_arguments(parser: argparse.ArgumentParser, cls: type, without: Sequence[str] = ()) -> None:
    """Add `--name-of-field` to a parser for every option of a dataclass.

    An option that is not on the command line is absent from the parsed arguments; see `override`.

    Args:
        parser: gets a group titled by the first line of the docstring of `cls`.
        cls: a dataclass with fields declared with `option`.
        without: names of fields to leave out.
    """
    group = parser.add_argument_group((cls.__doc__ or cls.__name__).splitlines()[0].rstrip("."))
    for field, kind, opt in options(cls):
        if field.name in without:
            continue
        kind = _without_none(kind)
        settings: dict[str, Any] = {"default": argparse.SUPPRESS}
        if kind is bool:
            settings["action"] = argparse.BooleanOptionalAction
        elif isinstance(field.default, tuple):
            element = type(field.default[0]) if field.default else str
            settings |= {"type": element, "nargs": "*"}
        else:
            settings["type"] = kind
        if opt.choices:
            settings["choices"] = opt.choices
        default: Any = "none" if field.default is None else field.default
        shown = " ".join(map(str, default)) if isinstance(default, tuple) else default
        settings["help"] = f"{opt.description} (default: {shown})".replace("%", "%%")
        group.add_argument("--" + field.name.replace("_", "-"), **settings)


def _without_none(kind: Any) -> Any:
    """Return `float` for `float | None`, and any other type as it is."""
    return next((part for part in get_args(kind) if part is not type(None)), kind)


def override(base: Config, arguments: argparse.Namespace) -> Config:
    """Return the dataclass `base` with the options on the command line replaced.

    Args:
        base: values of the options that are not on the command line.
        arguments: as parsed by a parser after `add_arguments`.

    Raises:
        ValueError: a value is not allowed.
    """
    parsed = vars(arguments)
    values = {f.name: parsed[f.name] for f, _, _ in options(type(base)) if f.name in parsed}
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    config: Config = dataclasses.replace(base, **values)  # type: ignore[type-var]
    check(config)
    return config
