"""What a training that is resumed was asked for when it began."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from deep_nrsfm_ros.training.record import checkpoint_file, differences, look


def resumed_arguments(
    parser: argparse.ArgumentParser,
    argv: Sequence[str] | None,
    given: argparse.Namespace,
    say: Callable[[str], None],
) -> argparse.Namespace:
    """Return the arguments `given` by `argv`, completed by those with which the training began.

    What `argv` says comes first, and `say` tells where it differs. Raises ValueError when there is
    nothing to go on with and no data to begin with either.
    """
    found = look(given.output.expanduser(), given.name)
    if found is None:
        if not given.bag and not given.cmu:
            raise ValueError(
                f"--resume found no unfinished training of {given.name!r} in {given.output}; name "
                "it by --name and --output, or say what to train on"
            )
        say("there is nothing to resume; the training begins anew")
        return given
    if not found.asked and not given.bag and not given.cmu:
        raise ValueError(
            f"there is no record of what the training of {given.name!r} in {given.output} was "
            "asked for; give the data and the options that it began with, or delete "
            f"{checkpoint_file(given.output, given.name)}"
        )
    said = _said(parser, argv)
    for difference in differences(found.asked, said):
        say(f"warning: since this training began, {difference}")
    asked = {name: _parsed(parser, name, value) for name, value in found.asked.items()}
    return argparse.Namespace(**{**vars(given), **asked, **said})


def _said(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> dict[str, Any]:
    """Return the arguments that `argv` names, without defaults."""
    nothing = argparse.Namespace(**dict.fromkeys(vars(parser.parse_args([]))))
    said = vars(parser.parse_args(argv, nothing))
    return {name: value for name, value in said.items() if value is not None}


def _parsed(parser: argparse.ArgumentParser, name: str, value: Any) -> Any:
    """Return a value from the record as the parser gives it: JSON has no paths."""
    kinds = {action.dest: action.type for action in parser._actions}
    if kinds.get(name) is not Path or value is None:
        return value
    return [Path(item) for item in value] if isinstance(value, list) else Path(value)
