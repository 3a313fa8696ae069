# SPDX-License-Identifier: Apache-2.0
"""Cells of a table: numbers, with a count of those that are none, times and frames."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from deep_nrsfm_ros.data.formats.builder import DetectionsBuilder, KeypointFileError
from deep_nrsfm_ros.lifting.sanity import Finding

_MISSING = {
    *("", "na", "n/a", "<na>", "#n/a", "#nv", "nan", "nat", "none", "null", "missing", "-", "--"),
    "?",
}
_WORDS = {"true": 1.0, "false": 0.0}  # of a column such as nose_visible
_FEW = 0.01  # fraction of cells that are no numbers, up to which they are no cause for doubt
_MOST = 0.5  # fraction of them above which nothing sound is left
_SECOND = 1_000_000_000  # ns
_OF_DAY = re.compile(r"(.*?)(\d{1,2}:\d{2}(?::\d{2})?)(?:[.,](\d+))?\s*(Z|[+-]\d{2}:?\d{2})?")
_OF_CLOCK = re.compile(r"(?:(\d+):)?(\d{1,2}):(\d{2})(?:[.,](\d+))?")


def is_missing(cell: str) -> bool:
    """Return whether a cell says that there is no value."""
    return cell.strip().lower() in _MISSING


class Numbers:
    """Reads cells as numbers, and counts those that are none.

    Attributes:
        read: cells that were read and hold something.
        wrong: cells that hold something else than a number.
    """

    def __init__(self) -> None:
        """Start without cells."""
        self.read = self.wrong = 0
        self._example = ""

    def row(self, cells: Sequence[str], line: int) -> NDArray[np.float64]:
        """Return cells (n,) as numbers, NaN for what is none.

        Args:
            cells: of a row.
            line: of the row in the file.
        """
        try:
            values = list(map(float, cells))
            self.read += len(cells)
        except ValueError:
            values = [self.one(cell, line) for cell in cells]
        return np.array(values, np.float64)

    def one(self, cell: str, line: int) -> float:
        """Return a cell as a number, NaN for what is none."""
        try:
            value = float(cell)
        except ValueError:
            text = cell.strip().lower()
            if text in _MISSING:
                return np.nan
            if text not in _WORDS:
                self.wrong += 1
                self._example = self._example or f"{cell.strip()!r} in line {line}"
            value = _WORDS.get(text, np.nan)
        self.read += 1
        return value

    def say(self, builder: DetectionsBuilder) -> None:
        """Say how many cells are no numbers; few are a warning, more a finding.

        Raises:
            KeypointFileError: most are none.
        """
        if not self.wrong:
            return
        finding = Finding(
            "cells",
            f"{self.wrong} of {self.read} cells are no numbers, such as {self._example}, and count "
            "as missing: write plain numbers such as 1088.5, without units and without separators "
            "of thousands",
        )
        if self.wrong > _MOST * self.read:
            raise KeypointFileError(finding.message)
        if self.wrong > _FEW * self.read:
            builder.find(finding)
        else:
            builder.warnings.append(finding.message)


def whole_or_fraction(text: str) -> int | float | None:
    """Return the number in a text, as an integer where it is whole; None if it is none."""
    try:
        return int(text)
    except ValueError:
        pass
    try:
        value = float(text)
    except ValueError:
        return None
    if not np.isfinite(value):
        return None
    return int(value) if value == int(value) else value


def stamp_of_text(text: str) -> int | None:
    """Return the time in ns that a text says; None if it says none.

    Args:
        text: "2024-05-01T10:00:00.3Z", "2024-05-01 10:00:00,300", "10:00:00.3" or "00:01.3". A
            date without a time zone is taken for UTC; without a date, midnight is 0.
    """
    text = text.strip()
    clock = _OF_CLOCK.fullmatch(text)
    if clock and (clock[1] or clock[4]):
        hours, minutes, seconds = (int(part or 0) for part in clock.group(1, 2, 3))
        return (3600 * hours + 60 * minutes + seconds) * _SECOND + _fraction(clock[4])
    found = _OF_DAY.fullmatch(text)
    if not found or not found[1]:
        return None
    day = found[1].strip(" T_").replace("/", "-")
    try:
        moment = datetime.fromisoformat(f"{day}T{found[2]:0>5}{found[4] or ''}")
    except ValueError:
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    whole = moment - datetime(1970, 1, 1, tzinfo=UTC)
    return (whole.days * 86400 + whole.seconds) * _SECOND + _fraction(found[3])


def _fraction(digits: str | None) -> int:
    """Return the nanoseconds that the digits after the point of a second say."""
    return int((digits or "0")[:9].ljust(9, "0"))
