# SPDX-License-Identifier: Apache-2.0
"""Options: one declaration, ranges that hold, and only what is given is overridden."""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deep_nrsfm_ros.configuration import (
    add_arguments,
    check,
    described,
    option,
    options,
    override,
)

some = settings(max_examples=40, deadline=None)


@dataclass(frozen=True)
class Oven:
    """Settings of an oven."""

    degrees: int = option(180, "temperature", low=50, high=250)
    hours: float = option(1.5, "how long; 50 % is lost", low=0.0)
    mode: str = option("fan", "heating", choices=("fan", "grill"))
    light: bool = option(True, "light inside")
    racks: tuple[int, ...] = option((1, 3), "racks in use", low=1, high=5)
    dishes: tuple[str, ...] = option((), "what is in it")
    fixed: int = option(1, "set at the factory", read_only=True)
    serial: str = "not an option"


def parse(*words: str, base: Oven | None = None) -> Oven:
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_arguments(parser, Oven)
    return override(base or Oven(), parser.parse_args(words))


@dataclass(frozen=True)
@described
class Grill:
    """Settings of a grill."""

    degrees: int = option(180, "temperature in degrees", low=50, high=250)
    fuel: str = option("gas", "what burns", choices=("gas", "coal"))
    colour: str = "not an option"

    def __post_init__(self) -> None:
        if self.fuel == "coal" and self.degrees > 200:
            raise ValueError("coal is not so hot")


def test_a_described_class_says_its_options_and_refuses_wrong_values() -> None:
    text = Grill.__doc__ or ""
    assert text.startswith("Settings of a grill.\n")
    assert "    degrees: temperature in degrees; at least 50 and at most 250; default 180." in text
    assert "    fuel: what burns; one of 'gas', 'coal'; default 'gas'." in text
    assert "colour" not in text
    assert Grill(degrees=60) == Grill(60)
    for wrong, complaint in (
        ({"degrees": 10}, "degrees is 10; it must be at least 50"),
        ({"degrees": "a"}, "degrees is 'a'; it must be a number"),
        ({"fuel": "wood"}, "fuel is 'wood'; choose one of gas, coal"),
        ({"fuel": "coal", "degrees": 250}, "coal is not so hot"),
    ):
        with pytest.raises(ValueError, match=complaint):
            Grill(**wrong)


def test_nothing_given_changes_nothing() -> None:
    base = Oven(degrees=200, racks=(2,), serial="x")
    assert parse(base=base) == base


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--degrees", "99"), Oven(degrees=99)),
        (("--hours", "0"), Oven(hours=0.0)),
        (("--mode", "grill"), Oven(mode="grill")),
        (("--no-light",), Oven(light=False)),
        (("--light",), Oven()),
        (("--racks", "2", "4", "5"), Oven(racks=(2, 4, 5))),
        (("--dishes", "pie", "tart"), Oven(dishes=("pie", "tart"))),
        (("--dishes",), Oven()),
        (("--mode", "grill", "--degrees", "250"), Oven(mode="grill", degrees=250)),
    ],
)
def test_only_what_is_given_is_overridden(words: tuple[str, ...], expected: Oven) -> None:
    assert parse(*words) == expected
    base = Oven(fixed=7, serial="kept")
    changed = parse(*words, base=base)
    assert (changed.fixed, changed.serial) == (7, "kept")
    assert type(changed.racks) is tuple


@some
@given(st.integers(-1000, 1000))
def test_ranges_are_inclusive(degrees: int) -> None:
    if 50 <= degrees <= 250:
        assert parse("--degrees", str(degrees)).degrees == degrees
    else:
        message = f"degrees is {degrees}; it must be at least 50 and at most 250"
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            parse(f"--degrees={degrees}")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (Oven(hours=-0.1), "hours is -0.1; it must be at least 0"),
        (Oven(hours=float("nan")), "hours is nan; it must be at least 0"),
        (Oven(mode="steam"), "mode is 'steam'; choose one of fan, grill"),
        (Oven(racks=(1, 6)), "racks is 6; it must be at least 1 and at most 5"),
        (Oven(degrees=251), "degrees is 251; it must be at least 50 and at most 250"),
    ],
)
def test_errors_name_option_value_and_range(wrong: Oven, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check(wrong)
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):  # the base is checked too
        parse("--light", base=wrong)


@pytest.mark.parametrize("words", [("--mode", "steam"), ("--degrees", "hot"), ("--serial", "x")])
def test_the_command_line_refuses_what_is_no_option(words: tuple[str, ...]) -> None:
    with pytest.raises((argparse.ArgumentError, SystemExit)):
        parse(*words)


def test_options_are_the_fields_declared_as_such() -> None:
    found = {field.name: (kind, opt) for field, kind, opt in options(Oven)}
    assert list(found) == ["degrees", "hours", "mode", "light", "racks", "dishes", "fixed"]
    assert found["degrees"][0] is int and found["racks"][0] == tuple[int, ...]
    assert found["mode"][1].choices == ("fan", "grill")
    assert [name for name, (_, opt) in found.items() if opt.read_only] == ["fixed"]
    assert (found["light"][1].low, found["light"][1].high) == (None, None)


def test_help_tells_description_and_default() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser, Oven)
    text = " ".join(parser.format_help().split())
    for part in (
        "Settings of an oven",
        "temperature (default: 180)",
        "how long; 50 % is lost (default: 1.5)",
        "racks in use (default: 1 3)",
        "--no-light",
        "{fan,grill}",
    ):
        assert part in text
