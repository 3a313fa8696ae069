"""Options: typed dataclass fields that carry their own description and range.

One declaration serves every way in: the field is a Python default, a command-line option
(`add_arguments`) and, in the node, a declared ROS parameter with descriptor (`node.parameters`).
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, get_type_hints

Config = TypeVar("Config")


@dataclasses.dataclass(frozen=True)
class Option:
    """What an option means and allows; `low` and `high` are inclusive, None is unbounded.

    A `read_only` option cannot change while a node runs.
    """

    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False

    def check(self, name: str, value: Any) -> None:
        """Raise ValueError that names the option, the value and what is allowed."""
        values = value if isinstance(value, (tuple, list)) else (value,)
        for item in values:
            if self.choices and item not in self.choices:
                raise ValueError(f"{name} is {item!r}; choose one of {', '.join(self.choices)}")
            below = self.low is not None and not item >= self.low
            above = self.high is not None and not item <= self.high
            if below or above:
                raise ValueError(f"{name} is {item!r}; it must be {self.allowed()}")

    def allowed(self) -> str:
        """Return the range in words, e.g. "at least 0 and at most 1"."""
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
    """Return a dataclass field with its description, range and choices attached."""
    return dataclasses.field(
        default=default, metadata={"option": Option(description, low, high, choices, read_only)}
    )


def options(cls: type) -> list[tuple[dataclasses.Field[Any], Any, Option]]:
    """Return (field, resolved type, option) for every field declared with `option`."""
    hints = get_type_hints(cls)
    return [
        (field, hints[field.name], field.metadata["option"])
        for field in dataclasses.fields(cls)
        if "option" in field.metadata
    ]


def check(config: Any) -> None:
    """Raise ValueError for the first option of `config` outside its range."""
    for field, _, opt in options(type(config)):
        opt.check(field.name, getattr(config, field.name))


def add_arguments(parser: argparse.ArgumentParser, cls: type, without: Sequence[str] = ()) -> None:
    """Add `--name-of-field` to `parser` for every option of the dataclass `cls`.

    without: fields that mean nothing to this program. What is not given leaves no trace in the
    parsed arguments: see `override`.
    """
    group = parser.add_argument_group((cls.__doc__ or cls.__name__).splitlines()[0].rstrip("."))
    for field, kind, opt in options(cls):
        if field.name in without:
            continue
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
        default: Any = field.default
        shown = " ".join(map(str, default)) if isinstance(default, tuple) else default
        settings["help"] = f"{opt.description} (default: {shown})".replace("%", "%%")
        group.add_argument("--" + field.name.replace("_", "-"), **settings)


def override(base: Config, arguments: argparse.Namespace) -> Config:
    """Return the dataclass `base` with the options that were given; ranges checked."""
    given = vars(arguments)
    values = {f.name: given[f.name] for f, _, _ in options(type(base)) if f.name in given}
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    config: Config = dataclasses.replace(base, **values)  # type: ignore[type-var]
    check(config)
    return config


def to_arguments(config: Any) -> list[str]:
    """Return the command line that gives every option of `config`: the way back from `override`."""
    words = []
    for field, kind, _ in options(type(config)):
        name, value = field.name.replace("_", "-"), getattr(config, field.name)
        if kind is bool:
            words.append(f"--{name}" if value else f"--no-{name}")
        else:
            words += [f"--{name}", *map(str, value if isinstance(value, tuple) else (value,))]
    return words
